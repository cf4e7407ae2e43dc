"""How near `rcseg replay` comes to the rate of segment() alone, and where the rest of its time goes.

Round by round, on the same frames: segment() alone, frame after frame, with all processors; then the replay
of a recording of these frames, from its first message read to the last one written. The share is the median
over the rounds, so that other load on the machine takes from both. Then, on one thread, the processor time of
each thing that a replay does with a frame.

    python benchmarks/replay_rate.py [RECORDING] [--frames 24] [--rounds 5] [--workers 2] [--outputs labels]

Without a recording: synthetic rooms, 640x480, depth (16 bit) and colour as a robot records them.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from functools import partial
from itertools import cycle, islice
from pathlib import Path
from statistics import median
from time import perf_counter, thread_time

import numpy as np

from rcseg_core import RangeColorFrame, SegmenterConfig, segment
from rcseg_core.compute.parallel import cores, set_threads
from rcseg_core.synthetic import make_scene
from rcseg_ros.commands.replay import ReplayRequest, replay
from rcseg_ros.frames.assembly import assemble_frame
from rcseg_ros.frames.conversions import Header, header_of
from rcseg_ros.frames.sync import FrameSync
from rcseg_ros.recordings.bag import RawMessage, Recording
from rcseg_ros.recordings.result_bag import BagWriter, make_message, serialize
from rcseg_ros.recordings.segmenting import OUTPUTS, Segmented, frame_row, serialized
from rcseg_ros.recordings.topics import find_topics
from rcseg_ros.results.made import ResultMessages
from rcseg_ros.results.outputs import header_message, picture_message
from rcseg_ros.tables.rows import frame_tables
from rcseg_ros.warmup import warm_up

PERIOD_NS = 33_000_000
ROW = {"segment_cpu_ms": 0.0, "camera": {"matrix": "K", "why": "", "registration": ""}}


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("recording", nargs="?", type=Path, help="instead of synthetic rooms")
    options.add_argument("--frames", type=int, default=24, help="frames of a round")
    options.add_argument("--rounds", type=int, default=5, help="0: only the processor time of each thing")
    options.add_argument("--workers", type=int, default=0, help="0: as many as processors")
    options.add_argument("--outputs", default="all")
    options.add_argument("--preset", default="balanced")
    options.add_argument("--tables", action="store_true", help="write tables too")
    given = options.parse_args()
    config = SegmenterConfig.preset(given.preset)
    outputs = OUTPUTS if given.outputs == "all" else tuple(given.outputs.split(","))
    warm_up(config, print)
    with tempfile.TemporaryDirectory() as folder:
        bag = lengthen(given.recording, Path(folder) / "in", given.frames)
        request = ReplayRequest(
            bag, Path(folder) / "out", config, outputs=outputs, workers=given.workers, tables=given.tables
        )
        frames = [frame for _, frame, _ in decoded(bag)]
        if given.rounds:
            compare(frames, request, given.rounds)
        itemize(bag, config, outputs, Path(folder) / "again", given.tables)


def lengthen(recording: Path | None, target: Path, count: int) -> Path:
    """A recording of `count` frames: those of `recording` over and over, or synthetic rooms."""
    with BagWriter(target) as bag:
        if recording is None:
            scenes = [make_scene("room", seed, width=640, height=480).frame for seed in range(min(count, 6))]
            for i, frame in enumerate(islice(cycle(scenes), count)):
                write_frame(bag, frame, i * PERIOD_NS + 1)
            return target
        with Recording(recording) as source:
            wanted = find_topics(source, {}).names()
            messages = list(source.messages(wanted))
            span = messages[-1].log_ns - messages[0].log_ns + PERIOD_NS
            frames = sum(raw.topic == wanted[0] for raw in messages)
            for again in range(-(-count // frames)):
                for raw in messages:
                    data = bytearray(raw.data)
                    later = raw.stamp_ns + again * span
                    data[4:12] = np.array(divmod(later, 10**9), "<u4").tobytes()
                    topic = source.topics[raw.topic]
                    bag.write(raw.topic, topic.type, bytes(data), raw.log_ns + again * span)
    return target


def write_frame(bag: BagWriter, frame: RangeColorFrame, stamp_ns: int) -> None:
    """Append a frame as depth in mm, colour and camera_info."""
    head = header_message(Header(stamp_ns, "camera"), make_message)
    depth = np.nan_to_num(frame.depth_m * 1000).round().astype(np.uint16)
    parts = {
        "/camera/camera_info": camera_info(frame.camera, *depth.shape, head),
        "/camera/depth": depth_message_of(depth, head),
        "/camera/image": picture_message(frame.color, head, make_message),
    }
    for topic, message in parts.items():
        bag.write(topic, message.__msgtype__, serialize(message), stamp_ns)


def depth_message_of(depth_mm, head):
    return make_message(
        "sensor_msgs/msg/Image", header=head, height=depth_mm.shape[0], width=depth_mm.shape[1],
        encoding="16UC1", is_bigendian=0, step=2 * depth_mm.shape[1], data=depth_mm.ravel().view(np.uint8),
    )  # fmt: skip


def camera_info(camera, height, width, head):
    roi = make_message(
        "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    k = camera.matrix()
    return make_message(
        "sensor_msgs/msg/CameraInfo", header=head, height=height, width=width, distortion_model="plumb_bob",
        d=np.zeros(5), k=k.reshape(9), r=np.eye(3).reshape(9), p=np.c_[k, np.zeros(3)].reshape(12),
        binning_x=0, binning_y=0, roi=roi,
    )  # fmt: skip


def pairs(recording: Recording):
    """Paired raw messages, as a replay reads them."""
    inputs = find_topics(recording, {})
    sync = FrameSync(
        slop_ns=20_000_000, queue_size=50, with_color=inputs.color is not None,
        needs_camera=inputs.camera_info is not None,
    )  # fmt: skip
    add = {inputs.range: sync.add_range, inputs.color: sync.add_color, inputs.camera_info: sync.add_camera}
    for raw in recording.messages(inputs.names()):
        yield from add[raw.topic](raw.stamp_ns, raw)
    yield from sync.flush()


def decoded(bag: Path):
    """Each frame of a recording with its header, and the seconds of this thread that decoding took."""
    with Recording(bag) as recording:
        for pair in pairs(recording):
            start = thread_time()
            raws = (pair.range, pair.color, pair.camera)
            messages = [None if raw is None else recording.decode(raw) for raw in raws]
            frame = assemble_frame(*messages)
            yield header_of(messages[0]), frame, thread_time() - start


def compare(frames, request: ReplayRequest, rounds: int) -> None:
    rows = []
    for _ in range(rounds):
        start = perf_counter()
        for frame in frames:
            segment(frame, request.config)
        alone = len(frames) / (perf_counter() - start)
        summary = replay(request)
        shutil.rmtree(request.output)
        rows.append((alone, summary.frames_per_second, summary.segment_only_per_second))
    height, width = frames[0].depth_m.shape
    print(f"{len(frames)} frames of {width}x{height}, {rounds} rounds, {cores()} processors, medians")
    print(f"  segment() alone, all processors on each frame   {median(r[0] for r in rows):6.1f} frames/s")
    replayed = median(r[1] for r in rows)
    print(f"  replay, {summary.workers:2d} workers                            {replayed:6.1f} frames/s")
    each = ", ".join(f"{r[1] / r[0]:.0%}" for r in rows)
    print(f"  {median(r[1] / r[0] for r in rows):.0%} of segment() alone (rounds: {each})")
    print(f"  {median(r[1] / r[2] for r in rows):.0%} of what the workers could reach with segment() alone")


def itemize(
    bag: Path, config: SegmenterConfig, outputs: tuple[str, ...], folder: Path, tables: bool = False
) -> None:
    """Processor time by what a replay does, one thread, medians over the frames."""
    set_threads(1)
    spent: dict[str, list[float]] = {}

    def timed(what, call):
        start = thread_time()
        value = call()
        spent.setdefault(what, []).append(1e3 * (thread_time() - start))
        return value

    start = thread_time()
    with Recording(bag) as recording:
        count = len(list(pairs(recording)))
    spent["read and pair"] = [1e3 * (thread_time() - start) / count]
    with BagWriter(folder) as writer:
        for header, frame, seconds in decoded(bag):
            spent.setdefault("decode", []).append(1e3 * seconds)
            result = timed("segment()", partial(segment, frame, config))
            if "regions" in outputs:
                timed("regions: patches", partial(getattr, result, "regions"))
                timed("regions: merge tree", partial(getattr, result, "hierarchy"))
                timed("regions: shapes of surfaces", partial(getattr, result, "surfaces"))
                timed("regions: world, objects", partial(getattr, result.world(), "objects"))
            row = timed("metrics", partial(frame_row, header, 0, frame, result, 0.0))
            messages = ResultMessages(header, frame, result, make_message)
            if tables:
                made = Segmented(RawMessage("", 0, bytes(12)), header, frame, result, row | ROW, messages)
                timed("tables", partial(frame_tables, made))
            for name in outputs:
                made = timed(f"{name}: make", partial(getattr, messages, name))
                for one in timed(f"{name}: serialise", partial(serialized, name, made)):
                    write = partial(writer.write, f"/{one.topic}", one.type, one.data, header.stamp_ns)
                    timed(f"{name}: write", write)
    total = sum(median(times) for times in spent.values())
    print("processor time of one thread, milliseconds a frame")
    for what, times in spent.items():
        print(f"  {what:28s} {median(times):7.2f}")
    alone = median(spent["segment()"])
    print(f"  beside segment()             {total - alone:7.2f}, {(total - alone) / alone:.0%} of it")


if __name__ == "__main__":
    sys.exit(main())
