"""Mean colours and oriented boxes of regions: where the fitted surfaces lie, how large they are.

A box goes round the fitted surface, not round the measured points: one impulse among a table's pixels would
double it. Its axes are those of the covariance of the surface's points: z along the least spread (the normal
of the best plane) and towards the sensor, x along the largest; signs are fixed, so that a scene always gives
one answer. Two passes over the image: sums, then the ends along the axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.result.segmentation import Region

#: A region is measured by every n-th of its points, n such that at least this many are left.
SAMPLES = 2000


@dataclass(frozen=True)
class Extents:
    """Per region, in the order of labels (row 0 is label 1).

    Attributes
    ----------
    mean_color : (N, 3) float64, levels
    center : (N, 3) float64, m, centre of the box; NaN where the region has no measured point
    axes : (N, 3, 3) float64, columns are the x, y, z axes of the box, a rotation; identity where unknown
    size : (N, 3) float64, m, full side lengths along the axes; NaN where unknown
    """

    mean_color: NDArray[np.float64]
    center: NDArray[np.float64]
    axes: NDArray[np.float64]
    size: NDArray[np.float64]


@bare
def _add_colors(pixels, total):  # type: ignore[no-untyped-def]
    red = green = blue = np.int64(0)  # of bytes alone, uncompiled, the sum would be a byte
    for i in range(pixels.shape[0]):
        red += pixels[i, 0]
        green += pixels[i, 1]
        blue += pixels[i, 2]
    total[0] += red
    total[1] += green
    total[2] += blue


@bare
def _sum(labels, color, surface, step, origin, wait, colors, sums):  # type: ignore[no-untyped-def]
    """Colours of all pixels; of every step[k]-th pixel of region k n, x, y, z and xx, xy, xz, yy, yz, zz.

    origin : (N + 1, 3), taken off the points first, or their squares would swallow the spread
    wait : (N + 1,) scratch, pixels until the next that counts
    """
    height, width = labels.shape
    for row in range(height):
        end = 0
        while end < width:
            start, k = end, labels[row, end]
            while end < width and labels[row, end] == k:
                end += 1
            if k <= 0:
                continue
            _add_colors(color[row, start:end], colors[k])
            col = start + wait[k]
            while col < end:
                x = surface[row, col, 0] - origin[k, 0]
                y = surface[row, col, 1] - origin[k, 1]
                z = surface[row, col, 2] - origin[k, 2]
                col += step[k]
                if not np.isfinite(x + y + z):
                    continue
                sums[k, 0] += 1.0
                sums[k, 1] += x
                sums[k, 2] += y
                sums[k, 3] += z
                sums[k, 4] += x * x
                sums[k, 5] += x * y
                sums[k, 6] += x * z
                sums[k, 7] += y * y
                sums[k, 8] += y * z
                sums[k, 9] += z * z
            wait[k] = col - end


@bare
def _ends(labels, surface, step, middle, axes, wait, low, high):  # type: ignore[no-untyped-def]
    """Least and greatest coordinate along the axes of the points that `_sum` counted."""
    height, width = labels.shape
    for row in range(height):
        end = 0
        while end < width:
            start, k = end, labels[row, end]
            while end < width and labels[row, end] == k:
                end += 1
            if k <= 0:
                continue
            col = start + wait[k]
            while col < end:
                x = surface[row, col, 0] - middle[k, 0]
                y = surface[row, col, 1] - middle[k, 1]
                z = surface[row, col, 2] - middle[k, 2]
                col += step[k]
                if not np.isfinite(x + y + z):
                    continue
                for a in range(3):
                    along = x * axes[k, 0, a] + y * axes[k, 1, a] + z * axes[k, 2, a]
                    low[k, a] = min(low[k, a], along)
                    high[k, a] = max(high[k, a], along)
            wait[k] = col - end


def region_extents(
    color: NDArray[np.uint8], labels: NDArray[np.int32], regions: Sequence[Region], surface: NDArray[Any]
) -> Extents:
    """Measure every region.

    Parameters
    ----------
    color : (H, W, 3) uint8
    labels : (H, W) int32, 0 unlabelled, 1..N
    regions : the N regions in the order of labels; one whose centroid is unknown gets no box
    surface : (H, W, 3) m, points of the fitted surfaces (`Segmentation.reconstruct`); NaN where there is none
    """
    count = len(regions)
    pixels = np.array([0, *(region.pixel_count for region in regions)])
    origin = np.array([[np.nan] * 3, *(region.centroid for region in regions)])
    step = np.maximum(1, pixels // SAMPLES)
    colors, sums = np.zeros((count + 1, 3)), np.zeros((count + 1, 10))
    _sum(labels, color, surface, step, origin, np.zeros(count + 1, np.int64), colors, sums)

    middle, axes = _axes(sums)
    middle += origin
    low, high = np.full((count + 1, 3), np.inf), np.full((count + 1, 3), -np.inf)
    _ends(labels, surface, step, middle, axes, np.zeros(count + 1, np.int64), low, high)
    with np.errstate(invalid="ignore"):  # infinities of regions without points
        center = middle + np.matmul(axes, ((low + high) / 2)[:, :, None])[:, :, 0]
        size = high - low
    size[sums[:, 0] == 0] = np.nan
    mean_color = colors / np.maximum(pixels, 1)[:, None]
    return Extents(mean_color[1:], center[1:], axes[1:], size[1:])


def _axes(sums: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Means (NaN without points) and axes, as columns (identity without points), of the sums of `_sum`."""
    known = sums[:, 0] > 0
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = sums[:, 1:4] / sums[:, :1]
    spread = sums[:, [4, 5, 6, 5, 7, 8, 6, 8, 9]].reshape(-1, 3, 3)
    spread = spread - mean[:, :, None] * mean[:, None, :] * sums[:, :1, None]
    _, vectors = np.linalg.eigh(np.where(known[:, None, None], spread, np.eye(3)))
    x, z = vectors[:, :, 2], vectors[:, :, 0]
    largest = np.take_along_axis(x, np.abs(x).argmax(axis=1)[:, None], axis=1)
    x = np.where(largest > 0, x, -x)
    z = np.where(z[:, 2:] <= 0, z, -z)
    axes = np.stack([x, np.cross(z, x), z], axis=2)
    return mean, np.where(known[:, None, None], axes, np.eye(3))
