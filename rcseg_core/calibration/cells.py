"""Variances of the means of square cells, and what parts of the error of a pixel they tell of.

    V(b) = white / b^2 + correlated g(b, m) / g(1, m) + systematic      for cells of b pixels to a side

Residuals are in inverse depth, 1/m, or in sigmas; NaN marks what is unknown.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from rcseg_core.signal.spread import cell_share

Array = NDArray[np.float64]
Image = NDArray[Any]

#: Sides of the cells, px; those of single pixels first.
CELLS_PX = (1, 2, 4, 8, 16, 32)
SIDES = np.array(CELLS_PX, np.float64)
#: A value counts within this many 90 % quantiles: 5 sigmas of a normal law, however coarse the quanta.
WITHIN = 3.0
#: Depth bins, and by how much a bin must differ from the next.
BINS, BIN_STEP = 6, 1.05
#: Cells of a size that are enough to tell their variance.
LEAST_CELLS = 12
#: Cells that an image shows of a size that is looked at: of fewer, the planes themselves follow the noise.
CELLS_AN_IMAGE = 60
#: Most samples of one size that an image adds.
SAMPLES = 20_000
#: Lengths of correlation that are tried, as pixels that make one measurement.
CANDIDATES = np.exp(np.linspace(np.log(3.0), np.log(600.0), 100))
#: The bend is a polynomial of this degree over the image, through means of cells of this size at 640x480.
BEND_DEGREE, BEND_CELL_PX = 4, 16


def rms(values: Array) -> float:
    """Root mean square without outliers; NaN of nothing."""
    size = np.abs(values[np.isfinite(values)])
    if not size.size:
        return float("nan")
    size = size[size <= WITHIN * np.quantile(size, 0.9)]
    return float(np.sqrt(np.mean(size**2)))


def law_at(law: Array, w: Array) -> Array:
    return np.asarray(law[0] + law[1] * w + law[2] * w * w, np.float64)


def sample_pixels(values: Image, w: Image) -> Array:
    """(n, 2) inverse depth and value of known pixels, SAMPLES at most."""
    known = np.isfinite(values) & np.isfinite(w)
    table = np.stack([w[known], values[known]], 1).astype(np.float64)
    return table[:: max(1, len(table) // SAMPLES)]


def bin_edges(w: Array) -> Array:
    """Edges of bins of inverse depth with about as many values each, none narrower than BIN_STEP."""
    edges = [float(w.min()) * (1 - 1e-9)]
    for edge in np.quantile(w, np.linspace(0, 1, BINS + 1))[1:]:
        if edge >= BIN_STEP * edges[-1]:
            edges.append(float(edge))
    edges[-1 if len(edges) > 1 else 1 :] = [float(w.max()) * (1 + 1e-9)]
    return np.array(edges)


def fit_law(table: Array, edges: Array) -> Array:
    """Non-negative (a, b, c) through the rms of the bins; (a, 0, 0) where there are less than three."""
    s, y = [], []
    for low, high in pairwise(edges):
        part = table[(table[:, 0] >= low) & (table[:, 0] < high)]
        if len(part) > 50:
            s.append(float(np.median(part[:, 0])))
            y.append(max(rms(part[:, 1]), 1e-9))
    if len(s) < 3:
        return np.array([max(rms(table[:, 1]), 1e-9), 0.0, 0.0])
    x = np.array(s)
    law, _ = nnls(np.stack([x**0, x, x**2], 1) / np.array(y)[:, None], np.ones(len(y)))
    return np.asarray(law, np.float64)


def bend_of(pattern: Array) -> Array:
    """(H, W) the polynomial of low degree through the pattern; zero where too little is covered."""
    height, width = pattern.shape
    side = max(4, round(BEND_CELL_PX * width / 640))
    rows, cols = np.mgrid[:height, :width]
    x, y = 2.0 * cols / width - 1.0, 2.0 * rows / height - 1.0
    cells = cell_means(np.stack([pattern, x, y]), side)
    powers = [(i, j) for i in range(BEND_DEGREE + 1) for j in range(BEND_DEGREE + 1 - i)]
    if len(cells) < 3 * len(powers):
        return np.zeros(pattern.shape)
    table = np.stack([cells[:, 1] ** i * cells[:, 2] ** j for i, j in powers], 1)
    # a small part that hardly shows a direction of the polynomial says nothing of it
    coef, *_ = np.linalg.lstsq(table, cells[:, 0], rcond=1e-3)
    known = np.isfinite(pattern)
    out = np.zeros(pattern.shape)
    out[known] = sum(c * x[known] ** i * y[known] ** j for c, (i, j) in zip(coef, powers, strict=True))
    return out


def cell_tables(images: list[tuple[Image, Image]], law: Array, bend: Array) -> dict[int, Array]:
    """By side of the cells: (n, 2) mean inverse depth and mean value in sigmas, the bend taken off."""
    tables: dict[int, list[Array]] = {side: [np.empty((0, 2))] for side in CELLS_PX}
    for values, w in images:
        z = values / law_at(law, w) - bend
        for side, parts in tables.items():
            cells = cell_means(np.stack([w, z]), side)
            parts.append(cells[:: max(1, len(cells) // SAMPLES)])
    least = CELLS_AN_IMAGE * len(images)
    found = {side: np.concatenate(parts) for side, parts in tables.items()}
    return {side: table if len(table) >= least else table[:0] for side, table in found.items()}


def cell_means(images: Array, side: int) -> Array:
    """(n, k) means of k images in the square cells in which nearly all values are known."""
    rows, cols = (n // side * side for n in images.shape[1:])
    cut = np.where(np.isfinite(images).all(axis=0), images, np.nan)[:, :rows, :cols]
    blocks = cut.reshape(len(images), rows // side, side, cols // side, side).swapaxes(2, 3)
    blocks = blocks.reshape(len(images), -1, side * side)
    full = np.isfinite(blocks[0]).mean(axis=1) >= 0.85
    return np.asarray(np.nanmean(blocks[:, full], axis=2).T, np.float64)


def variances_of(tables: dict[int, Array]) -> Array:
    """Variance of the means of cells of each side; NaN where too few."""
    return np.array([rms(t[:, 1]) ** 2 if len(t) >= LEAST_CELLS else np.nan for t in tables.values()])


def shares(sides: Array, m: float) -> Array:
    """(n, 3) variance of a mean over a cell of unit white, correlated and systematic error of a pixel."""
    length = np.array(m)
    correlated = np.array([float(cell_share(float(b), length)) for b in sides]) / cell_share(1.0, length)
    return np.stack([1.0 / sides**2, correlated, np.ones_like(sides)], 1)


def parts_of(variances: Array) -> tuple[Array, float]:
    """(3,) variances white, correlated and systematic, and m, by least squares of relative misses."""
    known = np.isfinite(variances) & (variances > 0)
    best = (np.inf, np.zeros(3), 1.0)
    for m in CANDIDATES if known.any() else ():
        table = shares(SIDES[known], m) / variances[known][:, None]
        parts, miss = nnls(table, np.ones(len(table)))
        if miss < best[0] - 1e-9:
            best = (float(miss), np.asarray(parts, np.float64), float(m))
    return best[1], best[2]


def independent_pixels(parts: Array, m: float) -> float:
    """Pixels that make one measurement of white and correlated error together: b^2 V(b) of a large cell."""
    random = max(float(parts[0] + parts[1]), 1e-12)
    return max(float((parts[0] + parts[1] * m / cell_share(1.0, np.array(m))) / random), 1.0)
