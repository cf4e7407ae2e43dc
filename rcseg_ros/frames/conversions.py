"""ROS messages to arrays and frames: the door through which every recorded or live message comes.

Pure functions over duck-typed messages: what rclpy delivers and what rosbags deserialises have the same field
names, and both hold bulk data in something with a buffer, so `numpy.frombuffer` reads either without a copy.
What does not fit is refused with a `MessageError`, whose `reason` is a short name for counters. Images, depth
images and clouds are in modules of their own; what others need of them is named here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_core import PinholeCamera
from rcseg_ros.frames.depth_images import decode_depth
from rcseg_ros.frames.images import decode_image
from rcseg_ros.frames.pixels import pixels
from rcseg_ros.frames.point_clouds import Cloud, decode_cloud
from rcseg_ros.frames.reading import Reading
from rcseg_ros.frames.refusals import MessageError

__all__ = [
    "CameraModel",
    "Cloud",
    "Header",
    "MessageError",
    "Reading",
    "decode_camera_info",
    "decode_cloud",
    "decode_depth",
    "decode_image",
    "decode_labels",
    "header_of",
]


@dataclass(frozen=True)
class Header:
    """Stamp (integer nanoseconds) and coordinate frame of a message; results carry their input's."""

    stamp_ns: int
    frame_id: str


def header_of(message: Any) -> Header:
    """Header of any stamped message; one without a header says nothing of time and frame."""
    if message.header is None:
        return Header(0, "")
    stamp = message.header.stamp
    return Header(int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec), str(message.header.frame_id))


def decode_labels(message: Any) -> NDArray[np.int32]:
    """Label image (H, W) from a 16UC1 Image; 0 is unlabelled."""
    if str(message.encoding) not in ("16UC1", "mono16"):
        raise MessageError("unknown_encoding", f"labels: expected encoding 16UC1, got {message.encoding!r}")
    return pixels(message, np.dtype(np.uint16), 1).astype(np.int32)


@dataclass(frozen=True)
class CameraModel:
    """A sensor_msgs/CameraInfo: what a raw image sees (K and D) and what a rectified one does (P).

    Attributes
    ----------
    pinhole : PinholeCamera
        K; P where K is zero, which is a calibrated camera of rectified images.
    height, width : size of the image, pixels
    distortion_model, distortion : D, empty where all of it is zero
    frame_id : optical frame
    projection : PinholeCamera or None
        P without its fourth column; None where P is zero.
    rotation : nine numbers, R by rows: from raw to rectified axes
    only_projection : bool
        K is zero: nothing is known of raw images.
    """

    pinhole: PinholeCamera
    height: int
    width: int
    distortion_model: str = ""
    distortion: tuple[float, ...] = ()
    frame_id: str = ""
    projection: PinholeCamera | None = None
    rotation: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    only_projection: bool = False


def decode_camera_info(message: Any) -> CameraModel:
    """Camera of a CameraInfo; binning and region of interest are taken into account.

    Raises
    ------
    MessageError
        Reason ``uncalibrated_camera``: K and P are zero.
    """
    own = _pinhole(message, message.k, 3)
    projection = _pinhole(message, getattr(message, "p", ()), 4)
    pinhole = projection if own is None else own
    if pinhole is None:
        raise MessageError(
            "uncalibrated_camera",
            "camera_info: K is zero and so is P, the camera is not calibrated; "
            "calibrate it, or name another camera_info topic",
        )
    distortion = tuple(float(value) for value in message.d)
    if own is None or not any(distortion):
        distortion = ()
    rotation = tuple(float(value) for value in getattr(message, "r", ()))
    bin_x, bin_y = _binning(message)
    return CameraModel(
        pinhole,
        (int(message.roi.height) or int(message.height)) // bin_y,
        (int(message.roi.width) or int(message.width)) // bin_x,
        str(message.distortion_model) if distortion else "",
        distortion,
        str(message.header.frame_id),
        projection,
        rotation if len(rotation) == 9 and any(rotation) else CameraModel.rotation,
        own is None,
    )


def _pinhole(message: Any, matrix: Any, columns: int) -> PinholeCamera | None:
    """Camera of a matrix of three rows, K or P, in the pixels of the image; None if it is zero or absent."""
    if len(matrix) != 3 * columns or matrix[0] == 0 or matrix[columns + 1] == 0:
        return None
    fx, cx, fy, cy = (float(matrix[i]) for i in (0, 2, columns + 1, columns + 2))
    bin_x, bin_y = _binning(message)
    roi = message.roi
    return PinholeCamera(
        fx / bin_x, fy / bin_y, (cx - int(roi.x_offset)) / bin_x, (cy - int(roi.y_offset)) / bin_y
    )


def _binning(message: Any) -> tuple[int, int]:
    return max(int(message.binning_x), 1), max(int(message.binning_y), 1)
