"""Which recorded topics give range, colour and camera: named by the user, or found by type and content.

Where several would do, the choice goes by these, in this order:
range: in the grid of the colour image; a cloud before a depth image; "aligned" or "registered" in its name;
colour: in the grid of the range; a colour before a grey encoding; raw before compressed;
camera_info: calibrated; of the same size; beside the depth image or the colour image (``.../camera_info``).
Ties go to the first in alphabetical order. Topics of truth and of rcseg itself are inputs only when named.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from rcseg_core.errors import InputError
from rcseg_ros.bag import Recording, Topic
from rcseg_ros.conversions import decode_camera_info

CLOUD, IMAGE = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Image"
COMPRESSED, CAMERA_INFO = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
TF_TYPE = "tf2_msgs/msg/TFMessage"
KEYS = ("range", "color", "camera_info")
_DEPTH_ENCODINGS = ("16UC1", "mono16", "32FC1")
_GREY_ENCODINGS = ("mono8", "8UC1", "mono16")


@dataclass(frozen=True)
class InputTopics:
    """Topics that make frames; ``color`` None: the cloud's own colour; ``camera_info`` None: do without."""

    range: str
    color: str | None
    camera_info: str | None

    def names(self) -> list[str]:
        return [name for name in (self.range, self.color, self.camera_info) if name is not None]


def find_topics(recording: Recording, named: Mapping[str, str], range_from: str = "auto") -> InputTopics:
    """Choose the input topics of a recording.

    Parameters
    ----------
    named : any of ``range``, ``color``, ``camera_info`` to a topic, or to ``none``
    range_from : "auto", "points" or "depth"

    Raises
    ------
    InputError
        If nothing fits; the message lists the topics that there are.
    """
    candidates = [_Candidate.of(recording, topic) for topic in _readable(recording)]
    for key, name in named.items():
        if key not in KEYS:
            raise InputError(f"--topics: unknown key {key!r}, expected one of {', '.join(KEYS)}")
        if name != "none" and name not in (c.topic.name for c in candidates):
            raise InputError(f"no topic {name} of a usable type in {recording.path}; {_listing(recording)}")
    ranges = _select(candidates, named.get("range"), lambda c: c.is_range(range_from))
    if not ranges:
        wanted = {"points": "point clouds", "depth": "depth images"}.get(
            range_from, "point clouds or depth images"
        )
        raise InputError(f"no {wanted} in {recording.path}; {_listing(recording)}")
    colors = _select(candidates, named.get("color"), lambda c: c.is_color)
    infos = _select(candidates, named.get("camera_info"), lambda c: c.topic.type == CAMERA_INFO)

    color_sizes = {c.size for c in colors}
    ranges.sort(key=lambda c: (*c.range_rank(color_sizes), c.topic.name))
    chosen = ranges[0]
    colors.sort(key=lambda c: (*c.color_rank(chosen.size), c.topic.name))
    color = colors[0] if colors else None
    if color is not None and "color" not in named and chosen.has_color and color.size != chosen.size:
        color = None
    if color is None and not chosen.has_color:
        raise InputError(
            f"no colour image for {chosen.topic.name} in {recording.path}; {_listing(recording)}"
        )
    beside = [c for c in ((color, chosen) if chosen.is_cloud else (chosen, color)) if c is not None]
    infos.sort(key=lambda c: (*c.camera_rank(beside), c.topic.name))
    info = infos[0].topic.name if infos else None
    return InputTopics(chosen.topic.name, color.topic.name if color is not None else None, info)


def _readable(recording: Recording) -> list[Topic]:
    types = (CLOUD, IMAGE, COMPRESSED, CAMERA_INFO)
    return [t for _, t in sorted(recording.topics.items()) if t.type in types and t.count > 0]


def _select(
    candidates: list[_Candidate], name: str | None, fits: Callable[[_Candidate], bool]
) -> list[_Candidate]:
    """The candidate that the user named, none where the user wants none, else all that fit."""
    if name == "none":
        return []
    if name is not None:
        return [c for c in candidates if c.topic.name == name]
    return [c for c in candidates if fits(c) and not set(c.topic.name.split("/")) & {"truth", "rcseg"}]


def _listing(recording: Recording) -> str:
    rows = [f"{t.name} ({t.type}, {t.count})" for _, t in sorted(recording.topics.items())]
    return "it has " + (", ".join(rows) if rows else "no topic at all")


@dataclass(frozen=True)
class _Candidate:
    """A topic with what its first message tells."""

    topic: Topic
    size: tuple[int, int]  # rows, columns; (0, 0) where unknown
    encoding: str
    has_color: bool
    calibrated: bool

    @classmethod
    def of(cls, recording: Recording, topic: Topic) -> _Candidate:
        try:
            message = recording.first(topic.name)
        except InputError:
            message = None
        encoding = str(getattr(message, "encoding", getattr(message, "format", "")))
        size = (int(getattr(message, "height", 0)), int(getattr(message, "width", 0)))
        fields = {str(f.name) for f in getattr(message, "fields", ())}
        has_color = bool(fields & {"rgb", "rgba"}) or {"r", "g", "b"} <= fields
        return cls(topic, size, encoding, has_color, topic.type == CAMERA_INFO and _is_calibrated(message))

    @property
    def is_cloud(self) -> bool:
        return self.topic.type == CLOUD

    @property
    def is_depth(self) -> bool:
        """By encoding, which a label image shares."""
        if self.topic.type == COMPRESSED:
            return "compressedDepth" in self.encoding
        return self.topic.type == IMAGE and self.encoding in _DEPTH_ENCODINGS

    @property
    def is_color(self) -> bool:
        return self.topic.type in (IMAGE, COMPRESSED) and not self.is_depth

    def is_range(self, range_from: str) -> bool:
        return (self.is_cloud and range_from != "depth") or (self.is_depth and range_from != "points")

    def range_rank(self, color_sizes: set[tuple[int, int]]) -> tuple[bool, ...]:
        registered = "aligned" in self.topic.name or "registered" in self.topic.name
        return (
            self.size not in color_sizes,
            not self.is_cloud,
            not registered,
            self.topic.type == COMPRESSED,
        )

    def color_rank(self, range_size: tuple[int, int]) -> tuple[bool, ...]:
        grey = self.encoding in _GREY_ENCODINGS
        # The size of a compressed image is not told by its message: neither for nor against it.
        return (self.size not in (range_size, (0, 0)), grey, self.topic.type == COMPRESSED)

    def camera_rank(self, beside: list[_Candidate]) -> tuple[Any, ...]:
        parent = self.topic.name.rpartition("/")[0]
        kin = next((i for i, c in enumerate(beside) if c.topic.name.startswith(parent + "/")), len(beside))
        return (not self.calibrated, self.size not in {c.size for c in beside}, kin)


def _is_calibrated(message: Any) -> bool:
    try:
        decode_camera_info(message)
    except (InputError, AttributeError):
        return False
    return True
