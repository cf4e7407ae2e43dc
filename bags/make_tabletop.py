"""Writes bags/tabletop: a rendered table, a moving camera, the truth of every pixel and the poses.

python bags/make_tabletop.py
"""

import numpy as np
from recording import InputBag, camera_info
from scipy.spatial.transform import Rotation

from rcseg_core.synthetic import make_tabletop_sequence
from rcseg_ros.frames.conversions import Header
from rcseg_ros.recordings.result_bag import make_message
from rcseg_ros.results.outputs import depth_message, header_message, labels_message, picture_message

FRAMES, SEED, PERIOD_NS, START_NS = 12, 3, 100_000_000, 1_700_000_000_000_000_000
CAMERA_FRAME, WORLD_FRAME = "camera_color_optical_frame", "world"


def transform_message(header: Header, pose: np.ndarray) -> object:
    """tf of the camera in the world."""
    vector = dict(zip("xyz", map(float, pose[:3, 3]), strict=True))
    rotation = dict(zip("xyzw", map(float, Rotation.from_matrix(pose[:3, :3]).as_quat()), strict=True))
    transform = make_message(
        "geometry_msgs/msg/TransformStamped",
        header=header_message(Header(header.stamp_ns, WORLD_FRAME), make_message),
        child_frame_id=CAMERA_FRAME,
        transform=make_message(
            "geometry_msgs/msg/Transform",
            translation=make_message("geometry_msgs/msg/Vector3", **vector),
            rotation=make_message("geometry_msgs/msg/Quaternion", **rotation),
        ),
    )
    return make_message("tf2_msgs/msg/TFMessage", transforms=[transform])


def main() -> None:
    with InputBag("tabletop") as bag:
        for shot, scene in enumerate(make_tabletop_sequence(FRAMES, SEED)):
            header = Header(START_NS + shot * PERIOD_NS, CAMERA_FRAME)
            head = header_message(header, make_message)
            frame = scene.frame
            for topic, message in {
                "/tf": transform_message(header, scene.pose),
                "/camera/color/camera_info": camera_info(header, frame.camera, frame.height, frame.width),
                "/camera/color/image_raw": picture_message(frame.color, head, make_message),
                "/camera/aligned_depth_to_color/image_raw": depth_message(frame.depth_m, head, make_message),
                "/truth/labels": labels_message(scene.labels, head, make_message),
                "/truth/surface_labels": labels_message(scene.surface_labels, head, make_message),
            }.items():
                bag.add(topic, message, header.stamp_ns)


if __name__ == "__main__":
    main()
