"""The node's results on their topics, each computed only when somebody listens to it.

The labels go first: their publication ends the latency that a robot waits for. The others, which may take
longer than the segmentation itself, can follow on another thread while the next frame is in work. Markers are
drawn from the region message, so both share one.
"""

from __future__ import annotations

import threading
from typing import Any

import rclpy.qos
from rclpy.lifecycle import LifecycleNode
from rclpy.qos_overriding_options import QoSOverridingOptions, QoSPolicyKind
from sensor_msgs.msg import Image, PointCloud2
from visualization_msgs.msg import MarkerArray

from rcseg_core import RangeColorFrame, Segmentation
from rcseg_msgs.msg import ObjectArray, RegionArray, TrackArray
from rcseg_ros.frames.conversions import Header
from rcseg_ros.frames.up import NOTHING_TOLD, Told
from rcseg_ros.live.bridges import NodeBridges
from rcseg_ros.results.cdr import Serialized
from rcseg_ros.results.made import ResultMessages
from rcseg_ros.results.messages import make_rcl

try:
    from geometry_msgs.msg import PolygonInstanceStamped
except ImportError:  # of an older ROS: the polygons are in ~/regions alone
    PolygonInstanceStamped = None

# What the qos_overrides parameters may set, on inputs and outputs alike.
OVERRIDABLE = QoSOverridingOptions(
    policy_kinds=(
        QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY
    )
)  # fmt: skip
_TYPES = {
    "labels": Image,
    "surface_labels": Image,
    "regions": RegionArray,
    "overlay": Image,
    "edges": Image,
    "markers": MarkerArray,
    "reconstruction": PointCloud2,
    "class_mask": Image,
    "object_labels": Image,
    "objects": ObjectArray,
    "ground_points": PointCloud2,
    "obstacle_points": PointCloud2,
    "labelled_points": PointCloud2,
    "tracks": TrackArray,
}
if PolygonInstanceStamped is not None:
    _TYPES["polygons"] = PolygonInstanceStamped
#: Messages a frame that a subscriber may be late by; of polygons a frame has one a plane.
_DEPTH = {"polygons": 200}


def _qos(depth: int, latched: bool) -> rclpy.qos.QoSProfile:
    durability = (
        rclpy.qos.DurabilityPolicy.TRANSIENT_LOCAL if latched else rclpy.qos.DurabilityPolicy.VOLATILE
    )
    return rclpy.qos.QoSProfile(
        depth=depth, reliability=rclpy.qos.ReliabilityPolicy.RELIABLE, durability=durability
    )


#: What names of tracks are in.
NAMED = ("tracks", "regions", "markers", "objects", "polygons", "detections", "collision_objects")


class ResultPublishers:
    """Lifecycle publishers of all outputs, below the node's own name.

    Parameters
    ----------
    bridges : messages of other packages, or None
    """

    def __init__(self, node: LifecycleNode, bridges: NodeBridges | None = None) -> None:
        self._node = node
        self._bridges = bridges
        of_bridges = {} if bridges is None else bridges.topics
        self._latched = {name for name, (_, bridge) in of_bridges.items() if bridge.latched}
        self._lock = threading.Lock()  # held while a message is published and while the publishers go
        self._publishers = {
            name: node.create_lifecycle_publisher(
                kind,
                f"~/{name}",
                _qos(_DEPTH.get(name, 5), name in self._latched),
                qos_overriding_options=OVERRIDABLE,
            )
            for name, kind in (_TYPES | {name: kind for name, (kind, _) in of_bridges.items()}).items()
        }

    def messages(
        self,
        header: Header,
        frame: RangeColorFrame,
        result: Segmentation,
        geometry: str = "",
        told: Told = NOTHING_TOLD,
    ) -> ResultMessages:
        """The messages of a frame, each made when it is asked for."""
        return ResultMessages(header, frame, result, make_rcl, geometry, told)

    def wants_tracks(self) -> bool:
        """Whether somebody listens to what names are in."""
        return any(self._is_heard(name) for name in NAMED)

    def publish_labels(self, messages: ResultMessages) -> None:
        """Publish the labels if somebody listens."""
        if self._is_heard("labels"):
            self._publish("labels", messages.labels)

    def publish_rest(self, messages: ResultMessages) -> None:
        """Publish all else that somebody listens to."""
        for name in _TYPES:
            if name != "labels" and self._is_heard(name):
                made = getattr(messages, name)
                for message in made if isinstance(made, list) else [made]:
                    if message is not None:
                        self._publish(name, message)
        for name in [] if self._bridges is None else self._bridges.topics:
            if name in self._latched or self._is_heard(name):
                for message in self._bridges.messages(name, messages):
                    self._publish(name, message)
        self._latched = set()  # once is enough

    def destroy(self) -> None:
        with self._lock:
            for publisher in self._publishers.values():
                self._node.destroy_lifecycle_publisher(publisher)
            self._publishers = {}

    def _is_heard(self, name: str) -> bool:
        with self._lock:
            publisher = self._publishers.get(name)
            return publisher is not None and publisher.is_activated and publisher.get_subscription_count() > 0

    def _publish(self, name: str, message: Any) -> None:
        with self._lock:
            publisher = self._publishers.get(name)
            if publisher is not None and publisher.is_activated:
                publisher.publish(message.data if isinstance(message, Serialized) else message)
