"""What the region messages hold beside the patches: the mean colour and an oriented box of each region.

The box goes round the fitted surface, not round the measured points: one impulse among a table's pixels
would double its box. Its axes are those of the surface points' covariance: z along the least spread (the
normal of the best plane), x along the largest, right-handed, signs fixed so that a scene always gives one
answer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rcseg_core import PinholeCamera, RangeColorFrame, Region

SAMPLES = 2000  # surface points that measure a region; more move the box by less than a pixel


@dataclass(frozen=True)
class RegionStatistics:
    """Per region, in label order (row 0 is label 1).

    Attributes
    ----------
    mean_color : (N, 3) float64, grey levels
    center : (N, 3) float64, metres; centre of the oriented box; NaN where the region has no measured point
    axes : (N, 3, 3) float64; columns are the box's x, y, z axes, a rotation; identity where unknown
    size : (N, 3) float64, metres; full side lengths along the axes; NaN where unknown
    """

    mean_color: NDArray[np.float64]
    center: NDArray[np.float64]
    axes: NDArray[np.float64]
    size: NDArray[np.float64]


def region_statistics(
    frame: RangeColorFrame, labels: NDArray[np.int32], regions: Sequence[Region]
) -> RegionStatistics:
    """Measure every region.

    Parameters
    ----------
    labels : (H, W) int32, 0 unlabelled, 1..N
    regions : the N regions in label order
    """
    count = len(regions)
    flat = labels.ravel()
    pixels = np.bincount(flat, minlength=count + 1)
    sums = [np.bincount(flat, frame.color[..., c].ravel(), count + 1) for c in range(3)]
    mean_color = np.stack(sums, axis=1)[1:] / np.maximum(pixels[1:], 1)[:, None]
    # 16-bit keys sort by radix, several times faster than the labels' own 32 bits.
    by_label = np.argsort(flat.astype(np.uint16) if count < 2**16 else flat, kind="stable")
    starts = np.concatenate([[0], np.cumsum(pixels)])
    center, size = np.full((count, 3), np.nan), np.full((count, 3), np.nan)
    axes = np.tile(np.eye(3), (count, 1, 1))
    for i, region in enumerate(regions):
        if not np.isfinite(region.centroid).all():
            continue
        members = by_label[starts[i + 1] : starts[i + 2]]
        members = members[:: max(1, len(members) // SAMPLES)]
        points = _surface(region, *np.divmod(members, frame.width), frame.camera)
        if len(points):
            center[i], axes[i], size[i] = _oriented_box(points)
    return RegionStatistics(mean_color, center, axes, size)


def _surface(
    region: Region, rows: NDArray[np.int64], cols: NDArray[np.int64], camera: PinholeCamera | None
) -> NDArray[np.float64]:
    """(M, 3) points of the fitted surface at pixels, those behind the camera left out."""
    values = region.range_patch.evaluate(rows, cols)
    if region.range_patch.kind == "xyz" or camera is None:
        return values
    ahead = values[:, 0] > 0
    rows, cols, depth_m = rows[ahead], cols[ahead], 1.0 / values[ahead, 0]
    x, y = (cols - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    return np.stack([x * depth_m, y * depth_m, depth_m], axis=1)


def _oriented_box(
    points: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Centre, axes and side lengths: x along the largest spread, z along the least and towards the sensor."""
    mean = points.mean(axis=0)
    _, vectors = np.linalg.eigh((points - mean).T @ (points - mean))
    x, z = vectors[:, 2], vectors[:, 0]
    x = x if x[np.abs(x).argmax()] > 0 else -x
    z = z if z[2] <= 0 else -z
    axes = np.stack([x, np.cross(z, x), z], axis=1)
    along = (points - mean) @ axes
    low, high = along.min(axis=0), along.max(axis=0)
    return mean + axes @ ((low + high) / 2), axes, high - low
