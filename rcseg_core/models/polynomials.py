"""Models of regions as pixels see them: polynomials about the region's own centre, range and colour apart."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.inline import inlined
from rcseg_core.compute.jit import bare
from rcseg_core.compute.parallel import over_regions
from rcseg_core.models.moments import Moments, model_terms, solve
from rcseg_core.signal.signals import COLOR_OUTLIER, INVALID, RANGE_OUTLIER, local_scales
from rcseg_core.signal.units import UNIT_PX


class Models(NamedTuple):
    """Whitened polynomial models of regions 1..N.

    center : (N + 1, 2) float64, x, y of the origin, px
    degree : (N + 1, 2) int64, tensor degree of range and of colour; -1 where a region has no model
    coef : (N + 1, C, D + 1, D + 1) float64, coefficient of x^a y^b, x and y in UNIT_PX
    """

    center: NDArray[np.float64]
    degree: NDArray[np.int64]
    coef: NDArray[np.float64]


@bare
def _fit(moments, degree, n_range, terms, begin, end, gram, flat, coef):  # type: ignore[no-untyped-def]
    """Fit regions begin..end-1; terms[d] : (p, 2) int64, exponents of degree d; gram, flat : scratch."""
    for k in range(begin, end):
        if moments.power[k, 0, 0] < 1.0:
            continue
        for modality in range(2):
            first = 0 if modality == 0 else n_range
            last = n_range if modality == 0 else moments.energy.shape[1]
            if first == last:
                continue
            used = terms[degree[k, modality]]
            solve(moments.power[k], moments.cross[k], first, last, used, gram, flat)
            for c in range(first, last):
                for i in range(used.shape[0]):
                    coef[k, c, used[i, 0], used[i, 1]] = flat[c, i]


def fit_models(moments: Moments, degree: NDArray[np.int64], n_range: int, planes: bool = False) -> Models:
    """Least-squares models, eq. (13), of the given degrees.

    Parameters
    ----------
    degree : (N + 1, 2) int64, degree of range and of colour of each region
    planes : first-degree models have three terms (1, x, y) instead of four
    """
    count, channels = moments.energy.shape
    low = moments.cross.shape[2]
    coef = np.zeros((count, channels, low, low))
    terms = model_terms(planes)
    size = low * low

    def some(begin: int, end: int) -> None:
        _fit(
            moments, degree, n_range, terms, begin, end, np.empty((size + 1, size)),
            np.empty((channels, size)), coef,
        )  # fmt: skip

    over_regions(count, size, some)
    return Models(moments.center, degree, coef)


@inlined
def predict(models, k, row, col, modality, c):  # type: ignore[no-untyped-def]
    """Whitened value of channel c of region k at a pixel (Horner in y, then x); modality picks the degree."""
    degree = models.degree[k, modality]
    x = (col - models.center[k, 0]) / UNIT_PX
    y = (row - models.center[k, 1]) / UNIT_PX
    if degree == 1:  # the most frequent one
        m = models.coef
        return m[k, c, 0, 0] + m[k, c, 0, 1] * y + (m[k, c, 1, 0] + m[k, c, 1, 1] * y) * x
    total = 0.0
    for a in range(degree, -1, -1):
        part = 0.0
        for b in range(degree, -1, -1):
            part = part * y + models.coef[k, c, a, b]
        total = total * x + part
    return total


@bare
def along_row(models, k, row, n_range, line):  # type: ignore[no-untyped-def]
    """Region k along a row, added up as in `predict`: line[c, a] (C or Cr, D + 1), the factor of x^a."""
    y = (row - models.center[k, 1]) / UNIT_PX
    for c in range(line.shape[0]):
        degree = models.degree[k, 0 if c < n_range else 1]
        for a in range(degree + 1):
            part = 0.0
            for b in range(degree, -1, -1):
                part = part * y + models.coef[k, c, a, b]
            line[c, a] = part


@inlined
def pixel_cost(models, k, image, flags, row, col, n_range, law, color_eps2):  # type: ignore[no-untyped-def]
    """Squared residual of a pixel under region k, each modality over its noise plus half of the tolerance.

    A modality in which the pixel is missing or an impulse says nothing.
    """
    cost = 0.0
    if n_range > 0 and flags[row, col] & (INVALID | RANGE_OUTLIER) == 0:
        total = 0.0
        first = predict(models, k, row, col, 0, 0)
        var, eps2 = local_scales(law, first)
        d = image[row, col, 0] - first
        total += d * d
        for c in range(1, n_range):
            d = image[row, col, c] - predict(models, k, row, col, 0, c)
            total += d * d
        cost += total / (var + 0.25 * eps2 / n_range)
    channels = image.shape[2]
    if channels > n_range and flags[row, col] & COLOR_OUTLIER == 0:
        total = 0.0
        for c in range(n_range, channels):
            d = image[row, col, c] - predict(models, k, row, col, 1, c)
            total += d * d
        cost += total / (1.0 + 0.25 * color_eps2 / (channels - n_range))
    return cost
