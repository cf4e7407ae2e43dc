"""Writes bags/motorcycle: a Middlebury 2014 scene that scikit-image ships, left image and true depth.

pip install scikit-image    # or Debian's python3-skimage: the same files
python bags/make_motorcycle.py
"""

import numpy as np
from recording import InputBag, camera_info
from skimage.data import stereo_motorcycle

from rcseg_core import PinholeCamera
from rcseg_ros.frames.conversions import Header
from rcseg_ros.recordings.result_bag import make_message
from rcseg_ros.results.outputs import depth_message, header_message, picture_message

# From the documentation of skimage.data.stereo_motorcycle: pixels of the images scaled down by four.
FOCAL_PX, CX_PX, CY_PX, DOFFS_PX, BASELINE_M = 994.978, 311.193, 254.877, 31.086, 0.193001
HEADER = Header(
    1_409_616_000_000_000_000, "left_optical_frame"
)  # the day on which the data set was presented


def main() -> None:
    color, _, disparity_px = stereo_motorcycle()
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_m = BASELINE_M * FOCAL_PX / (disparity_px + DOFFS_PX)
    depth_m[~np.isfinite(disparity_px)] = np.nan
    camera = PinholeCamera(FOCAL_PX, FOCAL_PX, CX_PX, CY_PX)
    head = header_message(HEADER, make_message)
    with InputBag("motorcycle") as bag:
        for topic, message in {
            "/stereo/left/camera_info": camera_info(HEADER, camera, *depth_m.shape),
            "/stereo/left/image_rect_color": picture_message(color, head, make_message),
            "/stereo/depth": depth_message(depth_m, head, make_message),
        }.items():
            bag.add(topic, message, HEADER.stamp_ns)


if __name__ == "__main__":
    main()
