"""The node's results on their topics, each computed only when somebody listens to it.

The labels go first: their publication ends the latency that a robot waits for. Markers are drawn from the
region message, so both share one.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import rclpy.qos
from rclpy.lifecycle import LifecycleNode
from rclpy.qos_overriding_options import QoSOverridingOptions
from rcseg_core.drawing import overlay
from sensor_msgs.msg import Image, PointCloud2
from visualization_msgs.msg import MarkerArray

from rcseg_core import RangeColorFrame, Segmentation
from rcseg_msgs.msg import RegionArray
from rcseg_ros.conversions import Header
from rcseg_ros.markers import marker_array
from rcseg_ros.messages import make_rcl, region_array
from rcseg_ros.outputs import cloud_message, edges_message, header_message, labels_message, picture_message


class _Outputs:
    """Every output message of one frame, made on demand."""

    def __init__(self, header: Header, frame: RangeColorFrame, result: Segmentation) -> None:
        self._header = header_message(header, make_rcl)
        self._frame = frame
        self._result = result

    def labels(self) -> Image:
        return labels_message(self._result.labels, self._header, make_rcl)

    def surface_labels(self) -> Image:
        return labels_message(self._result.surface_labels, self._header, make_rcl)

    def regions(self) -> RegionArray:
        return self._region_array

    def overlay(self) -> Image:
        return picture_message(overlay(self._frame.color, self._result.labels), self._header, make_rcl)

    def edges(self) -> Image:
        return edges_message(self._result.edges, self._header, make_rcl)

    def markers(self) -> MarkerArray:
        return marker_array(self._region_array, self._result.labels, make_rcl)

    def reconstruction(self) -> PointCloud2:
        points, color = self._result.reconstruct()
        return cloud_message(points, color, self._result.labels, self._header, make_rcl)

    @cached_property
    def _region_array(self) -> RegionArray:
        return region_array(self._frame, self._result, self._header, make_rcl)


_TOPICS: dict[str, tuple[type, Callable[[_Outputs], Any]]] = {
    "labels": (Image, _Outputs.labels),
    "surface_labels": (Image, _Outputs.surface_labels),
    "regions": (RegionArray, _Outputs.regions),
    "overlay": (Image, _Outputs.overlay),
    "edges": (Image, _Outputs.edges),
    "markers": (MarkerArray, _Outputs.markers),
    "reconstruction": (PointCloud2, _Outputs.reconstruction),
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
            for name, (kind, _) in _TOPICS.items()
        }

    def publish(
        self, header: Header, frame: RangeColorFrame, result: Segmentation, labels_sent: Callable[[], None]
    ) -> None:
        """Publish what has subscribers; `labels_sent` is called when the labels are out."""
        outputs = _Outputs(header, frame, result)
        for name, (_, build) in _TOPICS.items():
            publisher = self._publishers[name]
            if publisher.is_activated and publisher.get_subscription_count():
                publisher.publish(build(outputs))
            if name == "labels":
                labels_sent()

    def destroy(self) -> None:
        for publisher in self._publishers.values():
            self._node.destroy_lifecycle_publisher(publisher)
