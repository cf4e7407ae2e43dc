"""What is seen of each region: the area of its surface, and its mean colour, in one pass over the image.

A pixel of a pinhole camera covers z^2 / (fx fy) of a wall that faces the sensor at depth z; of one with unit
normal n, seen along the ray v = (x, y, 1), it covers 1 / |n . v| times as much.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.frame import RangeColorFrame
from rcseg_core.result.segmentation import Region

#: Cosine between normal and ray below which a pixel counts no more: it would cover any area.
LEAST_COSINE = 0.02


@bare
def _sum(labels, points, color, normals, least, areas, colors):  # type: ignore[no-untyped-def]
    """Sums over each label: z^2 / |n . v| of the pixels with a range, colours of all.

    areas : (N + 1,), colors : (N + 1, 3); least : of the cosine, its length taken with the ray's
    """
    height, width = labels.shape
    for row in range(height):
        for col in range(width):
            k = labels[row, col]
            if k <= 0:
                continue
            for c in range(3):
                colors[k, c] += color[row, col, c]
            x, y, z = points[row, col, 0], points[row, col, 1], points[row, col, 2]
            if not z > 0.0:
                continue
            across = abs(normals[k, 0] * x + normals[k, 1] * y + normals[k, 2] * z)
            across = max(across, least * np.sqrt(x * x + y * y + z * z))
            areas[k] += z * z * z / across


def region_areas(
    frame: RangeColorFrame, labels: NDArray[np.int32], regions: Sequence[Region]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Area and mean colour of every region, in the order of labels.

    Parameters
    ----------
    labels : (H, W) int32, 0 unlabelled, 1..N
    regions : the N regions of the frame

    Returns
    -------
    area_m2 : (N,) float64, of the pixels with a range; NaN without a camera or a normal
    mean_color : (N, 3) float64, grey levels
    """
    count = len(regions)
    normals = np.array([[np.nan] * 3, *(region.normal for region in regions)])
    pixels = np.array([1, *(region.pixel_count for region in regions)])
    areas, colors = np.zeros(count + 1), np.zeros((count + 1, 3))
    _sum(labels, frame.points, frame.color, normals, LEAST_COSINE, areas, colors)
    camera = frame.camera
    areas *= np.nan if camera is None else 1.0 / (camera.fx * camera.fy)
    areas[np.isnan(normals).any(axis=1)] = np.nan
    return areas[1:], (colors / np.maximum(pixels, 1)[:, None])[1:]
