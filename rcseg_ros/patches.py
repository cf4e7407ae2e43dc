"""Evaluate patches from their messages alone: what a program does that has a RegionArray and not this
library's core.

Needs numpy and the formulas in the comments of BezierPatch.msg; the node uses it to draw markers from its
own message, so what is drawn is what others can draw.
"""

from __future__ import annotations

from math import comb
from typing import Any

import numpy as np
from numpy.typing import NDArray

INVERSE_DEPTH, XYZ, RGB = 1, 2, 3  # the constants of BezierPatch.msg


def evaluate_patch(patch: Any, rows: NDArray[Any], cols: NDArray[Any]) -> NDArray[np.float64]:
    """Values of a rcseg_msgs/BezierPatch at pixels.

    Parameters
    ----------
    patch : rcseg_msgs/BezierPatch
    rows, cols : arrays of one shape, pixel indices; need not be whole

    Returns
    -------
    (..., channels) float64 in the patch's own unit
    """
    u = (np.asarray(cols, float) - patch.domain.col_min) / max(patch.domain.col_max - patch.domain.col_min, 1)
    v = (np.asarray(rows, float) - patch.domain.row_min) / max(patch.domain.row_max - patch.domain.row_min, 1)
    order = patch.degree + 1
    control = np.asarray(patch.control_points).reshape(patch.channels, order, order)
    return np.einsum("...i,...j,cij->...c", bernstein(patch.degree, u), bernstein(patch.degree, v), control)


def bernstein(degree: int, t: NDArray[Any]) -> NDArray[np.float64]:
    """(..., degree + 1) Bernstein polynomials B_i(t) = binomial(degree, i) t^i (1 - t)^(degree - i)."""
    return np.stack([comb(degree, i) * t**i * (1 - t) ** (degree - i) for i in range(degree + 1)], axis=-1)


def surface_points(array: Any, region: Any, rows: NDArray[Any], cols: NDArray[Any]) -> NDArray[np.float64]:
    """(..., 3) points in metres of a region's surface at pixels; NaN where inverse depth is not positive.

    Parameters
    ----------
    array : rcseg_msgs/RegionArray that holds the camera matrix
    region : one of array.regions
    rows, cols : arrays of one shape
    """
    value = evaluate_patch(region.range_patch, rows, cols)
    if region.range_patch.kind == XYZ:
        return value
    fx, _, cx, _, fy, cy = (float(x) for x in array.k[:6])
    inverse_depth = value[..., 0]
    depth_m = np.full(inverse_depth.shape, np.nan)
    np.divide(1.0, inverse_depth, out=depth_m, where=inverse_depth > 0)
    return np.stack(
        [(np.asarray(cols) - cx) / fx * depth_m, (np.asarray(rows) - cy) / fy * depth_m, depth_m], axis=-1
    )
