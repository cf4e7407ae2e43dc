"""The node's input topics and their pairing policy: which range topic counts, whose colour, which camera.

Runs on the executor's thread and only pairs; decoding images and clouds is the worker's. What `auto` means
is decided here, from what arrives and from which topics have publishers, so that a node works with most
drivers before any parameter is set.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from rcseg_ros.conversions import decode_camera_info, header_of
from rcseg_ros.health import Health
from rcseg_ros.parameters import NodeParameters
from rcseg_ros.subscriptions import AdaptiveSubscription
from rcseg_ros.sync import FrameSync, Pair

_TYPES = {"points": PointCloud2, "depth": Image, "image": Image, "camera_info": CameraInfo}


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
        self._parameters = parameters
        self._health = health
        self._on_pair = on_pair
        self._on_error = on_error
        self._listening = False
        self.start_anew()
        wanted = [t for t in _TYPES if self._source in ("auto", t) or t in ("image", "camera_info")]
        self._subscriptions = {
            topic: AdaptiveSubscription(
                node,
                _TYPES[topic],
                topic,
                lambda message, topic=topic: self._on_message(topic, message),
                parameters["qos.reliability"],
                parameters["qos.depth"],
            )
            for topic in wanted
        }

    @property
    def topics(self) -> list[str]:
        """Resolved names of the topics."""
        return [subscription.topic for subscription in self._subscriptions.values()]

    @property
    def drops(self) -> dict[str, int]:
        """Messages that found no partner, by reason, since the last start."""
        return dict(self._sync.drops)

    def start(self) -> None:
        """Listen, with nothing remembered from before."""
        self.start_anew()
        self._listening = True

    def start_anew(self) -> None:
        """Forget what waits for a partner, as when time jumps back."""
        self._source = self._parameters["input.range_from"]
        slop_ns = round(self._parameters["sync.slop_ms"] * 1e6)
        self._sync = FrameSync(slop_ns=slop_ns, queue_size=self._parameters["sync.queue"], live=True)

    def stop(self) -> None:
        """Let messages pass unread; the subscriptions stay, so that a start is quick."""
        self._listening = False

    def destroy(self) -> None:
        for subscription in self._subscriptions.values():
            subscription.destroy()

    def _on_message(self, topic: str, message: Any) -> None:
        if not self._listening:
            return
        arrived_s = time.monotonic()
        self._health.count(f"received.{topic}")
        try:
            # Drivers without a clock stamp zero: then the time of arrival pairs.
            pairs = self._pair(topic, header_of(message).stamp_ns or time.time_ns(), message)
        except Exception as error:
            self._on_error(error, topic)
            return
        for pair in pairs:
            self._on_pair(pair, arrived_s)

    def _pair(self, topic: str, stamp_ns: int, message: Any) -> list[Pair]:
        color_from, camera = self._parameters["input.color_from"], self._parameters["input.camera"]
        if topic == "camera_info":
            if camera == "none":
                return []
            decode_camera_info(message)  # one that cannot be used must not take the place of one that can
            return self._sync.add_camera(stamp_ns, message)
        if topic == "image":
            return [] if color_from == "cloud" else self._sync.add_color(stamp_ns, message)
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
        return self._sync.add_range(stamp_ns, message)

    def _is_published(self, topic: str) -> bool:
        return self._subscriptions[topic].publishers() > 0
