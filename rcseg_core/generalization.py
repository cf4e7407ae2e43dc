"""Steps 5 and 7: a model grows in degree only when the statistics demand it (section 7, eq. 22-23).

Nested F test: with residuals S_0 of degree j and S_1 of degree k > j, F = (r - 1)(n - p_1)/q for r = S_0/S_1
(22) and q more parameters; the higher degree is taken when P(F(q, n - p_1) >= F) < alpha (23). At n = 10^4
that test alone generalises on a tenth of a sigma of quantisation, so the default also asks for an effect
worth having.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import f as f_distribution

from rcseg_core.config import GeneralizationConfig
from rcseg_core.jit import kernel
from rcseg_core.moments import Moments, residual, solve, tensor_exponents

#: A model needs this many pixels a coefficient, or it follows the noise.
PIXELS_PER_COEFFICIENT = 8


@kernel
def residual_table(moments, n_range, terms, out):  # type: ignore[no-untyped-def]
    """out[k, modality, degree - 1]: residual sum of squares of region k for each degree."""
    channels = moments.energy.shape[1]
    low = moments.cross.shape[2]
    gram = np.empty((low * low + 1, low * low))
    coef = np.empty((channels, low * low))
    for k in range(1, moments.energy.shape[0]):
        for degree in range(1, len(terms)):
            if degree >= low:
                continue
            t = terms[degree]
            for modality in range(2):
                first = 0 if modality == 0 else n_range
                last = n_range if modality == 0 else channels
                solve(moments.power[k], moments.cross[k], first, last, t, gram, coef)
                out[k, modality, degree - 1] = residual(
                    moments.power[k], moments.cross[k], moments.energy[k], first, last, t, coef
                )


def f_test(
    rss_low: NDArray[Any], rss_high: NDArray[Any], n: NDArray[Any], p_low: int, p_high: int, channels: int
) -> NDArray[np.float64]:
    """P of eq. (23) that noise alone lowers the residuals this much; 1 where there are too few pixels."""
    q = (p_high - p_low) * channels
    dof = (n - p_high) * channels
    with np.errstate(divide="ignore", invalid="ignore"):
        statistic = (rss_low / rss_high - 1.0) * dof / q  # eq. (22)
    statistic = np.where(rss_high > 0, statistic, np.where(rss_low > 0, np.inf, 0.0))
    p_value = f_distribution.sf(statistic, q, np.maximum(dof, 1))
    return np.where(dof > 0, p_value, 1.0)


def choose_degrees(
    moments: Moments, n_range: int, start: NDArray[np.int64], variance: NDArray[np.float64],
    correlation: tuple[float, float], config: GeneralizationConfig, highest: int = 4,
) -> NDArray[np.int64]:  # fmt: skip
    """The degree of range and of colour of each region.

    Parameters
    ----------
    moments : sums up to the degrees in question
    start : (N + 1, 2) int64, degrees that are not questioned (1 to begin with)
    variance : (N + 1, 2) float64, noise variance of one pixel in whitened units, for the effect
    correlation : pixels that make one independent measurement, of range and of colour
    highest : no degree above this is tried

    Returns
    -------
    (N + 1, 2) int64
    """
    channels = moments.energy.shape[1]
    terms = tuple(tensor_exponents(k) for k in range(5))
    table = np.zeros((moments.energy.shape[0], 2, 4))
    residual_table(moments, n_range, terms, table)
    degree: NDArray[np.int64] = start.copy()
    n = moments.count
    index = np.arange(n.size)
    tops = (min(config.max_range_degree, highest), min(config.max_color_degree, highest))
    widths = (n_range, channels - n_range)
    for modality, (width, top) in enumerate(zip(widths, tops, strict=True)):
        for high in range(2, min(top, moments.cross.shape[2] - 1) + 1):
            for low in range(1, high):
                rss_low, rss_high = table[:, modality, low - 1], table[:, modality, high - 1]
                independent = n / correlation[modality]
                p_low, p_high = (low + 1) ** 2, (high + 1) ** 2
                grow = f_test(rss_low, rss_high, independent, p_low, p_high, width) < config.alpha
                if config.test == "guarded":
                    effect = (rss_low - rss_high) / np.maximum(n, 1)
                    grow &= effect > config.min_effect**2 * width * variance[:, modality]
                grow &= n >= PIXELS_PER_COEFFICIENT * p_high
                grow &= degree[index, modality] == low
                degree[grow, modality] = high
    return degree
