"""`rcseg view`: the node's pictures without any ROS viewer, from a recording or from live topics.

A recording is segmented as `rcseg replay` does it, frame by frame at a watchable pace; a result bag is
shown as it lies; without a recording the topics of a running node are.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from rcseg_core import SegmenterConfig
from rcseg_core.errors import InputError
from rcseg_ros.commands.viewers import Shown
from rcseg_ros.frames.extrinsic import recorded_transforms
from rcseg_ros.frames.registration import Surroundings
from rcseg_ros.frames.sync import FrameSync, Pair
from rcseg_ros.recordings.bag import RawMessage, Recording
from rcseg_ros.recordings.naming import Namer, in_turn
from rcseg_ros.recordings.result_bag import result_types
from rcseg_ros.recordings.segmenting import OUTPUTS, FrameResult, FrameWork, Output
from rcseg_ros.recordings.topics import InputTopics, find_topics
from rcseg_ros.recordings.up import UpRequest, recorded_up
from rcseg_ros.results.marker_bytes import MARKER_ARRAY, marker_array
from rcseg_ros.results.markers import draw

TYPES = {
    "labels": "sensor_msgs/msg/Image",
    "surface_labels": "sensor_msgs/msg/Image",
    "regions": "rcseg_msgs/msg/RegionArray",
    "edges": "sensor_msgs/msg/Image",
    "overlay": "sensor_msgs/msg/Image",
    "reconstruction": "sensor_msgs/msg/PointCloud2",
    "markers": MARKER_ARRAY,
    "class_mask": "sensor_msgs/msg/Image",
    "object_labels": "sensor_msgs/msg/Image",
    "objects": "rcseg_msgs/msg/ObjectArray",
    "polygons": "geometry_msgs/msg/PolygonInstanceStamped",
    "tracks": "rcseg_msgs/msg/TrackArray",
}


class Viewer(Protocol):
    address: str

    def show(self, frame: Shown) -> None: ...

    def close(self) -> None: ...


@dataclass(frozen=True)
class ViewRequest:
    """What to show; `bag` None: the topics of the running node `node`."""

    bag: Path | None
    config: SegmenterConfig = field(default_factory=SegmenterConfig)
    node: str = "/rcseg"
    rate_hz: float = 2.0
    loop: bool = True
    up: UpRequest = field(default_factory=UpRequest)


def view(
    request: ViewRequest, viewers: list[Viewer], note: Callable[[str], None] = lambda text: None
) -> None:
    """Show frames until the recording ends, or for ever.

    Raises
    ------
    InputError
        Unusable recording; rclpy is missing for live topics; no usable frame.
    """
    frames = live_frames(request.node) if request.bag is None else recorded_frames(request, note)
    due = time.monotonic()
    for frame in frames:
        if request.bag is not None:
            time.sleep(max(0.0, due - time.monotonic()))
            due = time.monotonic() + 1.0 / request.rate_hz
        for viewer in viewers:
            viewer.show(frame)


def has_to_segment(request: ViewRequest) -> bool:
    """Whether the recording has to be segmented: a result bag is shown as it lies.

    Raises
    ------
    InputError
        If it can be neither.
    """
    assert request.bag is not None
    with Recording(request.bag) as recording:
        if f"{request.node}/labels" in recording.topics:
            return False
        find_topics(recording, {})
        return True


def recorded_frames(request: ViewRequest, note: Callable[[str], None]) -> Iterator[Shown]:
    """Frames of a recording, again and again if wanted."""
    assert request.bag is not None
    with Recording(request.bag) as recording:
        is_result = f"{request.node}/labels" in recording.topics
        while True:
            count = 0
            for frame in (
                _results(recording, request.node) if is_result else _segmented(recording, request, note)
            ):
                count += 1
                yield frame
            if not count:
                raise InputError(f"{request.bag}: no frame that can be shown; `rcseg replay` says why")
            if not request.loop:
                return


def _results(recording: Recording, node: str) -> Iterator[Shown]:
    """Frames of a result bag: the messages of one stamp."""
    names = {f"{node}/{name}": name for name in TYPES if f"{node}/{name}" in recording.topics}
    stamp, outputs = None, []
    for raw in recording.messages(set(names)):
        if stamp is not None and raw.stamp_ns != stamp:
            yield _with_markers(Shown(stamp, tuple(outputs)))
            outputs = []
        stamp = raw.stamp_ns
        outputs.append(Output(names[raw.topic], recording.topics[raw.topic].type, raw.data))
    if stamp is not None:
        yield _with_markers(Shown(stamp, tuple(outputs)))


def _segmented(recording: Recording, request: ViewRequest, note: Callable[[str], None]) -> Iterator[Shown]:
    inputs = find_topics(recording, {})
    transforms = recorded_transforms(recording, inputs.range, inputs.color)
    up = recorded_up(recording, inputs.range, request.config.world.up_from, request.up, transforms)
    around = Surroundings(inputs.range, inputs.color or "", transforms=transforms, up=up)
    work = FrameWork(
        request.config, recording.decode, OUTPUTS, around=around, segmenter=in_turn(recording, request.config)
    )
    name = Namer(recording, request.config)
    for pair in _pairs(recording, inputs):
        made = work.segment(pair)
        if isinstance(made, FrameResult):
            note(f"frame left out: {made.error}")
        else:
            name(made)
            yield _with_markers(Shown(pair.stamp_ns, work.encode(made).outputs))


def _pairs(recording: Recording, inputs: InputTopics) -> Iterator[Pair]:
    sync = FrameSync(
        with_color=inputs.color is not None,
        needs_camera=inputs.camera_info is not None,
        needs_range_camera=lambda pair: inputs.range_camera_info is not None,
    )
    add = sync.by_topic(inputs.range, inputs.color, inputs.camera_info, inputs.range_camera_info)
    for raw in recording.messages(set(inputs.names())):
        yield from add[raw.topic](raw.stamp_ns, raw)
    yield from sync.flush()


def _with_markers(frame: Shown) -> Shown:
    """The frame with markers drawn from its regions and objects, which bags do not hold."""
    store = result_types()
    given = {
        o.topic: store.deserialize_cdr(o.data, o.type)
        for o in frame.outputs
        if o.topic in ("regions", "labels", "objects")
    }
    if not {"regions", "labels"} <= given.keys():
        return frame
    array, labels = given["regions"], given["labels"]
    image = labels.data.view("<u2").reshape(labels.height, labels.width)
    made = marker_array(array.header, draw(array, image, given.get("objects")))
    return Shown(frame.stamp_ns, (*frame.outputs, Output("markers", made.type, made.data)))


def live_frames(node: str) -> Iterator[Shown]:
    """Outputs of a running node as they come; each message is shown at once.

    Raises
    ------
    InputError
        rclpy or the messages are not installed.
    """
    try:
        import rclpy
        from geometry_msgs.msg import PolygonInstanceStamped
        from sensor_msgs.msg import Image, PointCloud2
        from visualization_msgs.msg import MarkerArray

        from rcseg_msgs.msg import ObjectArray, RegionArray, TrackArray
        from rcseg_ros.live.manners import shut_down
    except ImportError:
        raise InputError("view: live topics need rclpy and rcseg_msgs; or name a recording") from None
    classes = {
        "Image": Image,
        "PointCloud2": PointCloud2,
        "RegionArray": RegionArray,
        "MarkerArray": MarkerArray,
        "ObjectArray": ObjectArray,
        "PolygonInstanceStamped": PolygonInstanceStamped,
        "TrackArray": TrackArray,
    }
    rclpy.init()
    listener = rclpy.create_node("rcseg_view")
    waiting: list[Shown] = []

    def listen(name: str, kind: str) -> None:
        def take(data: bytes) -> None:
            now_ns = time.time_ns()  # for markers, whose bytes do not begin with a header
            stamp_ns = now_ns if name == "markers" else RawMessage(name, now_ns, data).stamp_ns
            waiting.append(Shown(stamp_ns, (Output(name, kind, data),)))

        listener.create_subscription(classes[kind.split("/")[-1]], f"{node}/{name}", take, 5, raw=True)

    for name, kind in TYPES.items():
        listen(name, kind)
    try:
        while rclpy.ok():
            rclpy.spin_once(listener, timeout_sec=0.2)
            yield from waiting
            waiting.clear()
    finally:
        listener.destroy_node()
        shut_down()
