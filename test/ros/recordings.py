"""Small recordings for tests: a few frames of two walls, in any container that rcseg is to read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer

from rcseg_core import PinholeCamera, RangeColorFrame
from rcseg_ros.frames.conversions import Header
from rcseg_ros.recordings.result_bag import BagWriter, definition_text, make_message, result_types, serialize
from rcseg_ros.results.outputs import cloud_message, depth_message, header_message, picture_message

HEIGHT, WIDTH = 48, 64
CAMERA = PinholeCamera(60.0, 60.0, 31.5, 23.5)
START_NS, PERIOD_NS = 1_700_000_000_000_000_000, 100_000_000
FRAME_ID = "camera_optical_frame"
DEPTH, COLOR, INFO, POINTS = "/camera/depth/image", "/camera/image", "/camera/camera_info", "/camera/points"


@dataclass(frozen=True)
class Entry:
    """One message of a recording."""

    topic: str
    message: object
    log_ns: int


def scene(index: int) -> RangeColorFrame:
    """Two walls that meet in a corner; the corner moves from frame to frame."""
    noise = np.random.default_rng(index)
    cols = np.arange(WIDTH)
    corner = WIDTH / 2 + index
    profile = 1.0 + 0.004 * np.abs(cols - corner)
    depth_m = (np.tile(profile, (HEIGHT, 1)) + noise.normal(0, 5e-4, (HEIGHT, WIDTH))).astype(np.float32)
    depth_m[:4, :4] = np.nan
    color = np.where((cols < corner)[None, :, None], (180, 60, 50), (50, 80, 170)) + noise.normal(
        0, 2, (HEIGHT, WIDTH, 3)
    )
    return RangeColorFrame.from_depth(depth_m, np.clip(color, 0, 255).astype(np.uint8), CAMERA)


def head(stamp_ns: int) -> object:
    return header_message(Header(stamp_ns, FRAME_ID), make_message)


def info_message(stamp_ns: int, height: int = HEIGHT, width: int = WIDTH, k: object = None) -> object:
    roi = make_message(
        "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    k = CAMERA.matrix() if k is None else np.asarray(k, float)
    return make_message(
        "sensor_msgs/msg/CameraInfo", header=head(stamp_ns), height=height, width=width,
        distortion_model="plumb_bob", d=np.zeros(5), k=k.reshape(9), r=np.eye(3).reshape(9),
        p=np.c_[k, np.zeros(3)].reshape(12), binning_x=0, binning_y=0, roi=roi,
    )  # fmt: skip


def stamps(count: int) -> list[int]:
    return [START_NS + i * PERIOD_NS for i in range(count)]


def depth_entries(count: int = 3) -> list[Entry]:
    """Depth, colour and camera_info of each frame, with equal stamps."""
    entries = []
    for i, stamp in enumerate(stamps(count)):
        frame = scene(i)
        entries += [
            Entry(INFO, info_message(stamp), stamp),
            Entry(DEPTH, depth_message(frame.depth_m, head(stamp), make_message), stamp),
            Entry(COLOR, picture_message(frame.color, head(stamp), make_message), stamp),
        ]
    return entries


def cloud_entries(count: int = 3, flat: bool = False) -> list[Entry]:
    """A cloud with its own colour for each frame; `flat`: unorganised."""
    entries = []
    for i, stamp in enumerate(stamps(count)):
        frame = scene(i)
        shape = (1, HEIGHT * WIDTH) if flat else (HEIGHT, WIDTH)
        message = cloud_message(
            frame.points.reshape(*shape, 3), frame.color.reshape(*shape, 3), np.zeros(shape, np.int32),
            head(stamp), make_message,
        )  # fmt: skip
        entries.append(Entry(POINTS, message, stamp))
    return entries


def write_folder(path: Path, entries: list[Entry]) -> Path:
    """A rosbag2 folder as rcseg writes them (mcap, zstd)."""
    with BagWriter(path) as bag:
        for entry in entries:
            bag.write(entry.topic, entry.message.__msgtype__, serialize(entry.message), entry.log_ns)
    return path


def write_sqlite(path: Path, entries: list[Entry]) -> Path:
    """A rosbag2 folder with sqlite3 storage."""
    with Rosbag2Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as bag:
        connections = {}
        for entry in entries:
            if entry.topic not in connections:
                connections[entry.topic] = bag.add_connection(
                    entry.topic, entry.message.__msgtype__, typestore=result_types()
                )
            bag.write(connections[entry.topic], entry.log_ns, serialize(entry.message))
    return path


def write_mcap(
    path: Path, entries: list[Entry], compression: str = "zstd", chunk_size: int = 20_000, **options: bool
) -> Path:
    """A bare .mcap; `compression` zstd, lz4 or none; `options` of mcap.writer.Writer."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size, CompressionType[compression.upper()], **options)
        writer.start(profile="ros2", library="test")
        channels = {}
        for entry in entries:
            if entry.topic not in channels:
                name = entry.message.__msgtype__
                schema = writer.register_schema(name, "ros2msg", definition_text(name).encode())
                channels[entry.topic] = writer.register_channel(entry.topic, "cdr", schema)
            writer.add_message(channels[entry.topic], entry.log_ns, serialize(entry.message), entry.log_ns)
        writer.finish()
    return path
