"""Surfaces thinned out to a few hundred well-spread measurements each, for fits that pixels are too many for.

A surface is cut into square cells of pixels. The mean signal of a cell lies off a bent surface by half of its
curvature times the spread of the cell, so the mean of the residuals from the region's own patch is taken, and
the patch at the centre of gravity added to it: no pixel is lost, and the patch's own misfit does not matter,
because only its change within one cell enters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_core.frame import PinholeCamera
from rcseg_core.models.polynomials import Models
from rcseg_core.shapes.cell_sums import Layout, evaluate, gather, mark_rims, measure_extent
from rcseg_core.signal.signals import Signals, scales

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
    systematic2 : float, squared misfit that is no evidence over the variance of one pixel's noise, see
        `noise.NoiseModel.range_doubt2`
    scatter : float, mean square residual of single pixels within their cells, over the noise's variance;
        where it is above 1 the surface is noisier than the frame, and `spread` has been widened by it
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    spread: NDArray[np.float64]
    pixels: NDArray[np.float64]
    worth: NDArray[np.float64]
    tolerance2: NDArray[np.float64]
    systematic2: float
    scatter: float

    def chosen(self, mask: NDArray[np.bool_]) -> Cells:
        """Some of the cells."""
        return Cells(
            self.points[mask], self.normals[mask], self.spread[mask], self.pixels[mask], self.worth[mask],
            self.tolerance2[mask], self.systematic2, self.scatter,
        )  # fmt: skip


def _layout(
    labels: NDArray[np.int32], surfaces: NDArray[np.int32], rim: NDArray[np.bool_],
    flags: NDArray[np.uint8], degree: NDArray[np.int64], correlation: float,
) -> Layout:  # fmt: skip
    """Cells no smaller than one independent measurement, some hundreds a surface."""
    last = int(surfaces.max(initial=0))
    count, core = np.zeros(last + 1, np.int64), np.zeros(last + 1, np.int64)
    box = np.tile(np.array([surfaces.shape[0], surfaces.shape[1], -1, -1]), (last + 1, 1))
    bent = np.zeros(last + 1, np.bool_)
    measure_extent(labels, surfaces, rim, flags, degree, count, core, bent, box)
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
    return Layout(first, pitch, np.concatenate([box[:, :2], cells], axis=1), margin, skip)


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
    rim = np.empty(surfaces.shape, np.bool_)
    mark_rims(surfaces, MARGIN_PX, rim)
    layout = _layout(labels, surfaces, rim, signals.flags, degree, correlation)
    owner, sums = np.zeros(layout.first[-1], np.int64), np.zeros((layout.first[-1], 4 + n))
    line = np.empty((n, models.coef.shape[2]))
    gather(labels, surfaces, rim, signals.image, signals.flags, n, models, layout, line, owner, sums)
    kept = np.flatnonzero(owner)
    bounds = np.searchsorted(kept, layout.first)
    owner, sums = owner[kept], sums[kept]
    patch = np.empty((len(kept), n, 3))
    evaluate(models, owner, sums, n, patch)

    pixels = sums[:, 0]
    row, col = sums[:, 1] / pixels, sums[:, 2] / pixels
    scale, offset = signals.scale[:n], signals.offset[:n]
    whitened = patch[:, :, 0] + sums[:, 4:] / pixels[:, None]
    variance, eps2 = scales(signals.law, patch[:, 0, 0])
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
    tolerance2, before = eps2 / variance, np.asarray(np.isfinite(points).all(axis=1))
    whole = bool(before.all())
    out = []
    for s in range(1, len(layout.pitch)):
        part = slice(bounds[s], bounds[s + 1])
        ahead: Any = slice(None) if whole else before[part]
        spare = n * (pixels[part] - 1.0).sum()
        scatter = float(within[part].sum() / spare) if spare > 0 else 1.0
        wider = float(np.clip(scatter, 1.0, MOST_SCATTER))
        out.append(
            Cells(
                points[part][ahead], normals[part][ahead], np.sqrt(wider) * spread[part][ahead],
                pixels[part][ahead], worth[part][ahead], tolerance2[part][ahead] / wider,
                signals.noise.range_doubt2 / wider, scatter,
            )
        )  # fmt: skip
    return out


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
