"""Models of regions as pixels see them: polynomials about the region's own centre, range and colour apart."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.inline import inlined
from rcseg_core.compute.jit import bare
from rcseg_core.compute.parallel import over_regions
from rcseg_core.models.moments import Moments, plane_exponents, solve, tensor_exponents
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
def _fit(moments, degree, first, last, modality, terms, models_degree, coef, gram, flat):  # type: ignore[no-untyped-def]
    """Fit channels first..last-1 of every region whose models_degree[k, modality] is `degree`."""
    for k in range(1, moments.energy.shape[0]):
        if models_degree[k, modality] != degree or moments.power[k, 0, 0] < 1.0:
            continue
        solve(moments.power[k], moments.cross[k], first, last, terms, gram, flat)
        for c in range(first, last):
            for i in range(terms.shape[0]):
                coef[k, c, terms[i, 0], terms[i, 1]] = flat[c, i]


def _fit_some(
    moments: Moments, degrees: NDArray[np.int64], degree: int, terms: NDArray[np.int64],
    span: tuple[int, int, int], coef: NDArray[np.float64], begin: int, end: int,
) -> None:  # fmt: skip
    """`_fit` of regions begin..end-1; span : first channel, last channel + 1, modality."""
    part = Moments(*(sums[begin - 1 : end] for sums in moments))  # the first row is passed over
    first, last, modality = span
    size = moments.cross.shape[2] ** 2
    gram, flat = np.empty((size + 1, size)), np.empty((coef.shape[1], size))
    degrees, coef = degrees[begin - 1 : end], coef[begin - 1 : end]
    _fit(part, degree, first, last, modality, terms, degrees, coef, gram, flat)


def fit_models(moments: Moments, degree: NDArray[np.int64], n_range: int, planes: bool = False) -> Models:
    """Least-squares models, eq. (13), of the given degrees.

    Parameters
    ----------
    degree : (N + 1, 2) int64, degree of range and of colour of each region
    planes : first-degree models have three terms (1, x, y) instead of four
    """
    channels, low = moments.energy.shape[1], moments.cross.shape[2]
    coef = np.zeros((moments.energy.shape[0], channels, low, low))
    for modality, (first, last) in enumerate(((0, n_range), (n_range, channels))):
        for k in sorted(set(degree[1:, modality].tolist())):
            terms = plane_exponents() if planes and k == 1 else tensor_exponents(k)
            span = first, last, modality
            over_regions(len(coef), len(terms), partial(_fit_some, moments, degree, k, terms, span, coef))
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
