"""The range error of a sensor, measured on a recording: what time, area and bend tell apart.

Differences between frames of a static view hold what changes from frame to frame; residuals about planes hold
the whole error; what is left of them in the mean of many frames is a fixed pattern. How the means of square
cells shrink with their area parts the residuals further, in variances of one pixel:

    V(b) = white / b^2 + correlated g(b, m) / g(1, m) + systematic      for cells of b pixels to a side

Everything is in inverse depth, where planes are linear in the pixels. A file that is written from it states
the random error (white and correlated) of one pixel as a law of depth, how many pixels make one independent
measurement of it, and the systematic part in its sigmas.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from rcseg_core.calibration.cells import (
    SIDES,
    bend_of,
    bin_edges,
    cell_tables,
    fit_law,
    independent_pixels,
    law_at,
    parts_of,
    sample_pixels,
    shares,
    variances_of,
)
from rcseg_core.calibration.views import STATIC_FRAMES, View, single_view, static_view, stretches
from rcseg_core.errors import InputError
from rcseg_core.frame import RangeColorFrame

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DepthBin:
    """The error at one depth; standard deviations along depth in metres, NaN where it was not measured.

    depth_m : median; pixels : residuals that were looked at; random : of one pixel, white and correlated;
    temporal : changes from frame to frame; fixed : does not, the systematic part among it
    """

    depth_m: float
    pixels: int
    random: float
    white: float
    correlated: float
    systematic: float
    temporal: float
    fixed: float


@dataclass(frozen=True)
class Calibration:
    """The range error of a sensor as a recording shows it.

    Attributes
    ----------
    law : (3,) float64
        (a, b, c) of the random error of one pixel, ``a + b w + c w^2`` in 1/m, of inverse depth w.
    correlation : float
        Pixels that make one independent measurement.
    systematic : float
        What no number of pixels averages away, in sigmas of the random error.
    temporal, temporal_correlation : float
        What changes from frame to frame, in the same sigmas, and its correlation; NaN without a static view.
    bend : float
        Smooth part of the residual over the whole image, in the same sigmas.
    bins : tuple of DepthBin, near to far
    sides, variances, fitted, temporal_variances : (n,) float64
        Side of the cells, px; variance of their means in that of one pixel's random error, as measured and as
        fitted; the part that changes from frame to frame (NaN where not measured).
    pattern : (H, W) float32
        Mean residual in sigmas; NaN where no plane was.
    frames, static_frames, views : int
        Frames read, those in static views, and views (static, or single frames) that show planes.
    """

    law: Array
    correlation: float
    systematic: float
    temporal: float
    temporal_correlation: float
    bend: float
    bins: tuple[DepthBin, ...]
    sides: Array
    variances: Array
    fitted: Array
    temporal_variances: Array
    pattern: NDArray[np.float32]
    frames: int
    static_frames: int
    views: int

    @property
    def how(self) -> str:
        """How the figures came about, in one sentence."""
        if self.static_frames:
            return (
                f"{self.static_frames} of {self.frames} frames stand still, in {self.views} views: noise "
                "from differences between frames, the rest from residuals about planes"
            )
        return (
            f"no {STATIC_FRAMES} frames in a row stand still: residuals about planes in {self.views} single "
            f"frames of {self.frames}; what changes in time and what does not is not told apart"
        )

    @property
    def one_depth(self) -> bool:
        """Whether the depths are too alike to tell how the error depends on them."""
        return len(self.bins) < 3

    def sigma(self, w: Array) -> Array:
        """Standard deviation of the random error of one pixel, 1/m, at inverse depths w."""
        return law_at(self.law, w)

    def settings(self) -> dict[str, float | str]:
        """The parameters that state it, by dotted key."""
        a, b, c = (float(f"{x:.4g}") for x in self.law)
        return {
            "noise.range_model": "law",
            "noise.range_law_a": max(a, 1e-9),
            "noise.range_law_b": b,
            "noise.range_law_c": c,
            "noise.range_correlation": float(f"{self.correlation:.3g}"),
            "noise.range_systematic": float(f"{self.systematic:.3g}"),
        }


def calibrate(
    frames: Iterable[RangeColorFrame], on_frame: Callable[[int], object] = lambda done: None
) -> Calibration:
    """The range error of the sensor that took the frames.

    Parameters
    ----------
    frames : RangeColorFrame each, of one camera, in the order of time; of a static or slowly moved view in
        which planes are seen: a wall, a floor, a table
    on_frame : called with the number of frames read, after each

    Raises
    ------
    InputError
        No frame, one without camera or of another size, or no plane in any of them.
    """
    views: list[View] = []
    read = static = 0
    for stretch in stretches(frames):
        read += len(stretch)
        still = len(stretch) >= STATIC_FRAMES
        found = [static_view(stretch)] if still else [single_view(one) for one in stretch]
        views += [view for view in found if view is not None]
        static += len(stretch) if still else 0
        on_frame(read)
    if not read:
        raise InputError("calibrate: no frame")
    if not views:
        raise InputError("calibrate: no plane in any frame; show the camera a wall, a floor or a table")
    return _explained(views, read, static)


def _explained(views: list[View], read: int, static: int) -> Calibration:
    pixels = np.concatenate([sample_pixels(*one) for view in views for one in view.singles])
    edges = bin_edges(pixels[:, 0])
    total = fit_law(pixels, edges)
    pattern = _pattern(views, total)
    bend = bend_of(pattern)
    bend2 = float(np.mean(bend[np.isfinite(pattern)] ** 2))
    residuals = cell_tables([one for view in views for one in view.singles], total, bend)
    changes = cell_tables([one for view in views for one in view.changes], total, np.zeros_like(bend))

    variances, changing = variances_of(residuals), variances_of(changes)
    parts, m = parts_of(variances)
    random = max(float(parts[0] + parts[1]), 1e-12)
    changing_parts, length = parts_of(changing / changing[0])
    return Calibration(
        law=total * np.sqrt(random),
        correlation=independent_pixels(parts, m),
        systematic=float(np.sqrt((parts[2] + bend2) / random)),
        temporal=float(np.sqrt(changing[0] / random)),
        temporal_correlation=independent_pixels(changing_parts, length) if static else float("nan"),
        bend=float(np.sqrt(bend2 / random)),
        bins=_bins(residuals, changes, edges, m, total, bend2),
        sides=SIDES,
        variances=(variances + bend2) / random,
        fitted=(shares(SIDES, m) @ parts + bend2) / random,
        temporal_variances=changing / random,
        pattern=(pattern / np.sqrt(random)).astype(np.float32),
        frames=read,
        static_frames=static,
        views=len(views),
    )


def _pattern(views: list[View], law: Array) -> Array:
    """(H, W) mean over the views of the residual in sigmas; NaN where no plane was."""
    total = np.zeros(views[0].mean[0].shape)
    count = np.zeros(total.shape)
    for view in views:
        residual, w = view.mean
        z = residual / law_at(law, w)
        total += np.nan_to_num(z)
        count += np.isfinite(z)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _bins(
    residuals: dict[int, Array], changes: dict[int, Array], edges: Array, m: float, law: Array, bend2: float
) -> tuple[DepthBin, ...]:
    """The parts at each depth, near to far, with the correlation and the bend that all depths share."""
    out = []
    for low, high in pairwise(edges):
        here, moved = (
            {b: t[(t[:, 0] >= low) & (t[:, 0] < high)] for b, t in tables.items()}
            for tables in (residuals, changes)
        )
        variances = variances_of(here)
        known = np.isfinite(variances) & (variances > 0)
        if known.sum() < 3:
            continue
        (white, correlated, rest), _ = nnls(
            shares(SIDES[known], m) / variances[known][:, None], np.ones(known.sum())
        )
        w = float(np.median(here[1][:, 0]))
        temporal2 = variances_of(moved)[0]
        fixed2 = max(variances[0] + bend2 - temporal2, 0.0)
        parts = np.sqrt([white + correlated, white, correlated, rest + bend2, temporal2, fixed2])
        sigmas = parts * float(law_at(law, np.array(w))) / w**2
        out.append(DepthBin(1.0 / w, len(here[1]), *(float(x) for x in sigmas)))
    return tuple(reversed(out))
