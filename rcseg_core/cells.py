"""Surfaces thinned out to a few hundred well-spread measurements each, for fits that pixels are too many for.

A surface is cut into square cells of pixels. The mean signal of a cell lies off a bent surface by half of its
curvature times the spread of the cell, so the mean of the residuals from the region's own patch is taken, and
the patch at the centre of gravity added to it: no pixel is lost, and the patch's own misfit does not matter,
because only its change within one cell enters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.frame import PinholeCamera
from rcseg_core.jit import bare
from rcseg_core.models import Models, predict
from rcseg_core.signals import INVALID, MISFIT, RANGE_OUTLIER, Signals

#: Cells of a surface whose patches are flat, and of others, which a patch follows within small cells only:
#: enough for five parameters and a test, few enough for a dozen fits a frame.
FLAT_CELLS, BENT_CELLS = 300, 900
#: Pixels to a side of a cell that are enough; wider cells leave out rows and columns.
CELL_PX = 6
#: Cells that the box of one surface may be cut into, most of them empty on thin or branched surfaces.
MOST_CELLS = 10_000
#: Pixels this near to another surface may be mixtures of both.
MARGIN_PX = 2
#: A surface that keeps less than this share of its pixels without its margin keeps the margin.
LEAST_CORE = 0.5
#: The noise of a surface may exceed that of the frame (dark, glossy) by this factor, squared.
MOST_SCATTER = 4.0
UNUSABLE = INVALID | RANGE_OUTLIER | MISFIT


class _Layout(NamedTuple):
    """Cells of surfaces 1..M: first cell, pitch, box (row_min, col_min, rows and columns of cells) of each,
    the margin that is left out; rows and columns whose index has a bit in common with `skip` are left out."""

    first: NDArray[np.int64]
    pitch: NDArray[np.int64]
    box: NDArray[np.int64]
    margin: NDArray[np.int64]
    skip: NDArray[np.int64]


@dataclass(frozen=True)
class Cells:
    """Measurements of one surface, one a cell.

    Attributes
    ----------
    points : (m, 3) float64, m, camera or scanner frame
    normals : (m, 3) float64, unit normals of the region's patch there; the side is arbitrary
    spread : (m, 3, k) float64, square roots of the noise: a cell's error is ``spread @ e``, e (k,) white and
        unit; k = 1 for cameras, whose noise goes along the ray, 3 for scanner grids
    pixels : (m,) float64, pixels of each cell
    worth : (m,) float64, independent measurements among them
    tolerance2 : (m,) float64, squared approximation limit over the variance of one pixel's noise
    scatter : float, mean square residual of single pixels within their cells, over the noise's variance;
        where it is above 1 the surface is noisier than the frame, and `spread` has been widened by it
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    spread: NDArray[np.float64]
    pixels: NDArray[np.float64]
    worth: NDArray[np.float64]
    tolerance2: NDArray[np.float64]
    scatter: float

    def chosen(self, mask: NDArray[np.bool_]) -> Cells:
        """Some of the cells."""
        return Cells(
            self.points[mask], self.normals[mask], self.spread[mask], self.pixels[mask], self.worth[mask],
            self.tolerance2[mask], self.scatter,
        )  # fmt: skip


@bare
def _on_rim(surfaces, row, col, margin):  # type: ignore[no-untyped-def]
    """Whether another surface lies within the margin along the row or the column."""
    height, width = surfaces.shape
    own = surfaces[row, col]
    for step in (-margin, margin):
        if 0 <= row + step < height:
            other = surfaces[row + step, col]
            if other != own and other > 0:
                return True
        if 0 <= col + step < width:
            other = surfaces[row, col + step]
            if other != own and other > 0:
                return True
    return False


@bare
def _extent(labels, surfaces, flags, degree, margin, count, core, bent, box):  # type: ignore[no-untyped-def]
    """Usable pixels of each surface, those off its rim, whether a patch of it has a degree (N + 1,) above 1,
    and its box (row_min, col_min, row_max, col_max)."""
    height, width = surfaces.shape
    for row in range(height):
        for col in range(width):
            s = surfaces[row, col]
            if s <= 0 or flags[row, col] & UNUSABLE:
                continue
            count[s] += 1
            bent[s] |= degree[labels[row, col]] > 1
            core[s] += not _on_rim(surfaces, row, col, margin)
            box[s, 0] = min(box[s, 0], row)
            box[s, 1] = min(box[s, 1], col)
            box[s, 2] = max(box[s, 2], row)
            box[s, 3] = max(box[s, 3], col)


@bare
def _gather(labels, surfaces, signals, flags, n_range, models, layout, owner, sums):  # type: ignore[no-untyped-def]
    """Sums over the pixels of each cell: n, row, col, squared residuals, residuals of each range channel.

    A cell belongs to the region of its first pixel, since patches of two regions have no common residual.
    """
    height, width = labels.shape
    for row in range(height):
        for col in range(width):
            s = surfaces[row, col]
            if s <= 0 or (row | col) & layout.skip[s] or flags[row, col] & UNUSABLE:
                continue
            if layout.margin[s] > 0 and _on_rim(surfaces, row, col, layout.margin[s]):
                continue
            k = labels[row, col]
            down = (row - layout.box[s, 0]) // layout.pitch[s]
            cell = layout.first[s] + down * layout.box[s, 3] + (col - layout.box[s, 1]) // layout.pitch[s]
            if owner[cell] == 0:
                owner[cell] = k
            elif owner[cell] != k:
                continue
            sums[cell, 0] += 1.0
            sums[cell, 1] += row
            sums[cell, 2] += col
            for c in range(n_range):
                d = signals[row, col, c] - predict(models, k, float(row), float(col), 0, c)
                sums[cell, 3] += d * d
                sums[cell, 4 + c] += d


@bare
def _evaluate(models, owner, sums, n_range, out):  # type: ignore[no-untyped-def]
    """Patch of each cell at its centre of gravity: value, change a row, change a column, of each channel."""
    for cell in range(owner.shape[0]):
        k = owner[cell]
        row = sums[cell, 1] / sums[cell, 0]
        col = sums[cell, 2] / sums[cell, 0]
        for c in range(n_range):
            out[cell, c, 0] = predict(models, k, row, col, 0, c)
            out[cell, c, 1] = 0.5 * (
                predict(models, k, row + 1.0, col, 0, c) - predict(models, k, row - 1.0, col, 0, c)
            )
            out[cell, c, 2] = 0.5 * (
                predict(models, k, row, col + 1.0, 0, c) - predict(models, k, row, col - 1.0, 0, c)
            )


def _layout(
    labels: NDArray[np.int32], surfaces: NDArray[np.int32], flags: NDArray[np.uint8],
    degree: NDArray[np.int64], correlation: float,
) -> _Layout:  # fmt: skip
    """Cells no smaller than one independent measurement, some hundreds a surface."""
    last = int(surfaces.max(initial=0))
    count, core = np.zeros(last + 1, np.int64), np.zeros(last + 1, np.int64)
    box = np.tile(np.array([surfaces.shape[0], surfaces.shape[1], -1, -1]), (last + 1, 1))
    bent = np.zeros(last + 1, np.bool_)
    _extent(labels, surfaces, flags, degree, MARGIN_PX, count, core, bent, box)
    used = np.where(core >= LEAST_CORE * count, core, count)
    wanted = np.where(bent, BENT_CELLS, FLAT_CELLS)
    size = np.maximum(box[:, 2:] - box[:, :2] + 1, 1)
    pitch = np.ceil(np.sqrt(np.maximum(used / wanted, size.prod(axis=1) / MOST_CELLS))).astype(np.int64)
    pitch = np.maximum(pitch, int(np.ceil(np.sqrt(correlation))))
    pitch[count == 0] = 0
    cells = -(-size // np.maximum(pitch, 1)[:, None])
    number = np.where(pitch > 0, cells.prod(axis=1), 0)
    first = np.concatenate([[0], np.cumsum(number)])
    margin = np.where(used == core, MARGIN_PX, 0)
    skip = 2 ** np.log2(np.maximum(pitch // CELL_PX, 1)).astype(np.int64) - 1
    return _Layout(first, pitch, np.concatenate([box[:, :2], cells], axis=1), margin, skip)


def gather_cells(
    labels: NDArray[np.int32], surfaces: NDArray[np.int32], signals: Signals, models: Models,
    camera: PinholeCamera | None,
) -> list[Cells]:  # fmt: skip
    """The cells of surfaces 1..M.

    Parameters
    ----------
    labels : (H, W) int32, regions that `models` belong to
    surfaces : (H, W) int32, unions of regions, 0 for none
    signals, models : those of the segmentation
    camera : that of the frame; needed where the signal is inverse depth

    Returns
    -------
    list of Cells; surfaces without a usable pixel have none
    """
    n = signals.n_range
    correlation = signals.noise.range_correlation
    degree = np.ascontiguousarray(models.degree[:, 0])
    layout = _layout(labels, surfaces, signals.flags, degree, correlation)
    owner, sums = np.zeros(layout.first[-1], np.int64), np.zeros((layout.first[-1], 4 + n))
    _gather(labels, surfaces, signals.image, signals.flags, n, models, layout, owner, sums)
    kept = np.flatnonzero(owner)
    bounds = np.searchsorted(kept, layout.first)
    owner, sums = owner[kept], sums[kept]
    patch = np.empty((len(kept), n, 3))
    _evaluate(models, owner, sums, n, patch)

    pixels = sums[:, 0]
    row, col = sums[:, 1] / pixels, sums[:, 2] / pixels
    scale, offset = signals.scale[:n], signals.offset[:n]
    whitened = patch[:, :, 0] + sums[:, 4:] / pixels[:, None]
    variance, eps2 = whitened_scales(signals.law, patch[:, 0, 0])
    value, slopes = whitened * scale + offset, patch[:, :, 1:] * scale[:, None]
    within = np.maximum(sums[:, 3] - np.sum(sums[:, 4:] ** 2, axis=1) / pixels, 0.0) / variance
    worth = pixels / correlation
    share = np.sqrt(variance / worth)
    if signals.inverse_depth:
        assert camera is not None
        sigma_w = share * scale[0]
        points, normals, spread = _from_inverse_depth(row, col, value[:, 0], slopes[:, 0], sigma_w, camera)
    else:
        points = value
        normals = np.cross(slopes[:, :, 1], slopes[:, :, 0])
        spread = share[:, None, None] * np.diag(scale)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.where(length > 0, length, 1.0)
    out = []
    for s in range(1, len(layout.pitch)):
        part = slice(bounds[s], bounds[s + 1])
        ahead = np.isfinite(points[part]).all(axis=1)
        spare = n * (pixels[part] - 1.0).sum()
        scatter = float(within[part].sum() / spare) if spare > 0 else 1.0
        wider = float(np.clip(scatter, 1.0, MOST_SCATTER))
        out.append(
            Cells(
                points[part][ahead], normals[part][ahead], np.sqrt(wider) * spread[part][ahead],
                pixels[part][ahead], worth[part][ahead], (eps2 / variance)[part][ahead] / wider, scatter,
            )
        )  # fmt: skip
    return out


def whitened_scales(
    law: NDArray[np.float64], value: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """`signals.local_scales` for arrays: variance of the range noise and squared tolerance, whitened."""
    sigma = np.maximum(law[0] + value * (law[1] + value * law[2]), 0.2)
    return sigma**2, (law[3] + law[4] * value) ** 2


def _from_inverse_depth(
    row: NDArray[np.float64], col: NDArray[np.float64], w: NDArray[np.float64],
    slopes: NDArray[np.float64], sigma_w: NDArray[np.float64], camera: PinholeCamera,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:  # fmt: skip
    """Points (NaN behind the camera), normals of any length, and the noise along the rays."""
    rays = np.stack([(col - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones_like(w)], axis=1)
    ahead = np.where(w > 0, w, np.nan)
    points = rays / ahead[:, None]
    # tangent plane m.X = 1 with X = ray / w, so w = m.ray: linear in the pixel coordinates
    mx, my = slopes[:, 1] * camera.fx, slopes[:, 0] * camera.fy
    normals = np.stack([mx, my, w - mx * rays[:, 0] - my * rays[:, 1]], axis=1)
    spread = points * (sigma_w / ahead)[:, None]  # dX = -X dw / w
    return points, normals, spread[:, :, None]
