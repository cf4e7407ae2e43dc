"""Views of planes in a sequence of frames: where the camera stands still, and residuals about planes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_core.calibration.cells import LEAST_CELLS, WITHIN, cell_means, rms
from rcseg_core.config import SegmenterConfig
from rcseg_core.errors import InputError
from rcseg_core.frame import RangeColorFrame
from rcseg_core.pipeline import segment

Array = NDArray[np.float64]
Image = NDArray[Any]

#: Surfaces from the range alone; a plane that the sensor bends must stay one surface, so the limit is wide.
SURFACES = SegmenterConfig().replace({"grouping.order": "range_only", "grouping.range_tolerance": 0.01})
#: Least surface, share of the image; pixels at its rim that do not count, where sensors mix two depths.
LEAST_SURFACE, RIM_PX = 0.01, 5
#: Frames in a row that make a static view; the change since its first frame, in that between its first two,
#: up to which the camera stood still; and the most of the change that may be smooth over cells.
STATIC_FRAMES, STILL, SMOOTH = 5, 1.5, 0.75
#: Single frames of a static view, and differences between its frames, that are looked at.
SINGLES, PAIRS = 8, 24


class View(NamedTuple):
    """A static view, or a frame by itself: pairs of (H, W) float32 images, 1/m, NaN where there is no plane.

    mean : residual about planes and inverse depth w, of the mean of all frames
    singles : the same of single frames
    changes : difference of two frames / sqrt 2, and w
    """

    mean: tuple[Image, Image]
    singles: list[tuple[Image, Image]]
    changes: list[tuple[Image, Image]]


def stretches(frames: Iterable[RangeColorFrame]) -> Iterator[list[RangeColorFrame]]:
    """Frames in a row that show the same view; a frame by itself where the camera moves."""
    stretch: list[RangeColorFrame] = []
    still = 0.0
    for number, frame in enumerate(frames):
        if frame.camera is None:
            raise InputError(f"calibrate: frame {number} has no camera: no plane is linear in its pixels")
        if stretch and frame.valid.shape != stretch[0].valid.shape:
            raise InputError(f"calibrate: frame {number} has another size than those before it")
        if stretch:
            first, last = (_change(frame, other) for other in (stretch[0], stretch[-1]))
            # the first two frames tell what no motion looks like, if it is noise and no motion
            still = still or STILL * last
            if first > still or (len(stretch) == 1 and not _is_noise(frame, stretch[0])):
                yield stretch
                stretch, still = [], 0.0
        stretch.append(frame)
    if stretch:
        yield stretch


def _inverse(frame: RangeColorFrame) -> Array:
    """(H, W) inverse depth, NaN where invalid."""
    z = np.where(frame.valid, frame.depth_m, np.nan).astype(np.float64)
    return 1.0 / z


def _change(a: RangeColorFrame, b: RangeColorFrame) -> float:
    """Size of the change of inverse depth between two frames: a high quantile, as quanta leave medians 0."""
    d = np.abs(_inverse(a) - _inverse(b))
    d = d[np.isfinite(d)]
    return float(np.quantile(d, 0.9)) if d.size else np.inf


def _is_noise(a: RangeColorFrame, b: RangeColorFrame) -> bool:
    """Whether two frames differ by noise alone: the change of a cell has either sign, and is hardly smooth.

    Of motion, most of the change is that of means over 16 x 16 px; of noise, even if correlated, little.
    """
    d = _inverse(a) - _inverse(b)
    if not np.isfinite(d).any():
        return False
    pixels = d[np.isfinite(d)]
    cells = next((c for c in (cell_means(d[None], side) for side in (16, 4)) if len(c) >= LEAST_CELLS), None)
    if cells is None:
        return False
    whole, means = float(np.median(np.abs(pixels))), float(np.median(np.abs(cells)))
    whole = whole or float(np.quantile(np.abs(pixels), 0.9))
    return means <= SMOOTH * whole


def static_view(stretch: list[RangeColorFrame]) -> View | None:
    """What a static view shows; None without a plane."""
    stack = [_inverse(frame) for frame in stretch]
    known = sum(np.isfinite(w).astype(np.int64) for w in stack)
    total = sum(np.nan_to_num(w) for w in stack)
    mean = np.where(2 * known > len(stack), total / np.maximum(known, 1), np.nan)
    surfaces = _planes_of(mean, stretch[0])
    if surfaces is None:
        return None
    residual = _residual(mean, surfaces)
    on_plane = np.where(np.isfinite(residual), mean, np.nan)
    following = list(pairwise(stack))
    pairs = [following[k] for k in _spaced(len(following), PAIRS)]
    return View(
        _pair(residual, mean),
        [_pair(_residual(stack[k], surfaces), stack[k]) for k in _spaced(len(stack), SINGLES)],
        [_pair((after - before) / np.sqrt(2.0), on_plane) for before, after in pairs],
    )


def single_view(frame: RangeColorFrame) -> View | None:
    """What a frame by itself shows; None without a plane."""
    w = _inverse(frame)
    surfaces = _planes_of(w, frame)
    if surfaces is None:
        return None
    seen = _pair(_residual(w, surfaces), w)
    return View(seen, [seen], [])


def _pair(values: Array, w: Array) -> tuple[Image, Image]:
    return values.astype(np.float32), w.astype(np.float32)


def _spaced(count: int, most: int) -> NDArray[np.int64]:
    """At most `most` of the numbers below `count`, evenly spaced."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


def _planes_of(w: Array, frame: RangeColorFrame) -> NDArray[np.int32] | None:
    """(H, W) int32, the surfaces that are planes, 0 elsewhere; None without one.

    The larger half of what large surfaces hold, by pixels, misses its planes by the sensor's error; things
    that are bent themselves are in the minority, or far beyond.
    """
    assert frame.camera is not None
    depth_m = (1.0 / w).astype(np.float32)
    labels = segment(RangeColorFrame.from_depth(depth_m, frame.color, frame.camera), SURFACES).surface_labels
    labels = np.where(np.isfinite(w), labels, 0).astype(np.int32)
    kept = np.zeros_like(labels)
    misfit, size = {}, {}
    for label in np.nonzero(np.bincount(labels.ravel()) >= LEAST_SURFACE * labels.size)[0]:
        inside = np.zeros((labels.shape[0] + 2, labels.shape[1] + 2), np.uint8)
        inside[1:-1, 1:-1] = labels == label
        # single missing pixels are no rim
        inside = cv2.morphologyEx(inside, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        inner = cv2.erode(inside, np.ones((2 * RIM_PX + 1,) * 2, np.uint8))[1:-1, 1:-1] > 0
        inner &= labels == label
        if label == 0 or inner.sum() < 0.5 * LEAST_SURFACE * labels.size:
            continue
        kept[inner] = label
        r = _plane_residual(w, inner)[inner]
        misfit[int(label)] = rms(r) / float(np.median(w[inner]))
        size[int(label)] = int(inner.sum())
    if not misfit:
        return None
    order = sorted(misfit, key=lambda one: misfit[one])
    count = np.cumsum([size[one] for one in order])
    limit = 1.5 * misfit[order[int(np.searchsorted(count, 0.5 * count[-1]))]]
    planes = [one for one in order if misfit[one] <= limit]
    return np.where(np.isin(kept, planes), kept, 0).astype(np.int32)


def _residual(w: Array, surfaces: NDArray[np.int32]) -> Array:
    """(H, W) residuals of inverse depth about the plane of each surface; NaN elsewhere and at outliers."""
    out = np.full(w.shape, np.nan)
    for label in np.unique(surfaces[surfaces > 0]):
        inside = (surfaces == label) & np.isfinite(w)
        if inside.sum() > 100:
            r = _plane_residual(w, inside)
            out[inside] = r[inside]
    return out


def _plane_residual(w: Array, inside: NDArray[np.bool_]) -> Array:
    """Residuals about the plane through the pixels `inside`, fitted again without outliers; those are NaN."""
    rows, cols = np.nonzero(inside)
    table = np.stack([np.ones(rows.size), cols / w.shape[1] - 0.5, rows / w.shape[0] - 0.5], 1)
    values = w[inside]
    good = np.ones(rows.size, np.bool_)
    for _ in range(4):
        coef, *_ = np.linalg.lstsq(table[good], values[good], rcond=None)
        r = values - table @ coef
        good = np.abs(r) <= WITHIN * np.quantile(np.abs(r[good]), 0.9) + 1e-12
    out = np.full(w.shape, np.nan)
    out[inside] = np.where(good, r, np.nan)
    return out
