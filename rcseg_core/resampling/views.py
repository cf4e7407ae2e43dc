"""A scanner's grid as a pinhole camera would see it, and a result of that view back on the grid.

Where the rays pass through one centre (`rays`), the frame is resampled to the image of a virtual camera in
that centre, because there inverse depth makes planes linear in rows and columns; it is segmented there, and
every pixel of the grid takes the regions of the virtual pixel that shows it. The final patches are fitted to
x, y, z over the grid's own rows and columns.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from rcseg_core.config import SegmenterConfig
from rcseg_core.frame import PinholeCamera, RangeColorFrame
from rcseg_core.resampling.carrying import carried
from rcseg_core.resampling.rays import SphericalRays, TurnedPinhole, find_rays
from rcseg_core.resampling.sampling import find_back, sample_inverse_depth
from rcseg_core.result.segmentation import Region, Segmentation
from rcseg_core.signal.signals import INVALID, Signals, build_signals

T = TypeVar("T", bound=np.generic)

#: Widest angle between a ray and the axis of the virtual camera; pixels grow with its inverse squared cosine.
MAX_ANGLE_RAD = np.deg2rad(60.0)
#: The virtual image may have this many times the pixels of the grid.
MAX_GROWTH = 4.0


@dataclass(frozen=True)
class PinholeView:
    """A grid without a camera, seen by a virtual one.

    Attributes
    ----------
    frame : RangeColorFrame
        What the virtual camera sees; colour after the reflectance stage.
    back : (H, W) int64
        Flat index of the virtual pixel that shows each pixel of the grid; -1 where it has no range.
    source : (h, w) int64
        Flat index of the pixel of the grid that each virtual pixel was sampled from; -1 outside of the grid.
    seconds : float
        What the view took to make.
    """

    frame: RangeColorFrame
    back: NDArray[np.int64]
    source: NDArray[np.int64]
    seconds: float


def pinhole_view(
    frame: RangeColorFrame, color: NDArray[np.uint8], config: SegmenterConfig
) -> PinholeView | None:
    """The view that a frame is to be segmented in; None where it is segmented as it is.

    That is so for frames with a camera, for ``signal.kind = xyz``, for grids whose rays do not pass through
    the origin (parallel rays, points moved to another frame) and for fields of view beyond a pinhole camera.

    Parameters
    ----------
    color : (H, W, 3) uint8, after the reflectance stage
    """
    if frame.camera is not None or config.signal.kind == "xyz":
        return None
    start = time.perf_counter()
    rays = find_rays(frame)
    if rays is None:
        return None
    if isinstance(rays, SphericalRays):
        return _resampled(frame, color, rays, start)
    if isinstance(rays, TurnedPinhole):
        points = (frame.points @ rays.axes.T).astype(frame.points.dtype)
        seen = RangeColorFrame(points, color, rays.camera)
    else:
        seen = RangeColorFrame(frame.points, color, rays)
    source = np.arange(seen.valid.size).reshape(seen.valid.shape)
    return PinholeView(seen, np.where(seen.valid, source, -1), source, time.perf_counter() - start)


def _resampled(
    frame: RangeColorFrame, color: NDArray[np.uint8], rays: SphericalRays, start: float
) -> PinholeView | None:
    directions = rays.directions()
    axes = _view_axes(directions)
    seen = directions @ axes.T
    if not seen[..., 2].min() >= np.cos(MAX_ANGLE_RAD):
        return None
    x, y = seen[..., 0] / seen[..., 2], seen[..., 1] / seen[..., 2]
    step_x, step_y = _step(x, 1), _step(y, 0)
    width, height = (int(np.ceil(np.ptp(g) / s)) + 1 for g, s in ((x, step_x), (y, step_y)))
    if min(width, height) < 3 or width * height > MAX_GROWTH * x.size:
        return None
    camera = PinholeCamera(1 / step_x, 1 / step_y, float(-x.min() / step_x), float(-y.min() / step_y))

    rows, cols = rays.locate(camera.rays(height, width).astype(np.float64) @ axes)
    points = np.where(frame.valid[..., None], frame.points, 0.0)
    depth = points @ axes[2]
    with np.errstate(divide="ignore"):
        inverse = np.where(depth > 0, 1.0 / depth, 0.0)
    shown = np.empty((height, width))
    source = np.empty((height, width), np.int64)
    sample_inverse_depth(inverse, rows, cols, shown, source)
    back = np.empty(inverse.shape, np.int64)
    find_back(inverse, x / step_x + camera.cx, y / step_y + camera.cy, rows, cols, shown, source, back)
    if not (shown > 0).any():
        return None
    with np.errstate(divide="ignore"):
        depth_m = np.where(shown > 0, 1.0 / shown, np.nan).astype(np.float32)
    # outside of the field lie copies of the frame, so that the noise of colour is not measured on plain black
    i, j = np.ogrid[:height, :width]
    elsewhere = (i % x.shape[0]) * x.shape[1] + j % x.shape[1]
    colors = color.reshape(-1, 3)[np.where(source >= 0, source, elsewhere)]
    seen_frame = RangeColorFrame.from_depth(depth_m, colors, camera)
    return PinholeView(seen_frame, back, source, time.perf_counter() - start)


def _view_axes(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) rows: to the right (columns grow), down (rows grow), ahead; a mirrored grid stays mirrored."""
    corners = directions[[0, 0, -1, -1], [0, -1, 0, -1]]
    ahead = corners.sum(axis=0) + directions[directions.shape[0] // 2, directions.shape[1] // 2]
    ahead /= np.linalg.norm(ahead)
    right = directions[:, -1].mean(axis=0) - directions[:, 0].mean(axis=0)
    right -= (right @ ahead) * ahead
    right /= np.linalg.norm(right)
    down = np.cross(ahead, right)
    if down @ (directions[-1].mean(axis=0) - directions[0].mean(axis=0)) < 0:
        down = -down
    return np.stack([right, down, ahead])


def _step(values: NDArray[np.float64], axis: int) -> float:
    """The step between neighbours in the middle of the field, where gnomonic coordinates are the densest."""
    quarter, fourth = values.shape[0] // 4, values.shape[1] // 4
    middle = values[quarter:-quarter, fourth:-fourth]
    return float(np.median(np.abs(np.diff(middle, axis=axis))))


def carried_back(
    view: PinholeView, result: Segmentation, frame: RangeColorFrame, color: NDArray[np.uint8],
    config: SegmenterConfig,
) -> Segmentation:  # fmt: skip
    """The result of a view on the pixels of the frame itself.

    The partition and its tree are those of the view, numbered by their size on the grid; noise, models and
    patches are those of x, y, z over the grid, as for every frame without a camera.

    Parameters
    ----------
    result : Segmentation of ``view.frame``
    frame, color : the frame, and its colour after the reflectance stage
    """
    start = time.perf_counter()
    measurable = view.back >= 0
    back = _back_to_all(view, result.labels)

    def on_grid(image: NDArray[T]) -> NDArray[T]:
        return np.where(measurable, image.ravel()[back], image.dtype.type(0))

    def whiten() -> Signals:
        flags = np.where(measurable, on_grid(result.signals.flags), INVALID).astype(np.uint8)
        return replace(build_signals(frame, color, config.replace({"signal.kind": "xyz"})), flags=flags)

    range_leaves = None if result.range_leaves is None else on_grid(result.range_leaves)
    on_all = carried(
        result, frame, config, np.ascontiguousarray(on_grid(result.labels)), on_grid(result.leaves),
        range_leaves, np.ascontiguousarray(on_grid(result.edges)), whiten,
    )  # fmt: skip
    return replace(
        on_all,
        timings={"view": view.seconds, **result.timings, "grid": time.perf_counter() - start},
        describe=lambda: _facing_the_centre(on_all.describe()),
        view=result,
    )


def _back_to_all(view: PinholeView, labels: NDArray[np.int32]) -> NDArray[np.int64]:
    """`view.back`, changed so that every region of the view is shown by a pixel of the grid.

    The virtual image is denser towards its border: a region that lies between the pixels of the grid gets the
    one that its samples came from, of the largest region at stake.
    """
    back: NDArray[np.int64] = view.back.copy()
    shown = back[back >= 0]
    sizes = np.bincount(labels.ravel()[shown], minlength=int(labels.max()) + 1)
    for label in np.flatnonzero(sizes[1:] == 0) + 1:
        pixels = np.flatnonzero(labels.ravel() == label)
        owners = labels.ravel()[back.ravel()[view.source.ravel()[pixels]]]
        best = int(np.argmax(sizes[owners]))
        back.ravel()[view.source.ravel()[pixels[best]]] = pixels[best]
        sizes[owners[best]] -= 1
        sizes[label] += 1
    return back


def _facing_the_centre(regions: Sequence[Region]) -> list[Region]:
    """The regions, their normals towards the centre of the rays (of a grid in general: against z)."""
    return [
        replace(region, normal=-region.normal) if region.normal @ region.centroid > 0 else region
        for region in regions
    ]
