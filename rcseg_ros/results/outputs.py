"""Arrays to ROS messages: label images, pictures and the reconstructed cloud.

`make(type name, **fields)` builds for one message library or another (rclpy on live topics, rosbags in
files); bulk data is handed to it as a flat numpy array, which it turns into what its library copies fastest.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_core.errors import InputError
from rcseg_ros.frames.conversions import Header

Make = Callable[..., Any]

_FLOAT32, _UINT32 = 7, 6  # sensor_msgs/PointField
_CLOUD_DTYPE = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4"), ("label", "<u4")])


def header_message(header: Header, make: Make) -> Any:
    """std_msgs/Header of a result: the input's own stamp and frame."""
    sec, nanosec = divmod(header.stamp_ns, 1_000_000_000)
    stamp = make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=header.frame_id)


def labels_message(labels: NDArray[np.int32], header: Any, make: Make) -> Any:
    """(H, W) labels as a 16UC1 Image; 0 is unlabelled."""
    if labels.max(initial=0) > 0xFFFF:
        raise InputError(f"{labels.max()} labels do not fit into a 16UC1 image; coarsen the segmentation")
    return _image_message(labels.astype("<u2"), "16UC1", header, make)


def edges_message(edges: NDArray[np.uint8], header: Any, make: Make) -> Any:
    """(H, W) edge bits (depth 1, orientation 2, colour 4) as an 8UC1 Image."""
    return _image_message(edges, "8UC1", header, make)


def class_message(classes: NDArray[np.uint8], header: Any, make: Make) -> Any:
    """(H, W) classes of surfaces (constants of rcseg_msgs/Surface; 0: no surface) as a mono8 Image."""
    return _image_message(classes, "mono8", header, make)


def picture_message(picture: NDArray[np.uint8], header: Any, make: Make) -> Any:
    """(H, W, 3) uint8 RGB as an rgb8 Image."""
    return _image_message(picture, "rgb8", header, make)


def depth_message(depth_m: NDArray[Any], header: Any, make: Make) -> Any:
    """(H, W) metres as a 32FC1 Image (REP 118); NaN stays NaN."""
    return _image_message(depth_m.astype("<f4"), "32FC1", header, make)


def _image_message(pixels: NDArray[Any], encoding: str, header: Any, make: Make) -> Any:
    pixels = np.ascontiguousarray(pixels)
    return make(
        "sensor_msgs/msg/Image",
        header=header,
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=pixels.strides[0],
        data=pixels.reshape(-1).view(np.uint8),
    )


def put_points(cells: NDArray[np.float32], points: NDArray[Any]) -> None:
    """Points (..., 3) into the first three of cells (..., k), one axis at a time: numpy copies a long row of
    numbers many times sooner than many rows of three."""
    for axis in range(3):
        cells[..., axis] = points[..., axis]


def cloud_message(
    points: NDArray[np.float32], color: NDArray[np.uint8], labels: NDArray[np.int32], header: Any, make: Make
) -> Any:
    """Organised PointCloud2 with x, y, z, rgb (packed, as PCL and RViz read it) and label (uint32).

    points : (H, W, 3) metres, NaN where there is none; color : (H, W, 3) uint8; labels : (H, W), 0: none
    """
    height, width = labels.shape
    cloud = np.empty((height, width, 5), "<f4")  # as _CLOUD_DTYPE says: all fields are four bytes wide
    put_points(cloud, points)
    bits = cloud.view("<u4")
    bgra = cv2.cvtColor(np.asarray(color, np.uint8), cv2.COLOR_RGB2BGRA)
    bits[..., 3] = bgra.view("<u4")[..., 0] & 0xFFFFFF
    bits[..., 4] = labels
    kinds = {"rgb": _FLOAT32, "label": _UINT32}
    fields = [
        make(
            "sensor_msgs/msg/PointField",
            name=name,
            offset=offset,
            datatype=kinds.get(name, _FLOAT32),
            count=1,
        )
        for name, (_, offset) in _CLOUD_DTYPE.fields.items()
    ]
    return make(
        "sensor_msgs/msg/PointCloud2",
        header=header,
        height=height,
        width=width,
        fields=fields,
        is_bigendian=False,
        point_step=_CLOUD_DTYPE.itemsize,
        row_step=_CLOUD_DTYPE.itemsize * width,
        data=cloud.reshape(-1).view(np.uint8),
        is_dense=False,
    )
