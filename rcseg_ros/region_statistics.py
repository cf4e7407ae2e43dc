"""What the region messages hold beside the patches: the mean colour and an oriented box of each region.

One compiled pass sums the members' moments, a second one measures their spread along each region's own
axes; the cost does not depend on the number of regions. The axes are those of the member points'
covariance: z along the least spread (the normal of the best plane), x along the largest, right-handed,
signs fixed so that a scene always gives one answer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class RegionStatistics:
    """Per region, in label order (row 0 is label 1).

    Attributes
    ----------
    mean_color : (N, 3) float64, grey levels
    center : (N, 3) float64, metres; centre of the oriented box; NaN where no member has a finite point
    axes : (N, 3, 3) float64; columns are the box's x, y, z axes, a rotation; identity where unknown
    size : (N, 3) float64, metres; full side lengths along the axes; NaN where unknown
    """

    mean_color: NDArray[np.float64]
    center: NDArray[np.float64]
    axes: NDArray[np.float64]
    size: NDArray[np.float64]


def region_statistics(
    labels: NDArray[np.int32], points: NDArray[Any], color: NDArray[np.uint8], count: int
) -> RegionStatistics:
    """Measure every region of a label image.

    Parameters
    ----------
    labels : (H, W) int32, 0 unlabelled, 1..count
    points : (H, W, 3) float32 or float64, metres, NaN or z = 0 invalid
    color : (H, W, 3) uint8
    count : number of regions
    """
    pixels, members, color_sum, point_sum, square_sum = _moments(labels, points, color, count)
    mean_color = color_sum / np.maximum(pixels, 1)[:, None]
    known = members > 0
    divisor = np.maximum(members, 1)[:, None]
    mean = point_sum / divisor
    covariance = (square_sum / divisor)[:, _SQUARE] - mean[:, :, None] * mean[:, None, :]
    axes = _right_handed_axes(covariance)
    axes[~known] = np.eye(3)
    low, high = _extents(labels, points, mean, axes, count)
    low[~known], high[~known] = np.nan, np.nan
    center = mean + np.einsum("nij,nj->ni", axes, (low + high) / 2)
    return RegionStatistics(mean_color, center, axes, high - low)


def warm_up_statistics() -> None:
    """Compile the two passes, or load them from the cache."""
    region_statistics(
        np.ones((2, 2), np.int32), np.ones((2, 2, 3), np.float32), np.ones((2, 2, 3), np.uint8), 1
    )


_SQUARE = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])  # where xx, xy, xz, yy, yz, zz stand in a 3x3 matrix


def _right_handed_axes(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation of each (3, 3) covariance: x along the largest spread, z along the least, to the sensor."""
    _, vectors = np.linalg.eigh(covariance)
    x, z = vectors[:, :, 2], vectors[:, :, 0]
    largest = np.take_along_axis(x, np.abs(x).argmax(axis=1)[:, None], axis=1)
    x = x * np.where(largest < 0, -1.0, 1.0)
    z = z * np.where(z[:, 2:] > 0, -1.0, 1.0)
    return np.stack([x, np.cross(z, x), z], axis=2)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _moments(labels, points, color, count):  # type: ignore[no-untyped-def]
    pixels, members = np.zeros(count, np.int64), np.zeros(count, np.int64)
    colors, sums, squares = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, 6))
    for row in range(labels.shape[0]):
        for col in range(labels.shape[1]):
            i = labels[row, col] - 1
            if i < 0:
                continue
            pixels[i] += 1
            for c in range(3):
                colors[i, c] += color[row, col, c]
            x, y, z = points[row, col, 0], points[row, col, 1], points[row, col, 2]
            if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z)) or z == 0.0:
                continue
            members[i] += 1
            sums[i, 0] += x
            sums[i, 1] += y
            sums[i, 2] += z
            x, y, z = np.float64(x), np.float64(y), np.float64(z)
            squares[i, 0] += x * x
            squares[i, 1] += x * y
            squares[i, 2] += x * z
            squares[i, 3] += y * y
            squares[i, 4] += y * z
            squares[i, 5] += z * z
    return pixels, members, colors, sums, squares


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _extents(labels, points, mean, axes, count):  # type: ignore[no-untyped-def]
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    for row in range(labels.shape[0]):
        for col in range(labels.shape[1]):
            i = labels[row, col] - 1
            if i < 0:
                continue
            x, y, z = points[row, col, 0], points[row, col, 1], points[row, col, 2]
            if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z)) or z == 0.0:
                continue
            x, y, z = x - mean[i, 0], y - mean[i, 1], z - mean[i, 2]
            for a in range(3):
                along = x * axes[i, 0, a] + y * axes[i, 1, a] + z * axes[i, 2, a]
                low[i, a] = min(low[i, a], along)
                high[i, a] = max(high[i, a], along)
    return low, high
