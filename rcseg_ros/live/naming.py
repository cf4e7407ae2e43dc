"""Tracks in the node: one tracker, fed with every frame that is segmented while somebody wants names.

What the last frame decided goes into the segmentation of the next here too, where that is asked for.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rcseg_core import RangeColorFrame, Segmentation, SegmenterConfig
from rcseg_core.errors import ConfigError
from rcseg_core.tracking import Segmenter, Tracker
from rcseg_ros.frames.conversions import Header
from rcseg_ros.frames.extrinsic import TransformTree
from rcseg_ros.frames.poses import PoseSource
from rcseg_ros.results.made import Named, ResultMessages

ODOMETRY_TOPIC = "odom"


class Naming:
    """Names for the labels of frames, with the poses that parameters ask for.

    Parameters
    ----------
    node : creates the subscription of odometry
    parameters : of the node, by key, and the configuration as `config`
    tree : the transforms that the node hears

    Raises
    ------
    ConfigError
        Poses by tf without a fixed frame, or without `input.use_tf`.
    """

    def __init__(self, node: Any, parameters: Any, tree: TransformTree) -> None:
        self._node, self._parameters = node, parameters
        source, fixed_frame = parameters["tracks.pose_from"], parameters["tracks.fixed_frame"]
        if source == "tf" and not (fixed_frame and parameters["input.use_tf"]):
            raise ConfigError(
                "tracks.pose_from = tf: give tracks.fixed_frame (map, odom) and set input.use_tf"
            )
        self._poses = PoseSource(tree, fixed_frame) if source != "none" else None
        self._config = parameters.config.tracking
        self._tracker, self._segmenter = Tracker(self._config), Segmenter(parameters.config)
        self._subscription = None
        if source == "odometry":
            from nav_msgs.msg import Odometry
            from rclpy.qos import QoSProfile, ReliabilityPolicy

            quality = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)  # hears both kinds
            self._subscription = node.create_subscription(
                Odometry, ODOMETRY_TOPIC, self._poses.add_odometry, quality
            )

    def segment(self, frame: RangeColorFrame, header: Header, config: SegmenterConfig) -> Segmentation:
        """The result of the next frame, which stands alone unless `tracking.stability` is above 0."""
        self._segmenter.config = config
        return self._segmenter.segment(frame, header.stamp_ns, self._pose(header))

    def _pose(self, header: Header) -> Any:
        return None if self._poses is None else self._poses.pose(header.frame_id, header.stamp_ns)

    def name(
        self, messages: ResultMessages, header: Header, result: Segmentation, wanted: Callable[[], bool]
    ) -> Named | None:
        """The names of a frame; None where nobody wants them."""
        run, images = self._parameters["tracks.run"], self._parameters["tracks.label_images"]
        if run == "never" or (run == "auto" and not (images or wanted())):
            return None
        if self._parameters.config.tracking != self._config:  # ids go on, tracks begin anew
            self._config = self._parameters.config.tracking
            self._tracker.reconfigure(self._config)
        tracks = self._tracker.update(result, header.stamp_ns, self._pose(header), messages.world)
        return Named(tracks, "" if self._poses is None else self._poses.fixed_frame, images)

    def destroy(self) -> None:
        """End the subscription."""
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
