"""The rays of a grid without a camera model: do they pass through one centre, and where does each point?

A plane n.p = d seen along the ray g (g_z = 1) has inverse depth 1/z = n.g/d, linear in the gnomonic
coordinates of the ray (section 2 asks for a signal that is polynomial on a plane); in x, y, z over the rows
and columns of a scanner it is no polynomial. So it pays to know the rays, and points tell them: the direction
of a pixel must not depend on its range. Two kinds of grid are known, in any axes. A depth camera whose
intrinsics got lost: in its optical axes x/z is affine in the column, y/z in the row. A spherical scanner: one
elevation a row and one azimuth a column, or the other way round (spinning lidars, pan-tilt units). Parallel
rays (triangulation scanners) fit neither.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_core.errors import InputError
from rcseg_core.frame import MIN_DEPTH_M, PinholeCamera, RangeColorFrame

Array = NDArray[np.float64]

#: Largest distance of a pixel's point from its modelled ray, as a share of the step between rays, ...
MAX_MISFIT_PX = 0.3
#: ... which all but a tenth of the pixels must keep (flying pixels may lie between two rays).
KEPT_SHARE = 0.9
#: Parallel rays must explain the grid this many times worse: a board seen head on is no evidence.
PARALLEL_FACTOR = 2.0
#: Rows and columns that a grid must have with LEAST_PIXELS points in each.
LEAST_LINES, LEAST_PIXELS = 8, 3
#: Points that the models are judged by, and points of a line that tell its angle.
SAMPLES, LINE_SAMPLES = 20_000, 100


@dataclass(frozen=True)
class SphericalRays:
    """A scanner that turns about an axis: pixel (row, col) looks along one elevation and one azimuth.

    Attributes
    ----------
    axes : (3, 3) float64, orthonormal rows: the direction of azimuth and elevation 0, that of azimuth 90
        degrees, and the axis (elevation 90 degrees), in the frame of the points
    elevation : (H,) float64, rad, strictly monotonic
    azimuth : (W,) float64, rad, strictly monotonic
    by_column : bool
        The columns have the elevations, (W,), and the rows the azimuths, (H,), instead.
    """

    axes: Array
    elevation: Array
    azimuth: Array
    by_column: bool = False

    def directions(self) -> Array:
        """(H, W, 3) unit vectors."""
        up, out = np.sin(self.elevation)[:, None, None], np.cos(self.elevation)[:, None, None]
        around = np.cos(self.azimuth)[:, None] * self.axes[0] + np.sin(self.azimuth)[:, None] * self.axes[1]
        directions = np.asarray(out * around[None] + up * self.axes[2])
        return directions.swapaxes(0, 1) if self.by_column else directions

    def locate(self, directions: Array) -> tuple[Array, Array]:
        """Fractional rows and columns of directions (..., 3) of any length; NaN outside of the grid.

        The grid ends half a step beyond its outermost rays.
        """
        e1, e2, axis = np.moveaxis(directions @ self.axes.T, -1, 0)
        up = _index(np.arctan2(axis, np.hypot(e1, e2)), self.elevation)
        around = _index(np.arctan2(e2, e1), self.azimuth)
        return (around, up) if self.by_column else (up, around)


@dataclass(frozen=True)
class TurnedPinhole:
    """A depth camera whose points are in other axes than its optical ones, such as x ahead and z up.

    Attributes
    ----------
    axes : (3, 3) float64, rotation; rows: to the right (columns grow), down (rows grow) and ahead, in the
        frame of the points
    camera : PinholeCamera
    """

    axes: Array
    camera: PinholeCamera


def find_rays(frame: RangeColorFrame) -> PinholeCamera | TurnedPinhole | SphericalRays | None:
    """The rays of a grid, from its points alone; None where they do not pass through the origin.

    Parameters
    ----------
    frame : RangeColorFrame
        Its camera is not looked at.
    """
    points, range_m = _usable(frame)
    usable = np.isfinite(range_m)
    enough = [int((usable.sum(axis=a) >= LEAST_PIXELS).sum()) >= LEAST_LINES for a in (0, 1)]
    if not all(enough):
        return None
    parallel = _parallel_misfit(points, usable)
    for fit in (_fit_pinhole, _fit_sphere, _fit_sphere_by_column):
        found = fit(points, range_m)
        if found is None:
            continue
        rays, misfit = found
        if misfit <= MAX_MISFIT_PX and misfit * PARALLEL_FACTOR < parallel:
            return rays
    return _fit_turned(points, range_m)


def _usable(frame: RangeColorFrame) -> tuple[Array, Array]:
    """Points (H, W, 3) and their distance (H, W) in float64, NaN where there is none."""
    points = np.where(frame.valid[..., None], frame.points, np.nan).astype(np.float64)
    range_m = np.sqrt(np.einsum("ijk,ijk->ij", points, points))
    with np.errstate(invalid="ignore"):
        near = range_m < MIN_DEPTH_M  # a point in the origin has no direction
    points[near], range_m[near] = np.nan, np.nan
    return points, range_m


def _samples(usable: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of at most about SAMPLES usable pixels, evenly spread."""
    rows, cols = np.nonzero(usable)
    stride = max(1, rows.size // SAMPLES)
    return rows[::stride], cols[::stride]


def _kept(misfit: Array) -> float:
    """What all but a tenth of the pixels keep; infinite where nothing can be said."""
    return float(np.quantile(misfit, KEPT_SHARE)) if misfit.size and np.isfinite(misfit).all() else np.inf


def _parallel_misfit(points: Array, usable: NDArray[np.bool_]) -> float:
    """Distance in pixels from a grid whose x and y are affine in row and column, whatever z is."""
    rows, cols = _samples(usable)
    design = np.stack([np.ones(rows.size), rows, cols], axis=1)
    xy = points[rows, cols, :2]
    affine = np.linalg.lstsq(design, xy, rcond=None)[0]
    pitch = np.sqrt(abs(np.linalg.det(affine[1:])))
    if not pitch > 0:
        return np.inf
    return _kept(np.abs(xy - design @ affine).max(axis=1) / pitch)


def _fit_pinhole(points: Array, range_m: Array) -> tuple[PinholeCamera, float] | None:
    """The camera in the optical frame of the points, and its misfit in pixels."""
    lines = []
    for axis in (0, 1):
        value = _line_medians(_gnomonic(_thinned(points, axis))[..., axis], axis)
        known = np.flatnonzero(np.isfinite(value))
        if known.size < LEAST_LINES:
            return None
        lines.append(np.polyfit(known, value[known], 1))
    (step_x, x0), (step_y, y0) = lines
    if not (step_x > 0 and step_y > 0):
        return None
    rows, cols = _samples(np.isfinite(range_m))
    sample = _gnomonic(points[rows, cols])
    off_x = np.abs(sample[:, 0] - x0 - step_x * cols) / step_x
    off_y = np.abs(sample[:, 1] - y0 - step_y * rows) / step_y
    try:
        camera = PinholeCamera(*(float(v) for v in (1 / step_x, 1 / step_y, -x0 / step_x, -y0 / step_y)))
    except InputError:
        return None
    return camera, _kept(np.maximum(off_x, off_y))


def _fit_turned(points: Array, range_m: Array) -> TurnedPinhole | None:
    """The camera whose points are in other axes; None where there is none.

    The directions of a pinhole are M (col, row, 1) with M = axes^T K^-1. Crossed with the points that is
    linear in M, whose columns then tell the axes: the first two lie along the rows and columns of the image.
    """
    rows, cols = _samples(np.isfinite(range_m))
    unit = points[rows, cols] / range_m[rows, cols, None]
    size = float(max(range_m.shape))
    pixel = np.stack([cols / size, rows / size, np.ones(rows.size)], axis=1)
    axes = np.eye(3)
    for _ in range(2):  # once more without what lies between two surfaces
        matrix = _homography(pixel, unit)
        seen = pixel @ matrix.T
        if np.median(np.einsum("ij,ij->i", seen, unit)) < 0:
            matrix, seen = -matrix, -seen
        square = _axes_of(matrix)
        if square is None:
            return None
        axes = square
        off = np.linalg.norm(np.cross(seen, unit), axis=1)
        kept = off <= np.quantile(off, KEPT_SHARE)
        pixel, unit = pixel[kept], unit[kept]
    turned = points @ axes.T
    found = _fit_pinhole(turned, range_m)
    if found is None:
        return None
    camera, misfit = found
    parallel = _parallel_misfit(turned, np.isfinite(range_m))
    good = misfit <= MAX_MISFIT_PX and misfit * PARALLEL_FACTOR < parallel
    return TurnedPinhole(axes, camera) if good else None


def _homography(pixel: Array, unit: Array) -> Array:
    """(3, 3) M of least |M pixel x unit|, |M| = 1; M and -M are the same to it."""
    x, y, z = unit.T[:, :, None]
    none = np.zeros_like(pixel)
    crossed = np.concatenate(
        [
            np.hstack([none, z * pixel, -y * pixel]),
            np.hstack([-z * pixel, none, x * pixel]),
            np.hstack([y * pixel, -x * pixel, none]),
        ]
    )
    return np.asarray(np.linalg.eigh(crossed.T @ crossed)[1][:, 0].reshape(3, 3))


def _axes_of(matrix: Array) -> Array | None:
    """The axes from M, see `_fit_turned`; None where it is no camera's with square angles."""
    right, down = matrix[:, 0], matrix[:, 1]
    lengths = np.linalg.norm(right), np.linalg.norm(down)
    if min(lengths) < 1e-9:
        return None
    right, down = right / lengths[0], down / lengths[1]
    skew = float(right @ down)
    if abs(skew) > 0.05:
        return None
    right, down = right - 0.5 * skew * down, down - 0.5 * skew * right  # square to first order
    right /= np.linalg.norm(right)
    down = down - (down @ right) * right
    down /= np.linalg.norm(down)
    return np.stack([right, down, np.cross(right, down)])


def _gnomonic(points: Array) -> Array:
    """x/z and y/z of points (..., 3); NaN behind the camera."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(points[..., :2] / np.where(points[..., 2:] > 0, points[..., 2:], np.nan))


def _fit_sphere(points: Array, range_m: Array) -> tuple[SphericalRays, float] | None:
    """The spherical grid and its misfit in pixels.

    A row is a cone about the axis: the component of its directions along the axis does not vary. So the axis
    is the direction of least scatter within the rows.
    """
    rows, cols = _samples(np.isfinite(range_m))
    sample = points[rows, cols] / range_m[rows, cols, None]
    count = np.bincount(rows, minlength=range_m.shape[0])
    means = np.stack([np.bincount(rows, s, minlength=count.size) for s in sample.T], axis=1)
    within = sample - (means / np.maximum(count, 1)[:, None])[rows]
    axis = np.linalg.eigh(within.T @ within)[1][:, 0]
    ahead = sample.mean(axis=0)
    ahead -= (ahead @ axis) * axis
    length = float(np.linalg.norm(ahead))
    if not length > 1e-3:  # round the pole, or all round
        return None
    axes = np.stack([ahead / length, np.cross(axis, ahead / length), axis])

    (rows_e1, rows_e2, rows_up), (cols_e1, cols_e2, _) = (
        np.moveaxis(_thinned(points, axis) @ axes.T, -1, 0) for axis in (1, 0)
    )
    elevation = _filled(_line_medians(np.arctan2(rows_up, np.hypot(rows_e1, rows_e2)), 1))
    azimuth = _filled(_line_medians(np.arctan2(cols_e2, cols_e1), 0))
    if elevation is None or azimuth is None:
        return None
    rays = SphericalRays(axes, elevation, azimuth)
    at_rows, at_cols = rays.locate(sample)
    off = np.maximum(np.abs(at_rows - rows), np.abs(at_cols - cols))
    return rays, _kept(np.where(np.isfinite(off), off, 1.0))  # beyond the border of the grid


def _fit_sphere_by_column(points: Array, range_m: Array) -> tuple[SphericalRays, float] | None:
    """The spherical grid whose columns are cones about the axis, and its misfit in pixels."""
    found = _fit_sphere(points.swapaxes(0, 1), range_m.T)
    return None if found is None else (replace(found[0], by_column=True), found[1])


def _thinned(image: Array, axis: int) -> Array:
    """About LINE_SAMPLES pixels of each column (axis 0) or row (axis 1) of an image (H, W, ...)."""
    stride = max(1, image.shape[axis] // LINE_SAMPLES)
    return image[::stride] if axis == 0 else image[:, ::stride]


def _line_medians(values: Array, axis: int) -> Array:
    """Median of each column (axis 0) or row (axis 1) of (H, W) values; NaN with fewer than LEAST_PIXELS."""
    known = np.isfinite(values)
    count = known.sum(axis=axis)
    ordered = np.sort(np.where(known, values, np.inf), axis=axis)
    middle = np.expand_dims(np.maximum(count - 1, 0) // 2, axis)
    medians = np.take_along_axis(ordered, middle, axis).squeeze(axis)
    return np.where(count >= LEAST_PIXELS, medians, np.nan)


def _filled(angles: Array) -> Array | None:
    """Angles of all lines, unknown ones between their neighbours; None unless they are monotonic."""
    known = np.flatnonzero(np.isfinite(angles))
    if known.size < LEAST_LINES:
        return None
    first, last = known[0], known[-1]
    step = (angles[last] - angles[first]) / (last - first)
    index = np.arange(angles.size)
    filled = np.interp(index, known, angles[known])
    filled += step * (np.minimum(index - first, 0) + np.maximum(index - last, 0))
    monotonic = (np.diff(filled) * np.sign(step) > 0).all()
    return filled if monotonic else None


def _index(angle: Array, angles: Array) -> Array:
    """Fractional index of `angle` in the strictly monotonic `angles`; NaN beyond half a step outside."""
    index: NDArray[Any] = np.arange(-1.0, angles.size + 1.0)
    ends = (2 * angles[0] - angles[1], 2 * angles[-1] - angles[-2])
    grid = np.concatenate([ends[:1], angles, ends[1:]])
    if grid[0] > grid[-1]:
        grid, index = grid[::-1], index[::-1]
    at = np.interp(angle, grid, index)
    return np.where((at >= -0.5) & (at < angles.size - 0.5), at, np.nan)
