"""The node's input topics and their pairing policy: which range topic counts, whose colour, which camera.

Runs on the executor's thread and only pairs; decoding images and clouds is the worker's. What `auto` means
is decided here, from what arrives and from which topics have publishers, so that a node works with most
drivers before any parameter is set. Once a second it looks at itself: is what it hears paired?
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2

from rcseg_ros.frames.conversions import decode_camera_info, header_of
from rcseg_ros.frames.extrinsic import rigid
from rcseg_ros.frames.registration import registered_by_name, same_frame
from rcseg_ros.frames.sync import FrameSync, Pair
from rcseg_ros.live.health import Health
from rcseg_ros.live.hearing import Complaint, Hearing
from rcseg_ros.live.parameters import NodeParameters
from rcseg_ros.live.subscriptions import AdaptiveSubscription
from rcseg_ros.live.transport import remedy

_TYPES = {
    "points": PointCloud2,
    "depth": Image,
    "image": Image,
    "camera_info": CameraInfo,
    "depth_camera_info": CameraInfo,
}
_CAMERAS = ("camera_info", "depth_camera_info")
_COMPRESSED = {"depth": "/compressedDepth", "image": "/compressed"}  # as image_transport names them
_ARRIVAL_SLOP_NS = 200_000_000  # messages without a stamp: of one frame where no nearer one comes


class Inputs:
    """Subscriptions of the inputs; silent until `start`.

    Parameters
    ----------
    on_pair : called with each pair and the monotonic time in seconds at which its last message arrived
    on_error : called with an exception and the topic whose message caused it
    """

    def __init__(
        self,
        node: Node,
        parameters: NodeParameters,
        health: Health,
        on_pair: Callable[[Pair, float], None],
        on_error: Callable[[Exception, str], None],
    ) -> None:
        self._node = node
        self._parameters = parameters
        self._health = health
        self._on_pair = on_pair
        self._on_error = on_error
        self._listening = False
        self._subscriptions: dict[str, AdaptiveSubscription] = {}
        self._sync = FrameSync()
        self.start_anew()
        wanted = [t for t in _TYPES if self._source in ("auto", t) or t in ("image", *_CAMERAS)]
        self._subscriptions = {topic: self._subscribe(topic) for topic in wanted}

    def _subscribe(self, topic: str) -> AdaptiveSubscription:
        compressed = self._parameters["input.transport"] == "compressed" and topic in _COMPRESSED
        kind, name = _TYPES[topic], topic
        if compressed:
            kind, name = CompressedImage, self._node.resolve_topic_name(topic)
            name += "" if name.endswith(_COMPRESSED[topic]) else _COMPRESSED[topic]
        return AdaptiveSubscription(
            self._node,
            kind,
            name,
            lambda message: self._on_message(topic, message),
            self._parameters["qos.reliability"],
            self._parameters["qos.depth"],
            latched=topic in _CAMERAS,
        )

    @property
    def topics(self) -> list[str]:
        """Resolved names of the topics."""
        return [subscription.topic for subscription in self._subscriptions.values()]

    def name_of(self, topic: str) -> str:
        """Resolved name of an input, which tells what it holds; empty where it is not subscribed to."""
        return self._subscriptions[topic].topic if topic in self._subscriptions else ""

    @property
    def drops(self) -> dict[str, int]:
        """Messages that found no partner, by reason, since the last configure."""
        return dict(self._sync.drops)

    def start(self) -> None:
        """Listen, with nothing remembered from before."""
        self.start_anew()
        self._listening = True

    def start_anew(self) -> None:
        """Forget what waits for a partner, as when time jumps back."""
        self._source = self._parameters["input.range_from"]
        self._unstamped: set[str] = set()
        self._stamped: set[str] = set()
        self._sync.let_go()
        before, self._sync = (
            self._sync,
            FrameSync(
                queue_size=self._parameters["sync.queue"], needs_range_camera=self._has_own_camera, live=True
            ),
        )
        self._sync.drops.update(before.drops)
        self._pair_by(stamps=True)
        for subscription in self._subscriptions.values():
            subscription.ask_again()

    def _pair_by(self, *, stamps: bool) -> list[Pair]:
        """Pair by stamp, or by arrival; what waits without the stamp that is needed is let go."""
        offset_ms, slop_ns = self._parameters["sync.offset_ms"], round(self._parameters["sync.slop_ms"] * 1e6)
        self._sync.slop_ns = slop_ns if stamps else max(slop_ns, _ARRIVAL_SLOP_NS)
        self._sync.offset_ns = 0 if offset_ms == "auto" or not stamps else round(offset_ms * 1e6)
        self._hearing = Hearing()
        return self._sync.start_anew(lambda message: (stamps and header_of(message).stamp_ns) or None)

    def stop(self) -> None:
        """Let messages pass unread; the subscriptions stay, so that a start is quick."""
        self._listening = False
        self._sync.let_go()

    def destroy(self) -> None:
        for subscription in self._subscriptions.values():
            subscription.destroy()

    def review(self) -> Complaint | None:
        """Once a second: fit the subscriptions to the publishers; say why nothing is paired, if so."""
        for subscription in self._subscriptions.values():
            subscription.review()
        if not self._listening:
            return None
        now_ns = time.monotonic_ns()
        names = {topic: subscription.topic for topic, subscription in self._subscriptions.items()}
        losses = self._hearing.losses()
        for topic, (lost, came) in losses.items():
            self._health.note(f"lost.{topic}", f"{lost} of the latest {lost + came}; {remedy(os.environ)}")
        if self._hearing.silence(self._range_topic, now_ns):
            complaint = self._hearing.missing(names, self._published(), self._wanted(), now_ns)
            complaint = complaint or self._hearing.apart(
                self._range_topic, names, self._sync.slop_ns, self._sync.offset_ns
            )
            if complaint is not None:
                return complaint
        for topic, (lost, came) in losses.items():
            share = f"{lost} of the latest {lost + came} messages of {names[topic]} were lost on their way"
            return Complaint(f"lost_{topic}", f"{share}: {remedy(os.environ)}")
        return None

    def _wanted(self) -> list[str]:
        wanted = ["points|depth"] if self._source == "auto" else [self._source]
        if self._sync.with_color and self._parameters["input.color_from"] != "cloud":
            wanted.append("image")
        return wanted + [topic for topic in _CAMERAS if topic in self._sync.awaited]

    @property
    def _range_topic(self) -> str:
        return "points" if self._source == "auto" else str(self._source)

    def _published(self) -> dict[str, str]:
        """What the graph knows of each input: "here", another form of it, or nothing."""
        found = {}
        for topic, subscription in self._subscriptions.items():
            other = subscription.topic + _COMPRESSED.get(topic, "")
            if subscription.publishers():
                found[topic] = "here"
            elif other != subscription.topic and self._node.count_publishers(other):
                found[topic] = other
        return found

    def _on_message(self, topic: str, message: Any) -> None:
        if not self._listening:
            return
        arrived_s = time.monotonic()
        self._health.count(f"received.{topic}")
        try:
            pairs = self._take(topic, message)
        except Exception as error:
            self._on_error(error, topic)
            return
        if pairs:
            self._hearing.paired()
        for pair in pairs:
            self._on_pair(pair, arrived_s)

    def _take(self, topic: str, message: Any) -> list[Pair]:
        """Pair by the stamp, or, while one of the drivers stamps zero, by the arrival of both."""
        now_ns, stamp_ns = time.monotonic_ns(), header_of(message).stamp_ns
        if topic in _CAMERAS:
            return self._pair(topic, stamp_ns, message)
        if not stamp_ns and topic in self._stamped:  # the next one tells whether the driver has changed
            self._stamped.discard(topic)
            self._health.count(f"dropped.unstamped_{topic}")
            return []
        before = bool(self._unstamped)
        if stamp_ns:
            self._stamped.add(topic)
            self._unstamped.discard(topic)
        else:
            self._unstamped.add(topic)
        pairs = self._pair_by(stamps=before) if bool(self._unstamped) != before else []
        pairing_ns = now_ns if self._unstamped else stamp_ns
        self._hearing.heard(topic, pairing_ns, now_ns, len(getattr(message, "data", ())))
        return pairs + self._pair(topic, pairing_ns, message)

    def _measure_offset(self) -> None:
        """With sync.offset_ms auto: where nothing pairs, take over the offset of neighbours by arrival."""
        if self._unstamped or not self._hearing.silence(self._range_topic, time.monotonic_ns()):
            return
        found = self._hearing.steady_offset(self._range_topic, self._sync.slop_ns)
        if found is not None and abs(found - self._sync.offset_ns) > self._sync.slop_ns:
            self._health.note("sync.offset_ms", f"{found / 1e6:.1f}")
            self._node.get_logger().info(f"sync.offset_ms: {found / 1e6:.1f} ms measured and taken over")
            self._sync.start_anew()
            self._sync.offset_ns = found

    def _pair(self, topic: str, pairing_ns: int, message: Any) -> list[Pair]:
        color_from, camera = self._parameters["input.color_from"], self._parameters["input.camera"]
        if topic == "camera_info":
            if camera == "none":
                return []
            decode_camera_info(message)  # one that cannot be used must not take the place of one that can
            self._hearing.heard(topic, pairing_ns, time.monotonic_ns(), 0)
            return self._sync.add_camera(pairing_ns, message)
        if topic == "depth_camera_info":
            decode_camera_info(message)
            self._hearing.heard(topic, pairing_ns, time.monotonic_ns(), 0)
            return self._sync.add_range_camera(pairing_ns, message)
        if topic == "image":
            return [] if color_from == "cloud" else self._sync.add_color(pairing_ns, message)
        if self._source == "auto":
            self._source = topic
        if topic != self._source:
            self._health.count(f"dropped.second_source_{topic}")
            return []
        self._sync.with_color = color_from == "image" or (
            color_from == "auto" and (topic == "depth" or self._is_published("image"))
        )
        must_know = topic == "depth" or message.height == 1  # a depth image, an unorganised cloud
        self._sync.needs_camera = camera == "required" or (
            camera == "auto" and (must_know or self._is_published("camera_info"))
        )
        if self._parameters["sync.offset_ms"] == "auto":
            self._measure_offset()
        return self._sync.add_range(pairing_ns, message)

    def _has_own_camera(self, pair: Pair) -> bool:
        """Whether depth is of another camera than its colour image, and a camera_info of it is published."""
        if hasattr(pair.range, "fields") or pair.color is None:
            return False
        keys = ("input.extrinsic_translation", "input.extrinsic_rotation")
        moved = rigid(*(self._parameters[key] for key in keys)) is not None
        if not moved:
            one, other = header_of(pair.range).frame_id, header_of(pair.color).frame_id
            named = registered_by_name(self.name_of("depth"), self.name_of("image"))
            moved = not (same_frame(one, other) or named or self._parameters["input.assume_registered"])
        return moved and self._is_published("depth_camera_info")

    def _is_published(self, topic: str) -> bool:
        return self._subscriptions[topic].publishers() > 0
