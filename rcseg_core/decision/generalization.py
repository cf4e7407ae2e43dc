"""Steps 5 and 7: a model grows in degree only when the statistics demand it (section 7, eq. 22-23).

Nested F test: with residuals S_0 of degree j and S_1 of degree k > j, F = (r - 1)(n - p_1)/q for r = S_0/S_1
(22) and q more parameters; the higher degree is taken when P(F(q, n - p_1) >= F) < alpha (23). At n = 10^4
that test alone generalises on a tenth of a sigma of quantisation, so by default S_0 - S_1 must exceed what
the correlated and the systematic error explain (`rule.error_budget`).
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from rcseg_core.compute.jit import bare
from rcseg_core.compute.parallel import over_regions
from rcseg_core.config import GeneralizationConfig
from rcseg_core.decision.rule import error_budget
from rcseg_core.models.moments import PIVOT_TOLERANCE, Moments, tensor_exponents

#: A model needs this many pixels a coefficient, or it follows the noise.
PIXELS_PER_COEFFICIENT = 8
_budget = bare(error_budget)


@bare
def residual_table(moments, n_range, exponents, first, last, gram, work, out):  # type: ignore[no-untyped-def]
    """out[k, modality, degree - 1]: residual sum of squares of each degree for regions first..last-1 (14).

    exponents : (p, 2) terms of the highest degree, those of each lower one first (`nested_exponents`);
    gram : (p + 1, p), work : (p,) scratch. With R = L L^T in that order, z = L^-1 v gives the residual of all
    degrees at once: T T^T - z_0^2 - ... up to the last term of the degree.
    """
    channels = moments.energy.shape[1]
    p = exponents.shape[0]
    scale = gram[p]
    for k in range(first, last):
        power = moments.power[k]
        for i in range(p):
            d = power[2 * exponents[i, 0], 2 * exponents[i, 1]]
            scale[i] = 1.0 / np.sqrt(d) if d > 0.0 else 0.0
        for i in range(p):
            for j in range(i + 1):
                total = power[exponents[i, 0] + exponents[j, 0], exponents[i, 1] + exponents[j, 1]]
                total *= scale[i] * scale[j]
                for m in range(j):
                    total -= gram[i, m] * gram[j, m]
                if i == j:
                    gram[i, i] = np.sqrt(total) if total > PIVOT_TOLERANCE else 0.0
                else:
                    gram[i, j] = total / gram[j, j] if gram[j, j] > 0.0 else 0.0
        for c in range(channels):
            rss = moments.energy[k, c]
            for i in range(p):
                total = moments.cross[k, c, exponents[i, 0], exponents[i, 1]] * scale[i]
                for m in range(i):
                    total -= gram[i, m] * work[m]
                work[i] = total / gram[i, i] if gram[i, i] > 0.0 else 0.0
                rss -= work[i] * work[i]
                degree = max(exponents[i, 0], exponents[i, 1])
                if degree > 0 and i + 1 == (degree + 1) * (degree + 1):
                    out[k, 0 if c < n_range else 1, degree - 1] += max(rss, 0.0)


@bare
def _guarded(table, n, variance, modality, width, top, correlation, systematic2, degree):  # type: ignore[no-untyped-def]
    """Raise degree[k, modality] up to `top` while the gain exceeds what the error explains, in place."""
    for k in range(n.shape[0]):
        for high in range(2, top + 1):
            low = degree[k, modality]
            p_high = (high + 1) * (high + 1)
            if low < 1 or low >= high or n[k] < PIXELS_PER_COEFFICIENT * p_high:
                continue
            q = (p_high - (low + 1) * (low + 1)) * width
            error = _budget(correlation, systematic2, n[k], q)
            if table[k, modality, low - 1] - table[k, modality, high - 1] > error * variance[k, modality]:
                degree[k, modality] = high


@cache
def nested_exponents(degree: int) -> NDArray[np.int64]:
    """`tensor_exponents` with the terms of each lower degree first."""
    terms = tensor_exponents(degree)
    return terms[np.lexsort((terms[:, 1], terms[:, 0], terms.max(axis=1)))]


def residuals_by_degree(moments: Moments, n_range: int, highest: int) -> NDArray[np.float64]:
    """(N + 1, 2, highest) residual sums of squares of range and colour at degrees 1 to highest."""
    terms = nested_exponents(min(highest, moments.cross.shape[2] - 1))
    out = np.zeros((moments.energy.shape[0], 2, highest))

    def some(first: int, last: int) -> None:
        gram, work = np.empty((len(terms) + 1, len(terms))), np.empty(len(terms))
        residual_table(moments, n_range, terms, first, last, gram, work, out)

    over_regions(len(out), len(terms), some)
    return out


def f_test(
    rss_low: NDArray[Any], rss_high: NDArray[Any], n: NDArray[Any], p_low: int, p_high: int, channels: int
) -> NDArray[np.float64]:
    """P of eq. (23) that noise alone lowers the residuals this much; 1 where there are too few pixels."""
    q = (p_high - p_low) * channels
    dof = (n - p_high) * channels
    with np.errstate(divide="ignore", invalid="ignore"):
        statistic = (rss_low / rss_high - 1.0) * dof / q  # eq. (22)
    statistic = np.where(rss_high > 0, statistic, np.where(rss_low > 0, np.inf, 0.0))
    p_value = fdtrc(q, np.maximum(dof, 1), np.maximum(statistic, 0.0))
    return np.where(dof > 0, p_value, 1.0)


def choose_degrees(
    moments: Moments, n_range: int, start: NDArray[np.int64], variance: NDArray[np.float64],
    correlation: tuple[float, float], systematic2: tuple[float, float], config: GeneralizationConfig,
    highest: int = 4,
) -> NDArray[np.int64]:  # fmt: skip
    """The degree of range and of colour of each region.

    Parameters
    ----------
    moments : sums up to the degrees in question
    start : (N + 1, 2) int64, degrees that are not questioned (1 to begin with)
    variance : (N + 1, 2) float64, noise variance of one pixel in whitened units
    correlation : pixels that make one independent measurement, of range and of colour
    systematic2 : squared systematic part of the error, in sigma^2, of range and of colour
    highest : no degree above this is tried

    Returns
    -------
    (N + 1, 2) int64
    """
    channels = moments.energy.shape[1]
    reached = min(highest, moments.cross.shape[2] - 1)
    table = residuals_by_degree(moments, n_range, max(reached, 1))
    degree: NDArray[np.int64] = start.copy()
    n = moments.count
    tops = (min(config.max_range_degree, highest), min(config.max_color_degree, highest))
    widths = (n_range, channels - n_range)
    if config.test == "guarded":
        for modality, (width, top) in enumerate(zip(widths, tops, strict=True)):
            if width:
                known = correlation[modality], systematic2[modality]
                _guarded(table, n, variance, modality, width, min(top, reached), *known, degree)
        return degree
    for modality, (width, top) in enumerate(zip(widths, tops, strict=True)):
        if width == 0:
            continue
        for high in range(2, min(top, reached) + 1):
            for low in range(1, high):
                p_low, p_high = (low + 1) ** 2, (high + 1) ** 2
                asked = (degree[:, modality] == low) & (n >= PIXELS_PER_COEFFICIENT * p_high)
                rss_low, rss_high = table[:, modality, low - 1], table[:, modality, high - 1]
                k = np.nonzero(asked)[0]
                if not k.size:
                    continue
                independent = n[k] / correlation[modality]
                p_value = f_test(rss_low[k], rss_high[k], independent, p_low, p_high, width)
                degree[k[p_value < config.alpha], modality] = high
    return degree
