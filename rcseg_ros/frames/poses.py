"""Where the sensor is in the fixed frame at the stamp of a frame: by tf, by odometry, or not known."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_ros.frames.extrinsic import TransformTree, frame_name

ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
#: Largest time between a frame and the nearest sample of a moving transform.
REACH_NS = 200_000_000
#: What may tell poses.
POSE_SOURCES = ("none", "tf", "odometry")


class _Transform:
    """The parts of a TransformStamped that `TransformTree.add` reads, of an Odometry."""

    def __init__(self, odometry: Any) -> None:
        pose = odometry.pose.pose
        self.header, self.child_frame_id = odometry.header, odometry.child_frame_id
        self.transform = self
        self.translation, self.rotation = pose.position, pose.orientation
        self.transforms = [self]


class PoseSource:
    """Poses of sensors from a tree of transforms.

    Parameters
    ----------
    tree : filled by whoever hears /tf and /tf_static
    fixed_frame : name of the fixed frame; "": with odometry that of its messages, else none is known
    """

    def __init__(self, tree: TransformTree, fixed_frame: str = "") -> None:
        self._tree = tree
        self.fixed_frame = frame_name(fixed_frame)

    def add_odometry(self, message: Any) -> None:
        """Take in a nav_msgs/Odometry."""
        if not self.fixed_frame:
            self.fixed_frame = frame_name(message.header.frame_id)
        self._tree.add(_Transform(message), fixed=False)

    def pose(self, sensor_frame: str, stamp_ns: int) -> NDArray[np.float64] | None:
        """(4, 4) the sensor in the fixed frame; None where no chain of transforms tells it."""
        if not self.fixed_frame:
            return None
        return self._tree.lookup(self.fixed_frame, sensor_frame, stamp_ns, REACH_NS)


def recorded_poses(recording: Any, fixed_frame: str = "") -> PoseSource:
    """The poses of a recording: by transforms where a frame is named, else by its nav_msgs/Odometry.

    Parameters
    ----------
    recording : rcseg_ros.recordings.bag.Recording
    """
    tree = TransformTree(history=None)
    for message in recording.latched():
        tree.add(message, fixed=True)
    source = PoseSource(tree, fixed_frame)
    if fixed_frame:
        for message in recording.latched("/tf"):
            tree.add(message, fixed=False)
        return source
    names = sorted(topic.name for topic in recording.topics.values() if topic.type == ODOMETRY_TYPE)
    for raw in recording.messages(names[:1]) if names else ():
        source.add_odometry(recording.decode(raw))
    return source
