"""The ROS 2 layer of rcseg: one sync and one set of conversions for live topics and recordings."""

import os

# OpenCV takes pictures of 2^30 pixels; no camera has an eighth of them. It reads this when it is loaded.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(1 << 27))
