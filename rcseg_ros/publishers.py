"""The node's results on their topics, each computed only when somebody listens to it.

The labels go first: their publication ends the latency that a robot waits for. Markers are drawn from the
region message, so both share one.
"""

from __future__ import annotations

from collections.abc import Callable

import rclpy.qos
from rclpy.lifecycle import LifecycleNode
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import Image, PointCloud2
from visualization_msgs.msg import MarkerArray

from rcseg_core import RangeColorFrame, Segmentation
from rcseg_msgs.msg import RegionArray
from rcseg_ros.conversions import Header
from rcseg_ros.markers import marker_array
from rcseg_ros.messages import make_rcl
from rcseg_ros.results import ResultMessages

_TYPES = {
    "labels": Image,
    "surface_labels": Image,
    "regions": RegionArray,
    "overlay": Image,
    "edges": Image,
    "markers": MarkerArray,
    "reconstruction": PointCloud2,
}


class ResultPublishers:
    """Lifecycle publishers of all outputs, below the node's own name."""

    def __init__(self, node: LifecycleNode) -> None:
        self._node = node
        self._publishers = {
            name: node.create_lifecycle_publisher(
                kind,
                f"~/{name}",
                rclpy.qos.QoSProfile(depth=5, reliability=rclpy.qos.ReliabilityPolicy.RELIABLE),
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )
            for name, kind in _TYPES.items()
        }

    def publish(
        self, header: Header, frame: RangeColorFrame, result: Segmentation, labels_sent: Callable[[], None]
    ) -> None:
        """Publish what has subscribers; `labels_sent` is called when the labels are out."""
        messages = ResultMessages(header, frame, result, make_rcl)
        for name, publisher in self._publishers.items():
            if publisher.is_activated and publisher.get_subscription_count():
                if name == "markers":
                    publisher.publish(marker_array(messages.regions, result.labels, make_rcl))
                else:
                    publisher.publish(getattr(messages, name))
            if name == "labels":
                labels_sent()

    def destroy(self) -> None:
        for publisher in self._publishers.values():
            self._node.destroy_lifecycle_publisher(publisher)
