"""vision_msgs: objects as Detection3DArray, the names of ~/class_mask as LabelInfo (vision_msgs 4)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rcseg_core.world import CATEGORIES, World
from rcseg_ros.results.outputs import Make
from rcseg_ros.results.world import pose_message

#: The class of every detection: which object it is geometry does not tell.
OBJECT = "object"


def detection_array(world: World, header: Any, make: Make, ids: Sequence[int] = ()) -> Any:
    """vision_msgs/Detection3DArray: a box and an id for each object.

    Parameters
    ----------
    ids : of each object in order, such as those of tracks; by default the labels
    """
    detections = [
        _detection(one, ids[i] if i < len(ids) else one.label, header, make)
        for i, one in enumerate(world.objects)
    ]
    return make("vision_msgs/msg/Detection3DArray", header=header, detections=detections)


def _detection(one: Any, number: int, header: Any, make: Make) -> Any:
    pose = pose_message(one.box3d.pose, make)
    x, y, z = (float(side) for side in one.box3d.size)
    hypothesis = make("vision_msgs/msg/ObjectHypothesis", class_id=OBJECT, score=1.0)
    # Of the pose's errors nothing is known; zeros are what this message writes for that.
    placed = make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36))
    result = make("vision_msgs/msg/ObjectHypothesisWithPose", hypothesis=hypothesis, pose=placed)
    size = make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)
    return make(
        "vision_msgs/msg/Detection3D",
        header=header,
        results=[result],
        bbox=make("vision_msgs/msg/BoundingBox3D", center=pose, size=size),
        id=str(number),
    )


def label_info(header: Any, make: Make) -> Any:
    """vision_msgs/LabelInfo: the values of ~/class_mask and their names; there is no threshold."""
    classes = [
        make("vision_msgs/msg/VisionClass", class_id=value, class_name=name)
        for value, name in enumerate(CATEGORIES)
    ]
    return make("vision_msgs/msg/LabelInfo", header=header, class_map=classes, threshold=0.0)
