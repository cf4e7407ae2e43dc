"""Depth seen from another camera (the registered pair of section 2 made from two sensors): a surface drawn
into the other view.

Points of neighbouring pixels that lie on one surface are joined to triangles, and the triangles drawn into
the other image, where the nearest counts. A surface is thereby closed however it is stretched, and hides what
lies behind it; where the first sensor saw nothing there stays a hole. Inverse depth is linear in the image
over a triangle, so planes stay planes. Pixels at the rim of a surface, and lone ones, are drawn as squares of
their own size: half a pixel of the surface lies outside of its outermost triangles.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_core import frame as limits
from rcseg_core.compute.jit import kernel
from rcseg_core.errors import InputError
from rcseg_core.frame import PinholeCamera

#: Neighbours are of one surface if their inverse depths differ by no more than this share of the larger
#: (noise), and by twice the step on either side of them (a slope goes on, a jump does not), ...
NOISE_SHARE, SLOPE_FACTOR = 0.005, 2.0
#: ... but never by more than this share: a surface seen so slantingly is not measured.
JUMP_SHARE = 0.1
#: A rim that is nearer by this share lies before another surface, not on its own.
BEFORE_SHARE = 0.02
#: Triangles that are larger in the other image, pixels, join what the first sensor did not see together.
LARGEST_TRIANGLE_PX = 16.0
#: Of a triangle's borders, pixels and shares: float32 points are known to a hundredth of that.
MARGIN = 1e-3
#: Largest half side of a square, and by how much squares overlap so that rounding leaves no gap, pixels.
LARGEST_SQUARE_PX, OVERLAP_PX = 4.0, 0.02


@kernel
def _project(points, fx, fy, cx, cy, low, high, cols, rows, inverse):  # type: ignore[no-untyped-def]
    """Image coordinates and inverse depth of each point; inverse depth 0: no point."""
    for i in range(points.shape[0]):
        for j in range(points.shape[1]):
            z = float(points[i, j, 2])
            col, row = np.nan, np.nan
            if low <= z <= high:
                col = fx * points[i, j, 0] / z + cx
                row = fy * points[i, j, 1] / z + cy
            good = np.isfinite(col) and np.isfinite(row)
            cols[i, j], rows[i, j] = (col, row) if good else (-1.0, -1.0)
            inverse[i, j] = 1.0 / z if good else 0.0


@kernel
def _joined(before, one, other, after):  # type: ignore[no-untyped-def]
    """Whether two neighbours in a line of inverse depths are of one surface; 0: no point."""
    larger = max(one, other)
    if one == 0.0 or other == 0.0:
        return False
    step = abs(one - other)
    beside = -1.0
    if before > 0.0:
        beside = abs(before - one)
    if after > 0.0 and (beside < 0.0 or abs(other - after) < beside):
        beside = abs(other - after)
    limit = NOISE_SHARE * larger + SLOPE_FACTOR * max(beside, 0.0)
    return step <= min(limit, JUMP_SHARE * larger)


@kernel
def _join(inverse, right, down):  # type: ignore[no-untyped-def]
    """right[i, j], down[i, j]: the pixel and its right, lower neighbour are of one surface."""
    height, width = inverse.shape
    for i in range(height):
        for j in range(width):
            if j + 1 < width:
                before = inverse[i, j - 1] if j > 0 else 0.0
                after = inverse[i, j + 2] if j + 2 < width else 0.0
                right[i, j] = _joined(before, inverse[i, j], inverse[i, j + 1], after)
            if i + 1 < height:
                before = inverse[i - 1, j] if i > 0 else 0.0
                after = inverse[i + 2, j] if i + 2 < height else 0.0
                down[i, j] = _joined(before, inverse[i, j], inverse[i + 1, j], after)


@kernel
def _draw_triangle(x0, y0, w0, x1, y1, w1, x2, y2, w2, nearest):  # type: ignore[no-untyped-def]
    """Interpolated inverse depth at the pixel centres in a triangle, borders included; the larger stays."""
    height, width = nearest.shape
    # By a margin a pixel on the line between two triangles belongs to both, however its corners are rounded.
    left, right = min(x0, x1, x2) - MARGIN, max(x0, x1, x2) + MARGIN
    top, bottom = min(y0, y1, y2) - MARGIN, max(y0, y1, y2) + MARGIN
    if right < 0 or bottom < 0 or left > width - 1 or top > height - 1:
        return
    if right - left > LARGEST_TRIANGLE_PX or bottom - top > LARGEST_TRIANGLE_PX:
        return
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    if abs(area) < 1e-9:
        return
    for row in range(max(0, int(np.ceil(top))), min(height - 1, int(np.floor(bottom))) + 1):
        for col in range(max(0, int(np.ceil(left))), min(width - 1, int(np.floor(right))) + 1):
            a = ((x1 - col) * (y2 - row) - (x2 - col) * (y1 - row)) / area
            b = ((x2 - col) * (y0 - row) - (x0 - col) * (y2 - row)) / area
            c = 1.0 - a - b
            if min(a, b, c) >= -MARGIN:
                nearest[row, col] = max(nearest[row, col], a * w0 + b * w1 + c * w2)


@kernel
def _draw_surfaces(cols, rows, inverse, right, down, nearest):  # type: ignore[no-untyped-def]
    """Both triangles of each square of four pixels whose sides join."""
    for i in range(inverse.shape[0] - 1):
        for j in range(inverse.shape[1] - 1):
            x1, y1, w1 = cols[i, j + 1], rows[i, j + 1], inverse[i, j + 1]
            x2, y2, w2 = cols[i + 1, j], rows[i + 1, j], inverse[i + 1, j]
            if right[i, j] and down[i, j]:
                _draw_triangle(cols[i, j], rows[i, j], inverse[i, j], x1, y1, w1, x2, y2, w2, nearest)
            if right[i + 1, j] and down[i, j + 1]:
                x3, y3, w3 = cols[i + 1, j + 1], rows[i + 1, j + 1], inverse[i + 1, j + 1]
                _draw_triangle(x1, y1, w1, x2, y2, w2, x3, y3, w3, nearest)


@kernel
def _is_inner(right, down, i, j):  # type: ignore[no-untyped-def]
    """Whether all six triangles about a pixel are drawn."""
    if i == 0 or j == 0 or i + 1 == right.shape[0] or j + 1 == right.shape[1]:
        return False
    own = right[i, j] and down[i, j] and right[i, j - 1] and down[i - 1, j]
    above, left = right[i - 1, j] and down[i - 1, j + 1], down[i, j - 1] and right[i + 1, j - 1]
    return own and above and left


@kernel
def _draw_rims(cols, rows, inverse, right, down, half_x, half_y, nearest):  # type: ignore[no-untyped-def]
    """A square of constant inverse depth for each pixel that triangles do not surround."""
    height, width = inverse.shape
    for i in range(height):
        for j in range(width):
            if inverse[i, j] == 0.0 or _is_inner(right, down, i, j):
                continue
            low_x, high_x = cols[i, j] - half_x, cols[i, j] + half_x
            low_y, high_y = rows[i, j] - half_y, rows[i, j] + half_y
            if high_x <= 0 or high_y <= 0 or low_x > nearest.shape[1] or low_y > nearest.shape[0]:
                continue
            for row in range(max(0, int(np.ceil(low_y))), min(nearest.shape[0], int(np.ceil(high_y)))):
                for col in range(max(0, int(np.ceil(low_x))), min(nearest.shape[1], int(np.ceil(high_x)))):
                    nearest[row, col] = max(nearest[row, col], inverse[i, j])


def render_depth(
    points: NDArray[np.floating[Any]], camera: PinholeCamera, height: int, width: int
) -> NDArray[np.float32]:
    """Depth of a grid of points as another camera sees it: surfaces closed, hidden ones hidden, holes left.

    Parameters
    ----------
    points : (H, W, 3) metres, in the optical frame of `camera`
        Neighbours in the grid are neighbours in the scene, as in a depth image. NaN, or not in front of the
        camera: no point.
    camera, height, width : the view to draw; pixels

    Returns
    -------
    (height, width) float32, metres along the optical axis; NaN where no surface is seen.

    Raises
    ------
    InputError
        If the points are no grid of at least 2x2.
    """
    if points.ndim != 3 or points.shape[2] != 3 or min(points.shape[:2]) < 2:
        raise InputError(f"points: expected a grid of shape (H, W, 3), got {points.shape}")
    cols, rows, inverse = (np.empty(points.shape[:2]) for _ in range(3))
    pinhole = camera.fx, camera.fy, camera.cx, camera.cy
    _project(
        np.ascontiguousarray(points, np.float32),
        *pinhole,
        limits.MIN_DEPTH_M,
        limits.MAX_DEPTH_M,
        cols,
        rows,
        inverse,
    )
    right, down = np.zeros(inverse.shape, np.bool_), np.zeros(inverse.shape, np.bool_)
    _join(inverse, right, down)
    nearest, rims = np.zeros((height, width)), np.zeros((height, width))
    _draw_surfaces(cols, rows, inverse, right, down, nearest)
    half_x = _half_step(cols[::4], rows[::4], right[::4])
    half_y = _half_step(cols.T[::4], rows.T[::4], down.T[::4])
    _draw_rims(cols, rows, inverse, right, down, half_x, half_y, rims)
    # A rim counts beside its surface and before what is behind it, not against the surface itself.
    seen = np.where(rims > nearest * (1 + BEFORE_SHARE), rims, nearest)
    depth_m = np.full((height, width), np.nan, np.float32)
    np.divide(1.0, seen, out=depth_m, where=seen > 0, casting="same_kind")
    return depth_m


def _half_step(cols: NDArray[np.float64], rows: NDArray[np.float64], joined: NDArray[np.bool_]) -> float:
    """Half of the usual distance in the image of points that follow each other and are joined, pixels."""
    steps = np.hypot(np.diff(cols), np.diff(rows))[joined[:, :-1]]
    half = float(np.median(steps)) / 2 if steps.size else 0.5
    return min(half, LARGEST_SQUARE_PX) + OVERLAP_PX
