"""Hostile inputs, structured: hypothesis strategies, and what must hold for whatever they draw.

A target takes what its strategy draws and fails where rcseg raises anything but an error of its own, or gives
out something that breaks its promises. `test_fuzz.py` runs a few examples of each, always the same;
`make fuzz MINUTES=10` runs new ones (`benchmarks/fuzz.py`).
"""

from __future__ import annotations

import contextlib
import copy
import io
import tempfile
from collections import Counter
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import recordings
from hypothesis import strategies as st

from rcseg_core import PinholeCamera, RangeColorFrame, SegmenterConfig, segment
from rcseg_core.config import describe
from rcseg_core.errors import ConfigError, RcsegError
from rcseg_ros.commands.segment_one import read_npz
from rcseg_ros.frames.assembly import assemble
from rcseg_ros.frames.conversions import (
    decode_camera_info,
    decode_cloud,
    decode_depth,
    decode_image,
    header_of,
)
from rcseg_ros.frames.refusals import MessageError
from rcseg_ros.frames.sync import FrameSync
from rcseg_ros.recordings.bag import Recording, deserializer
from rcseg_ros.recordings.result_bag import definition_text, make_message, serialize
from rcseg_ros.recordings.storage import RawMessage, Topic
from rcseg_ros.settings import load_config

INTS = [
    0,
    1,
    2,
    3,
    4,
    7,
    47,
    48,
    49,
    63,
    64,
    65,
    96,
    128,
    192,
    255,
    256,
    65_535,
    65_536,
    2**31 - 1,
    2**31,
    2**32 - 1,
]
FLOATS = [0.0, -0.0, 1.0, -1.0, 60.0, 1e-300, 1e-6, 1e6, 1e300, -1e300, np.nan, np.inf, -np.inf]
_ENCODINGS = (
    "rgb8 bgr8 rgba8 bgra8 mono8 mono16 16UC1 32FC1 64FC1 8UC3 bayer_rggb8 bayer_gbrg16 yuv422 "
    "yuv422_yuy2 nv21 nv24"
)
_FORMS = (
    "jpeg,png,h264,16UC1; compressedDepth png,32FC1; compressedDepth png,16UC1; compressedDepth rvl,"
    "rgb8; jpeg compressed bgr8"
)
_LENSES = "plumb_bob equidistant rational_polynomial thin_prism_fisheye fov"
WORDS = ["", *_ENCODINGS.split(), *_FORMS.split(","), *_LENSES.split(), "x" * 1000, "\0", "é\n"]
DEPTHS = [0.0, 1e-6, 1e-3, 0.3, 1.0, 5.0, 80.0, 1e3, 1e6, -1.0, np.nan, np.inf, -np.inf, 3e38]

MOST = float(np.finfo(np.float32).max)

ints = st.sampled_from(INTS)
floats = st.sampled_from(FLOATS)


# Messages.


@cache
def _bases() -> dict[str, Any]:
    """One good message of each kind."""
    depth = {entry.topic: entry.message for entry in recordings.depth_entries(1)}
    cloud = recordings.cloud_entries(1)[0].message
    color = depth[recordings.COLOR]
    header = color.header
    pixels = np.frombuffer(color.data, np.uint8).reshape(color.height, color.width, 3)
    metres = np.frombuffer(depth[recordings.DEPTH].data, np.float32).reshape(color.height, color.width)
    steps = np.nan_to_num(metres * 1000).astype(np.uint16)

    def compressed(data: bytes, form: str) -> Any:
        return make_message(
            "sensor_msgs/msg/CompressedImage", header=header, format=form, data=np.frombuffer(data, np.uint8)
        )

    png, jpeg, deep = (
        cv2.imencode(*arguments)[1].tobytes()
        for arguments in ((".png", pixels), (".jpg", pixels), (".png", steps))
    )
    rvl = bytes(12) + np.array([64, 48], "<u4").tobytes() + bytes(range(256)) * 8
    return {
        "cloud": cloud, "image": color, "depth": depth[recordings.DEPTH], "info": depth[recordings.INFO],
        "png": compressed(png, "rgb8; png compressed bgr8"),
        "jpeg": compressed(jpeg, "rgb8; jpeg compressed bgr8"),
        "compressed depth": compressed(bytes(12) + deep, "16UC1; compressedDepth png"),
        "rvl": compressed(rvl, "16UC1; compressedDepth rvl"),
    }  # fmt: skip


@st.composite
def damaged_bytes(draw: Any, data: bytes) -> bytes:
    """Bytes cut off, prolonged, overwritten, doubled or made anew."""
    changed = bytearray(data)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(changed)))
        how = draw(st.sampled_from(["cut", "add", "flip", "number", "fill", "repeat", "new"]))
        if how == "cut":
            del changed[at:]
        elif how == "add":
            changed[at:at] = draw(st.binary(max_size=16))
        elif how == "flip" and at < len(changed):
            changed[at] ^= 1 << draw(st.integers(0, 7))
        elif how == "number":
            width = draw(st.sampled_from([1, 2, 4, 8]))
            value = draw(
                st.sampled_from([0, 1, 0x7F, 0x80, 0xFF, 2**31 - 1, 2**32 - 1, 2**63 - 1, 2**64 - 1])
            )
            changed[at : at + width] = (value % 256**width).to_bytes(width, "little")
        elif how == "fill":
            length = draw(st.sampled_from([1, 16, 300]))
            changed[at : at + length] = bytes([draw(st.sampled_from([0, 0x7F, 0xFF]))]) * length
        elif how == "repeat":
            changed[at:at] = changed[max(0, at - 64) : at]
        elif how == "new":
            changed = bytearray(draw(st.binary(max_size=200)))
    return bytes(changed)


@st.composite
def _array(draw: Any, values: np.ndarray) -> np.ndarray:
    """A copy with hostile numbers in it, of the same size or another."""
    values = np.array(values)
    if values.dtype == np.uint8:
        return np.frombuffer(draw(damaged_bytes(values.tobytes())), np.uint8)
    if draw(st.booleans()):
        values = values[: draw(st.integers(0, len(values)))]
    if draw(st.booleans()):
        values = np.resize(values, draw(st.sampled_from([0, 1, 3, 4, 5, 8, 9, 12, 14, 20])))
    for _ in range(draw(st.integers(0, 5))):
        if len(values):
            values[draw(st.integers(0, len(values) - 1))] = draw(floats)
    return values


@st.composite
def _fields(draw: Any, fields: list[Any]) -> list[Any]:
    """Fields of a cloud: absent, doubled, of other types, beyond the point."""
    fields = [copy.copy(field) for field in fields if draw(st.integers(0, 9))]
    for field in fields:
        if draw(st.integers(0, 3)) == 0:
            field.offset = draw(ints)
        if draw(st.integers(0, 3)) == 0:
            field.datatype = draw(st.integers(0, 255))
        if draw(st.integers(0, 5)) == 0:
            field.count = draw(ints)
        if draw(st.integers(0, 5)) == 0:
            field.name = draw(st.sampled_from(["x", "y", "z", "rgb", "rgba", "intensity", "", "X", "é"]))
    return fields + draw(st.sampled_from([[], fields[:1], fields]))


@st.composite
def _changed(draw: Any, message: Any) -> Any:
    """A copy of a message with one to four of its fields replaced, those of its parts too."""
    message = copy.copy(message)
    names = [name for name in vars(message) if name != "__msgtype__"]
    for name in draw(st.lists(st.sampled_from(names), min_size=1, max_size=4, unique=True)):
        setattr(message, name, draw(_value(name, getattr(message, name))))
    return message


def _value(name: str, value: Any) -> st.SearchStrategy[Any]:
    if isinstance(value, bool):
        return st.booleans()
    if isinstance(value, int):
        return st.sampled_from([-(2**31), -1, *INTS]) if name in ("sec",) else ints
    if isinstance(value, float):
        return floats
    if isinstance(value, str):
        return st.sampled_from(WORDS) | st.text(max_size=8)
    if isinstance(value, np.ndarray):
        return _array(value)
    if isinstance(value, list):
        return _fields(value)
    return _changed(value)


def _message(*kinds: str) -> st.SearchStrategy[Any]:
    return st.sampled_from(kinds).flatmap(lambda kind: st.just(_bases()[kind]) | _changed(_bases()[kind]))


messages = st.tuples(
    _message("cloud", "depth", "compressed depth", "rvl"),
    st.none() | _message("image", "png", "jpeg", "depth"),
    st.none() | _message("info"),
    st.none() | _message("info"),
)


def take_messages(drawn: tuple[Any, Any, Any, Any]) -> None:
    """Every decoder gives what it promises or refuses; so does the assembly of a frame."""
    range_, image, info, own = drawn
    header_of(range_)
    if hasattr(range_, "fields"):
        cloud = or_refused(decode_cloud, range_)
        assert cloud is None or (cloud.points.ndim == 3 and cloud.points.shape[2] == 3)
    else:
        depth_m = or_refused(decode_depth, range_)
        assert depth_m is None or (depth_m.ndim == 2 and depth_m.dtype == np.float32)
    if image is not None:
        rgb = or_refused(decode_image, image)
        assert rgb is None or (rgb.ndim == 3 and rgb.shape[2] == 3 and rgb.dtype == np.uint8)
    for camera in (info, own):
        if camera is not None:
            or_refused(decode_camera_info, camera)
    made = or_refused(lambda message: assemble(message, image, info, own), range_)
    if made is not None:
        assert isinstance(made.frame, RangeColorFrame) and made.frame.valid.any()


def or_refused(decode: Callable[[Any], Any], message: Any) -> Any:
    """What it makes of the message; None where it refuses it in one line."""
    try:
        return decode(message)
    except RcsegError as error:
        assert "\n" not in str(error) and len(str(error)) < 2000, error
        assert not isinstance(error, MessageError) or error.reason.isidentifier()
        return None


TYPES = ("cloud", "image", "info", "png")
cdr = st.sampled_from(TYPES).flatmap(
    lambda kind: st.tuples(st.just(kind), damaged_bytes(bytes(serialize(_bases()[kind]))[:3000]))
)


def take_cdr(drawn: tuple[str, bytes]) -> None:
    """Bytes of a message, by the definition that a recording carries."""
    kind, data = drawn
    recording = object.__new__(Recording)
    name = _bases()[kind].__msgtype__
    recording.topics = {"/topic": Topic("/topic", name, 1, definition_text(name), False, (), "cdr")}
    recording._types = {"/topic": _reader(name), name: _reader(name)}
    message = or_refused(recording.decode, RawMessage("/topic", 0, data))
    if message is not None and kind == "cloud":
        take_messages((message, None, None, None))
    elif message is not None and kind in ("image", "png"):
        take_messages((_bases()["cloud"], message, None, None))


@cache
def _reader(name: str) -> Callable[[bytes], Any]:
    return deserializer(Topic("/topic", name, 1, definition_text(name), False, (), "cdr"))


# Recordings.


@cache
def _recording(compression: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        entries = recordings.depth_entries(2)
        path = recordings.write_mcap(Path(folder) / "a.mcap", entries, compression, chunk_size=12_000)
        return path.read_bytes()


recording_bytes = st.sampled_from(["zstd", "lz4", "none"]).flatmap(lambda c: damaged_bytes(_recording(c)))


def take_recording(data: bytes) -> None:
    """A file of changed bytes: what can be read is, and what cannot is told."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        path.write_bytes(data)
        _read_all(path)


def _read_all(path: Path) -> None:
    try:
        recording = Recording(path)
    except RcsegError as error:
        assert "\n" not in str(error)
        return
    with recording:
        names, count = list(recording.topics), 0
        for raw in recording.messages(names):
            or_refused(recording.decode, raw)
            count += 1
        assert count <= 1000
        assert all("\n" not in damage for damage in recording.damage)


@cache
def _folder() -> dict[str, bytes]:
    with tempfile.TemporaryDirectory() as folder:
        path = recordings.write_folder(Path(folder) / "bag", recordings.depth_entries(1))
        return {file.name: file.read_bytes() for file in path.iterdir()}


@st.composite
def damaged_text(draw: Any, text: str) -> bytes:
    """YAML with lines removed, doubled, indented and with values replaced; or changed bytes of it."""
    if draw(st.integers(0, 3)) == 0:
        return draw(damaged_bytes(text.encode()))
    lines = text.split("\n")
    values = ["", "[]", "{}", "null", "-1", "1e999", ".nan", "2026-13-45", "*a", "&a [*a]",
              "!!python/object:os.x {}", "!!binary x", "? [a]", "'", "9" * 20, "\t", "~", "[[[["]  # fmt: skip
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(lines) - 1))
        how = draw(st.sampled_from(["drop", "double", "indent", "value", "key"]))
        if how == "drop" and len(lines) > 1:
            del lines[at]
        elif how == "double":
            lines.insert(at, lines[at])
        elif how == "indent":
            lines[at] = " " * draw(st.integers(0, 5)) + lines[at].lstrip()
        elif how == "value":
            lines[at] = lines[at].split(":")[0] + ": " + draw(st.sampled_from(values))
        else:
            lines[at] = draw(st.sampled_from(values)) + ": 1"
    return "\n".join(lines).encode()


metadata = st.deferred(lambda: damaged_text(_folder()["metadata.yaml"].decode()))


def take_metadata(data: bytes) -> None:
    """A recording does not depend on its metadata.yaml: its three messages are read whatever that says."""
    with tempfile.TemporaryDirectory() as folder:
        for name, content in _folder().items():
            (Path(folder) / name).write_bytes(data if name == "metadata.yaml" else content)
        with Recording(Path(folder)) as recording:
            assert len(list(recording.messages(list(recording.topics)))) == 3


# Files of settings and of frames.


@cache
def _settings() -> str:
    from rcseg_ros.settings import config_yaml

    return config_yaml(SegmenterConfig())


config_text = st.deferred(lambda: damaged_text(_settings()))


def take_config_text(data: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "config.yaml"
        path.write_bytes(data)
        made = or_refused(lambda file: load_config(file, []), path)
        assert made is None or SegmenterConfig.from_dict(made.to_dict()) == made


KEYS = [parameter.key for parameter in describe(SegmenterConfig())]
hostile_values = st.sampled_from(
    [
        None,
        True,
        "",
        "nan",
        "inf",
        "-1",
        "1e400",
        "0x10",
        "auto",
        [],
        {},
        [1],
        b"1",
        2**70,
        -1,
        0,
        1,
        0.5,
        *FLOATS,
    ]
) | st.text(max_size=5)
changes = st.dictionaries(st.sampled_from([*KEYS, "grouping", "a.b", ".", ""]), hostile_values, max_size=4)


def take_changes(drawn: dict[str, Any]) -> None:
    """Parameters by their keys, as the node and --set give them."""
    try:
        made = SegmenterConfig().replace(drawn)
    except ConfigError as error:
        assert "\n" not in str(error)
    else:
        assert SegmenterConfig.from_dict(made.to_dict()) == made


@st.composite
def archives(draw: Any) -> bytes:
    """An .npz of arrays with hostile shapes, types and names; or changed bytes of a good one."""
    frame = recordings.scene(0)
    arrays: dict[str, Any] = {"points": frame.points, "color": frame.color, "K": recordings.CAMERA.matrix()}
    if draw(st.booleans()):
        arrays["depth"] = arrays.pop("points")[..., 2]
    for name in draw(st.lists(st.sampled_from([*arrays, "points", "depth", "K"]), max_size=3)):
        shape = draw(
            st.sampled_from(
                [(), (0,), (3,), (3, 3), (48, 64), (48, 64, 3), (0, 0, 3), (2, 2, 3), (1, 1, 1, 3)]
            )
        )
        kind = draw(
            st.sampled_from(
                ["f4", "f8", "u1", "i1", "u2", "i8", "c16", "?", "U3", "S2", "M8[s]", ">f4", "f2"]
            )
        )
        arrays[name] = np.full(shape, draw(st.sampled_from([0, 1])), "i8").astype(kind)
    stream = io.BytesIO()
    draw(st.sampled_from([np.savez, np.savez_compressed]))(stream, **arrays)
    return draw(st.just(stream.getvalue()) | damaged_bytes(stream.getvalue()))


def take_archive(data: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "frame.npz"
        path.write_bytes(data)
        frame = or_refused(read_npz, path)
        assert frame is None or frame.valid.any()


# Frames.


@st.composite
def frames(draw: Any) -> RangeColorFrame | None:
    """Hostile geometry: 3 to 45 pixels, one depth, one point, lines, checkerboards, jumps, NaN, extremes."""
    height, width = draw(st.integers(1, 45)), draw(st.integers(1, 45))
    rows, cols = np.mgrid[0:height, 0:width]
    a, b = draw(st.sampled_from(DEPTHS)), draw(st.sampled_from(DEPTHS))
    pattern = draw(
        st.sampled_from(["one", "checks", "stripes", "step", "ramp", "noise", "one pixel", "point", "line"])
    )
    rng = np.random.default_rng(draw(st.integers(0, 9)))
    depth = {
        "one": np.full((height, width), a), "checks": np.where((rows + cols) % 2, a, b),
        "stripes": np.where(cols % 3 == 0, a, b), "step": np.where(cols > width // 2, a, b),
        "ramp": a * (1 + 0.01 * cols), "noise": a * rng.lognormal(0, 1, (height, width)),
        "one pixel": np.where((rows == height // 2) & (cols == width // 2), a, np.nan),
        "point": np.full((height, width), a), "line": np.full((height, width), a),
    }[pattern]  # fmt: skip
    depth = np.clip(depth, -MOST, MOST).astype(np.float32)
    color = draw(st.sampled_from(["flat", "noise", "checks"]))
    shades = {
        "flat": 0 * rows,
        "noise": rng.integers(0, 256, (height, width)),
        "checks": (rows + cols) % 2 * 255,
    }
    rgb = np.repeat(shades[color][..., None], 3, axis=2).astype(np.uint8)
    focal = draw(st.sampled_from([1e-3, 1.0, 30.0, 500.0, 1e6]))
    try:
        camera = PinholeCamera(focal, focal, draw(st.sampled_from([width / 2, -1e3, 0.0])), height / 2)
        if pattern in ("point", "line"):
            points = np.full((height, width, 3), a, np.float32)
            if pattern == "line":
                points[..., 0] = cols
            return RangeColorFrame(points, rgb, draw(st.sampled_from([None, camera])))
        return RangeColorFrame.from_depth(depth, rgb, camera)
    except RcsegError:
        return None


configs = st.sampled_from(
    [{}, {"signal.kind": "xyz"}, {"signal.reduction": "2"}, {"noise.range_model": "kinect_v1"}]
)
frames_and_configs = st.tuples(frames(), configs)


def take_frame(drawn: tuple[RangeColorFrame | None, dict[str, Any]]) -> None:
    """Labels run from 1 without a gap, lie on valid pixels, and the result describes itself."""
    frame, changes = drawn
    if frame is None:
        return
    try:
        result = segment(frame, SegmenterConfig().replace(changes))
    except RcsegError as error:
        assert "\n" not in str(error)
        return
    labels = result.labels
    assert labels.shape == frame.valid.shape and labels.dtype == np.int32 and labels.min() >= 0
    assert set(np.unique(labels)) - {0} == set(range(1, len(result.regions) + 1))
    assert all(region.pixel_count == (labels == region.label).sum() for region in result.regions)
    assert len(result.surfaces) == result.surface_labels.max()
    with contextlib.suppress(ValueError):  # a scene without any extent has no lengths
        result.labels_at(sigmas=3.0)
    points, color = result.reconstruct()
    assert points.shape == frame.points.shape and color.dtype == np.uint8


# Pairing.

STAMPS = [
    0,
    1,
    10_000_000,
    19_999_999,
    20_000_000,
    20_000_001,
    10**9,
    10**9 + 1,
    2 * 10**9,
    10**18,
    2**62,
    -(10**9),
]
events = st.lists(
    st.tuples(
        st.sampled_from(["range", "color", "camera"]), st.sampled_from(STAMPS) | st.integers(0, 5 * 10**9)
    ),
    max_size=60,
)
pairings = st.tuples(events, st.booleans(), st.booleans(), st.integers(1, 4))


def take_events(drawn: tuple[list[tuple[str, int]], bool, bool, int]) -> None:
    """Every message is in one pair, or counted under one reason; pairs lie within the slop."""
    happened, live, needs_camera, size = drawn
    sync = FrameSync(live=live, needs_camera=needs_camera, queue_size=size)
    add = {"range": sync.add_range, "color": sync.add_color, "camera": sync.add_camera}
    pairs, counts = [], Counter(kind for kind, _ in happened)
    for number, (kind, stamp) in enumerate(happened):
        pairs += add[kind](stamp, number)
    pairs += sync.flush()
    assert all(abs(pair.offset_ns) <= sync.slop_ns for pair in pairs)
    for kind in ("range", "color"):
        used = [getattr(pair, kind) for pair in pairs]
        assert len(set(used)) == len(used)
        lost = sum(n for reason, n in sync.drops.items() if reason.endswith(f"_{kind}"))
        assert len(used) + lost + sync.drops["no_camera_info"] == counts[kind], (kind, sync.drops)


class Target(NamedTuple):
    """What is drawn, what takes it, and how many examples `make test` runs."""

    strategy: st.SearchStrategy[Any]
    take: Callable[[Any], None]
    examples: int


TARGETS = {
    "messages": Target(messages, take_messages, 150),
    "cdr": Target(cdr, take_cdr, 100),
    "recording": Target(recording_bytes, take_recording, 60),
    "metadata": Target(metadata, take_metadata, 40),
    "config text": Target(config_text, take_config_text, 30),
    "parameters": Target(changes, take_changes, 100),
    "archive": Target(archives(), take_archive, 60),
    "frame": Target(frames_and_configs, take_frame, 40),
    "pairing": Target(pairings, take_events, 100),
}
