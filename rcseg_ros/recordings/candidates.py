"""What each recorded topic could be for rcseg: told by its type, its first message and the words of its name.

An image is depth or colour by its encoding, also where it is compressed; the words of the name decide where
the encoding leaves it open: mono16 is depth in ``depth/image`` and a grey picture in ``ir/image``.
"""

from __future__ import annotations

import re
import struct
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_core.errors import InputError
from rcseg_ros.frames.conversions import decode_camera_info
from rcseg_ros.recordings.bag import Recording, Topic

CLOUD, IMAGE = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Image"
COMPRESSED, CAMERA_INFO = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
REGIONS = "rcseg_msgs/msg/RegionArray"
_DEPTH_ENCODINGS = ("16uc1", "16sc1", "32sc1", "32fc1", "64fc1")  # in lower case: drivers write both
_GREY_ENCODINGS = ("mono8", "8uc1", "mono16")
#: Words of names that say what else an image of one channel may be.
_NO_DEPTH = {
    "amplitude", "confidence", "cost", "disparity", "infra", "infrared", "instance", "intensity", "ir",
    "label", "labels", "mask", "masks", "reflectivity", "segmentation", "semantic", "thermal", "uncertainty",
    "variance",
}  # fmt: skip
#: Words of names of pictures that are not the scene's colours.
_NO_COLOR = _NO_DEPTH | {"annotated", "debug", "depth", "detections", "heatmap", "overlay", "visualization"}
_COLOR = {"bgr", "color", "colour", "rgb"}
_VIDEO = {"h264": "H.264", "avc": "H.264", "avc1": "H.264", "x264": "H.264", "h265": "H.265", "hevc": "H.265",
          "x265": "H.265", "av1": "AV1", "vp8": "VP8", "vp9": "VP9", "theora": "Theora"}  # fmt: skip
_VIDEO_TYPE = re.compile(r"/(CompressedVideo|FFMPEGPacket|Packet)$")
_TRIES = 5  # messages that are looked at, should the first not be whole


@dataclass(frozen=True)
class Candidate:
    """A topic with what its first message tells.

    ``role``: "cloud", "depth", "color", "camera", or "" where it is none of these, for the reason ``what``;
    ``what``: a few words on it; ``size``: rows, columns, (0, 0) where unknown; ``frame_id``: empty where
    unknown; ``maybe_depth``: 16 bit grey, of which nothing says whether it is depth; ``reserved``: truth, or
    a result of rcseg, taken only when named; ``advice``: how to make readable what is not.
    """

    topic: Topic
    role: str
    what: str
    size: tuple[int, int] = (0, 0)
    frame_id: str = ""
    has_color: bool = False
    calibrated: bool = False
    grey: bool = False
    maybe_depth: bool = False
    reserved: bool = False
    advice: str = ""

    @property
    def name(self) -> str:
        return self.topic.name

    @property
    def odd(self) -> str:
        """Words of the name that speak against colours of the scene."""
        found = words_of(self.name)
        forgiven = {"depth"} if found & _COLOR else set()
        return ", ".join(sorted((found & _NO_COLOR) - forgiven))

    @property
    def is_compressed(self) -> bool:
        return self.topic.type == COMPRESSED

    def same_size(self, other: Candidate) -> bool:
        """Whether both are of one grid, as far as is known."""
        return self.size == other.size or (0, 0) in (self.size, other.size)

    def same_frame(self, other: Candidate) -> bool:
        """Whether both are of one coordinate frame, as far as is known."""
        return self.frame_id == other.frame_id or not (self.frame_id and other.frame_id)

    def kinship(self, other: Candidate) -> int:
        """How many parts of their names agree, from the beginning."""
        pairs = zip(self.name.split("/"), other.name.split("/"), strict=False)
        return next((i for i, (a, b) in enumerate(pairs) if a != b), 99)


def words_of(name: str) -> set[str]:
    """The words of a topic's name, in small letters, without numbers."""
    return set(re.split(r"[^a-z]+", name.lower()))


def candidates_of(recording: Recording) -> list[Candidate]:
    """Every topic of a recording, in the order of names; results of a node of rcseg are none."""
    topics = [topic for _, topic in sorted(recording.topics.items())]
    parents = {t.name.rpartition("/")[0] for t in topics if t.type == REGIONS}
    nodes = tuple(parent + "/" for parent in parents if parent)
    found = []
    for topic in topics:
        if not topic.count:
            found.append(Candidate(topic, "", "without messages"))
        elif topic.encoding != "cdr":
            found.append(Candidate(topic, "", f"messages are {topic.encoding}, not CDR"))
        else:
            own = set(topic.name.split("/")) & {"truth", "rcseg"} or topic.name.startswith(nodes)
            found.append(replace(_candidate(recording, topic), reserved=bool(own)))
    return found


def _candidate(recording: Recording, topic: Topic) -> Candidate:
    message = _first(recording, topic)
    head = getattr(message, "header", None)
    frame_id = str(getattr(head, "frame_id", "")).lstrip("/")
    size = (int(getattr(message, "height", 0)), int(getattr(message, "width", 0)))
    if topic.type == CLOUD:
        fields = {str(f.name) for f in getattr(message, "fields", ())}
        has_color = bool(fields & {"rgb", "rgba"}) or {"r", "g", "b"} <= fields
        what = "cloud with colour" if has_color else "cloud"
        return Candidate(topic, "cloud", what, size, frame_id, has_color)
    if topic.type == CAMERA_INFO:
        calibrated = _is_calibrated(message)
        what = "camera_info" if calibrated else "camera_info without calibration"
        return Candidate(topic, "camera", what, size, frame_id, calibrated=calibrated)
    if topic.type == IMAGE:
        encoding = str(getattr(message, "encoding", ""))
        role = "depth" if _is_depth(topic.name, encoding) else "color"
        return Candidate(
            topic, role, f"{encoding or 'unreadable'} image", size, frame_id,
            grey=encoding.lower() in _GREY_ENCODINGS, maybe_depth=encoding.lower() == "mono16",
        )  # fmt: skip
    codec = _video(topic, message)
    if topic.type == COMPRESSED and not codec:
        return _of_compressed(topic, message, frame_id)
    if codec:
        what = f"{codec} video, which rcseg does not read"
        return Candidate(topic, "", what, size, frame_id, advice=f"{what}: {_republish(topic, message)}")
    if topic.type.endswith("/CompressedPointCloud2"):
        what = "a compressed cloud, which rcseg does not read"
        return Candidate(topic, "", what, advice=f"{what}: {_republish(topic, message)}")
    return Candidate(topic, "", "not a type of image, cloud or camera")


def _is_depth(name: str, encoding: str) -> bool:
    words = words_of(name)
    if words & _NO_DEPTH:
        return False
    encoding = encoding.lower()
    return encoding in _DEPTH_ENCODINGS or (encoding == "mono16" and "depth" in words)


def _of_compressed(topic: Topic, message: Any, frame_id: str) -> Candidate:
    """A picture file or a compressedDepth: the encoding before it was compressed stands in its format."""
    form = str(getattr(message, "format", ""))
    data = np.asarray(getattr(message, "data", ()), np.uint8)
    encoding = form.partition(";")[0].strip() if ";" in form else ""
    what = f"compressed image ({form.strip() or 'unknown format'})"
    if "compresseddepth" in (form + topic.name.rpartition("/")[2]).lower():
        return Candidate(topic, "depth", what, _size_of_depth(data), frame_id)
    picture = _picture(data)
    size = (0, 0) if picture is None else (picture.shape[0], picture.shape[1])
    deep = picture is not None and picture.dtype != np.uint8 and picture.ndim == 2
    if _is_depth(topic.name, encoding) or (deep and not encoding and _is_depth(topic.name, "mono16")):
        if picture is not None and not deep:
            return Candidate(topic, "", f"{what}: depth squeezed into 8 bit is lost", size, frame_id)
        return Candidate(topic, "depth", what, size, frame_id)
    grey = encoding.lower() in _GREY_ENCODINGS or (picture is not None and picture.ndim == 2)
    return Candidate(topic, "color", what, size, frame_id, grey=grey, maybe_depth=deep)


def _picture(data: NDArray[np.uint8]) -> NDArray[Any] | None:
    try:
        return cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    except cv2.error:
        return None


def _size_of_depth(data: NDArray[np.uint8]) -> tuple[int, int]:
    """Rows and columns of a compressedDepth: a PNG, or RVL with columns and rows, behind 12 bytes."""
    picture = _picture(data[12:])
    if picture is not None:
        return picture.shape[0], picture.shape[1]
    if len(data) < 20:
        return 0, 0
    cols, rows = struct.unpack_from("<II", data, 12)
    return (rows, cols) if max(rows, cols) < 2**16 else (0, 0)


def _video(topic: Topic, message: Any) -> str:
    """Name of a video's codec; empty for what is no video."""
    form = " ".join(str(getattr(message, name, "")) for name in ("format", "encoding")).lower()
    codec = next((name for word in re.split(r"[^a-z0-9]+", form.replace("lib", ""))
                  if (name := _VIDEO.get(word))), "")  # fmt: skip
    if topic.type == COMPRESSED:
        return codec
    if topic.type.startswith("theora"):
        return "Theora"
    return (codec or "compressed") if _VIDEO_TYPE.search(topic.type) else ""


def _republish(topic: Topic, message: Any) -> str:
    """The command that makes plain messages of those of a transport."""
    package, transport = "image_transport", "theora"
    if topic.type.endswith("/CompressedPointCloud2"):
        package, transport = "point_cloud_transport", str(getattr(message, "format", "")) or "draco"
    elif topic.type.endswith("/CompressedVideo"):
        transport = "foxglove"
    elif not topic.type.startswith("theora"):
        transport = "ffmpeg"
    return (
        f"play it through `ros2 run {package} republish --ros-args -p in_transport:={transport} "
        f"-p out_transport:=raw -r in/{transport}:={topic.name} -r out:={topic.name}/raw` and record that"
    )


def _first(recording: Recording, topic: Topic) -> Any | None:
    with suppress(InputError):
        return recording.first(topic.name)
    for raw in islice(recording.messages([topic.name]), 1, _TRIES):
        with suppress(InputError):
            return recording.decode(raw)
    return None


def _is_calibrated(message: Any) -> bool:
    try:
        decode_camera_info(message)
    except (InputError, AttributeError):
        return False
    return True
