"""`rcseg view`: the node's pictures without any ROS viewer, from a recording or from live topics.

A recording is segmented as `rcseg replay` does it, frame by frame at a watchable pace; a result bag is
shown as it lies; without a recording the topics of a running node are.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from rosbags.interfaces import Nodetype

from rcseg_core import SegmenterConfig
from rcseg_core.errors import InputError
from rcseg_ros.bag import RawMessage, Recording
from rcseg_ros.markers import marker_array
from rcseg_ros.result_bag import make_message, result_types, serialize
from rcseg_ros.segmenting import OUTPUTS, FrameWork, Output
from rcseg_ros.sync import FrameSync, Pair
from rcseg_ros.topics import find_topics
from rcseg_ros.viewers import Shown

TYPES = {
    "labels": "sensor_msgs/msg/Image",
    "surface_labels": "sensor_msgs/msg/Image",
    "regions": "rcseg_msgs/msg/RegionArray",
    "edges": "sensor_msgs/msg/Image",
    "overlay": "sensor_msgs/msg/Image",
    "reconstruction": "sensor_msgs/msg/PointCloud2",
    "markers": "visualization_msgs/msg/MarkerArray",
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
    work = FrameWork(request.config, recording.decode, OUTPUTS)
    for pair in _pairs(recording):
        result = work(pair)
        if result.rejected:
            note(f"frame left out: {result.error}")
        else:
            yield _with_markers(Shown(pair.stamp_ns, result.outputs))


def _pairs(recording: Recording) -> Iterator[Pair]:
    inputs = find_topics(recording, {})
    sync = FrameSync(with_color=inputs.color is not None, needs_camera=inputs.camera_info is not None)
    add: dict[str | None, Callable[[int, RawMessage], list[Pair]]] = {
        inputs.range: sync.add_range,
        inputs.color: sync.add_color,
        inputs.camera_info: sync.add_camera,
    }
    for raw in recording.messages(set(inputs.names())):
        yield from add[raw.topic](raw.stamp_ns, raw)
    yield from sync.flush()


def _with_markers(frame: Shown) -> Shown:
    """The frame with markers drawn from its regions, which bags do not hold."""
    store = result_types()
    messages = {
        o.topic: store.deserialize_cdr(o.data, o.type)
        for o in frame.outputs
        if o.topic in ("regions", "labels")
    }
    if len(messages) < 2:
        return frame
    labels = messages["labels"]
    image = labels.data.view("<u2").reshape(labels.height, labels.width)
    markers = marker_array(messages["regions"], image, make_with_defaults)
    return Shown(frame.stamp_ns, (*frame.outputs, Output("markers", TYPES["markers"], serialize(markers))))


def make_with_defaults(type_name: str, **given: Any) -> Any:
    """`make_message` with ROS's defaults for whatever is not given, as rclpy does it."""
    if type_name == "geometry_msgs/msg/Quaternion":
        given = {"w": 1.0} | given
    fields = result_types().fielddefs[type_name][1]
    return make_message(
        type_name, **{name: given[name] if name in given else _default(kind) for name, kind in fields}
    )


def _default(kind: Any) -> Any:
    tag, content = kind
    if tag == Nodetype.NAME:
        return make_with_defaults(content)
    if tag == Nodetype.BASE:
        return {"string": "", "bool": False}.get(content[0], 0)
    (element, (name, *_)), _ = content
    return np.empty(0, name) if element == Nodetype.BASE and name != "string" else []


def live_frames(node: str) -> Iterator[Shown]:
    """Outputs of a running node as they come; each message is shown at once.

    Raises
    ------
    InputError
        rclpy or the messages are not installed.
    """
    try:
        import rclpy
        from sensor_msgs.msg import Image, PointCloud2
        from visualization_msgs.msg import MarkerArray

        from rcseg_msgs.msg import RegionArray
    except ImportError:
        raise InputError("view: live topics need rclpy and rcseg_msgs; or name a recording") from None
    classes = {
        "Image": Image,
        "PointCloud2": PointCloud2,
        "RegionArray": RegionArray,
        "MarkerArray": MarkerArray,
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
        rclpy.try_shutdown()
