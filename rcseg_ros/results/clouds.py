"""Clouds for robots: ground and obstacles apart, and all points with what they belong to.

Points are the frame's own, not those of the models. What has no depth is in no cloud, and never free space.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_ros.results.cdr import Cdr, Serialized
from rcseg_ros.results.outputs import put_points

_FLOAT32 = 7
_KINDS = {"u1": 2, "u4": 6, "f4": _FLOAT32}  # constants of sensor_msgs/PointField
_XYZ = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
#: Points of ~/ground_points and ~/obstacle_points.
PART = np.dtype([*_XYZ, ("label", "<u4"), ("surface", "<u4")])
#: Points of ~/labelled_points; rgb is packed as PCL and RViz read it.
LABELLED = np.dtype(
    {
        "names": ["x", "y", "z", "rgb", "label", "surface", "object", "class"],
        "formats": ["<f4", "<f4", "<f4", "<u4", "<u4", "<u4", "<u4", "u1"],
        "offsets": [0, 4, 8, 12, 16, 20, 24, 28],
        "itemsize": 32,
    }
)


def part_cloud(
    points: NDArray[Any],
    chosen: NDArray[np.bool_],
    labels: NDArray[np.int32],
    surface_labels: NDArray[np.int32],
    header: Any,
) -> Serialized:
    """PointCloud2 of some pixels, in the order of the image: x, y, z, label, surface.

    Parameters
    ----------
    points : (H, W, 3) m
    chosen : (H, W) bool, pixels with a point
    labels, surface_labels : (H, W), 0: none
    """
    at = np.flatnonzero(chosen)
    rows = np.empty((len(at), 5), "<f4")
    put_points(rows, np.take(points.reshape(-1, 3), at, axis=0))
    whole = rows.view("<u4")
    whole[:, 3] = labels[chosen]
    whole[:, 4] = surface_labels[chosen]
    return _cloud(rows, PART, 1, len(at), True, header)


def labelled_cloud(
    points: NDArray[Any],
    color: NDArray[np.uint8],
    labels: NDArray[np.int32],
    surface_labels: NDArray[np.int32],
    object_labels: NDArray[np.int32],
    class_mask: NDArray[np.uint8],
    header: Any,
) -> Serialized:
    """Organised PointCloud2 of a frame: its points and colour, and the label, surface, object, class of each.

    Parameters
    ----------
    points : (H, W, 3) m; a pixel without depth is NaN in the cloud
    color : (H, W, 3) uint8 RGB
    labels, surface_labels, object_labels, class_mask : (H, W), 0: none
    """
    height, width = labels.shape
    cells = np.empty((height, width, 8), "<f4")
    put_points(cells, points)
    unseen = cells[..., 2] == 0
    if unseen.any():
        cells[unseen, :3] = np.nan
    whole = cells.view("<u4")
    bgra = cv2.cvtColor(np.asarray(color, np.uint8), cv2.COLOR_RGB2BGRA)
    whole[..., 3] = bgra.view("<u4")[..., 0] & 0xFFFFFF
    for at, image in enumerate((labels, surface_labels, object_labels, class_mask), start=4):
        whole[..., at] = image
    return _cloud(cells, LABELLED, height, width, False, header)


def _cloud(
    cells: NDArray[Any], layout: np.dtype[Any], height: int, width: int, dense: bool, header: Any
) -> Serialized:
    """The fields of sensor_msgs/PointCloud2 in their order."""
    cdr = Cdr()
    cdr.header(header)
    cdr.put("2I", height, width)
    cdr.put("I", len(layout.names or ()))
    for name in layout.names or ():
        kind, offset = layout.fields[name][:2]  # type: ignore[index]
        cdr.text(name)
        cdr.put("I", offset)
        cdr.put("B", _FLOAT32 if name == "rgb" else _KINDS[kind.str[1:]])
        cdr.put("I", 1)
    cdr.put("B", 0)  # is_bigendian
    cdr.put("3I", layout.itemsize, layout.itemsize * width, cells.nbytes)
    cdr.array(cells)
    cdr.put("B", dense)
    return Serialized("sensor_msgs/msg/PointCloud2", cdr.bytes())
