"""How the residual of a smooth surface shrinks with area: the correlated and the systematic error.

White noise shrinks with the square root of the pixels. The error of a real sensor is correlated over a few
pixels (its matching window) and bent over many (lens, interpolation, smoothing in the camera), and the second
part no number of pixels averages away. So the means of square cells are looked at in windows of 6 x 6 cells,
at two sizes of cell: what they miss a quadratic by, which follows the surface itself, is

    V(b) = m g(b, m) / b^2 + kappa^2        in variances of one pixel

for cells of b pixels to a side, if m pixels make one independent measurement and kappa is the systematic
part.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from rcseg_core.compute.jit import bare, kernel
from rcseg_core.compute.parallel import LEAST_ROWS, over_bands
from rcseg_core.compute.small import quantile

Array = NDArray[np.float64]

#: Sides of the cells, px, and the share of the windows that are taken as smooth at each: of wide windows
#: fewer are free of things and steps.
CELLS_PX, SMOOTH_SHARES = (8, 16), (0.3, 0.15)
#: Cells to a side of a window, and the share of them that must lie on one surface.
WINDOW_CELLS, LEAST_INLIERS = 6, 0.7
#: Coefficients of a quadratic, rounds of reweighting, and the cut of Tukey's weight in deviations.
TERMS, ROUNDS, CUT = 6, 6, 4.0
#: A quantile below the middle tells less than the mean, as that of chi-squared with 30 degrees of freedom.
BIAS = (0.84, 0.72)
#: Windows of a size that are enough to tell.
LEAST_WINDOWS = 8
#: Share of the white part of the widest cells that a systematic part must exceed to be told from it.
DOUBT = 0.25
#: Candidates of m, pixels.
CANDIDATES = np.exp(np.linspace(0.0, np.log(400.0), 120))


class Spread(NamedTuple):
    """correlation : m, pixels that make one independent measurement, at least 1
    systematic : kappa, in sigmas of one pixel, what no number of pixels averages away
    shortfall : variance that small windows see, over the variance of one pixel (see `seen_share`)"""

    correlation: float
    systematic: float
    shortfall: float


@bare
def sum_cells(signal, valid, channel, side, first, last, mean):  # type: ignore[no-untyped-def]
    """Mean signal of square cells, rows of cells first..last-1; NaN under three fifths."""
    for i in range(first, last):
        for j in range(mean.shape[1]):
            n = 0
            total = 0.0
            for row in range(i * side, (i + 1) * side):
                for col in range(j * side, (j + 1) * side):
                    if valid[row, col]:
                        n += 1
                        total += signal[row, col, channel]
            mean[i, j] = total / n if n >= 0.6 * side * side else np.nan


@bare
def _solve(gram, right):  # type: ignore[no-untyped-def]
    """Cholesky in place of gram (lower) and right; singular directions get zero."""
    for a in range(TERMS):
        for b in range(a + 1):
            total = gram[a, b]
            for c in range(b):
                total -= gram[a, c] * gram[b, c]
            if a == b:
                gram[a, a] = np.sqrt(total) if total > 1e-9 else 0.0
            else:
                gram[a, b] = total / gram[b, b] if gram[b, b] > 0.0 else 0.0
    for a in range(TERMS):
        total = right[a]
        for c in range(a):
            total -= gram[a, c] * right[c]
        right[a] = total / gram[a, a] if gram[a, a] > 0.0 else 0.0
    for a in range(TERMS - 1, -1, -1):
        total = right[a]
        for c in range(a + 1, TERMS):
            total -= gram[c, a] * right[c]
        right[a] = total / gram[a, a] if gram[a, a] > 0.0 else 0.0


@kernel
def window_variances(mean, out):  # type: ignore[no-untyped-def]
    """What the cells of each window miss their quadratic by, outliers left out.

    mean : (h, w) float64, NaN where there is none; out : (n, 2) float64, mean signal and variance of each
    window, NaN where less than `LEAST_INLIERS` of the cells lie on one surface
    """
    side = WINDOW_CELLS
    basis = np.empty((side * side, TERMS))
    for i in range(side):
        for j in range(side):
            y = (2.0 * i - side + 1.0) / side
            x = (2.0 * j - side + 1.0) / side
            at = i * side + j
            basis[at, 0] = 1.0
            basis[at, 1] = x
            basis[at, 2] = y
            basis[at, 3] = x * x
            basis[at, 4] = x * y
            basis[at, 5] = y * y
    value = np.empty(side * side)
    miss = np.empty(side * side)
    away = np.empty(side * side)
    weight = np.empty(side * side)
    gram = np.empty((TERMS, TERMS))
    right = np.empty(TERMS)
    index = -1
    for row in range(0, mean.shape[0] - side + 1, side // 2):
        for col in range(0, mean.shape[1] - side + 1, side // 2):
            index += 1
            out[index, :] = np.nan
            known = 0
            middle = 0.0
            for at in range(side * side):
                v = mean[row + at // side, col + at % side]
                value[at] = v
                weight[at] = 1.0 if v == v else 0.0
                if v == v:
                    known += 1
                    middle += v
            if known < LEAST_INLIERS * side * side:
                continue
            middle /= known
            inliers = 0
            rss = 0.0
            for _ in range(ROUNDS):
                gram[:] = 0.0
                right[:] = 0.0
                for at in range(side * side):
                    if weight[at] > 0.0:
                        for a in range(TERMS):
                            part = weight[at] * basis[at, a]
                            right[a] += part * (value[at] - middle)
                            for b in range(a + 1):
                                gram[a, b] += part * basis[at, b]
                _solve(gram, right)
                known = 0
                for at in range(side * side):
                    if value[at] == value[at]:
                        total = value[at] - middle
                        for a in range(TERMS):
                            total -= right[a] * basis[at, a]
                        miss[at] = total
                        away[known] = abs(total)
                        known += 1
                scale = CUT * 1.4826 * np.median(away[:known]) + 1e-300
                inliers = 0
                rss = 0.0
                for at in range(side * side):
                    if value[at] == value[at]:
                        u = miss[at] / scale
                        weight[at] = (1.0 - u * u) * (1.0 - u * u) if abs(u) < 1.0 else 0.0
                        if weight[at] > 0.0:
                            inliers += 1
                            rss += miss[at] * miss[at]
            if inliers >= LEAST_INLIERS * side * side:
                out[index, 0] = middle
                out[index, 1] = rss / (inliers - TERMS)


def cell_share(side: float, correlation: Array) -> Array:
    """Variance of the mean over a square of `side` px of unit noise with Gaussian correlation of m pixels.

    The correlation over a distance d is exp(-pi d^2 / m), whose integral over the plane is m.
    """
    reach = np.sqrt(correlation / np.pi)
    line = reach * np.sqrt(np.pi) / side * erf(side / reach)
    line -= (reach / side) ** 2 * (1.0 - np.exp(-((side / reach) ** 2)))
    return np.asarray(line**2)


def seen_share(correlation: Array, area: float) -> Array:
    """Share of the noise's variance that the quieter half of windows of `area` px shows.

    The plane of a window follows three independent measurements of its area / m, and a quantile below the
    middle of the rest, which varies by sqrt(2 m / area), is low by a quarter of that.
    """
    one = correlation / area
    return np.asarray(np.maximum((1.0 - 3.0 * one) * (1.0 - 0.25 * np.sqrt(2.0 * one)), 0.25))


def _all_windows(mean: Array, rows: int, cols: int, large: bool) -> Array:
    """(rows cols, 2) `window_variances` by bands of windows; large : whether threads are worth waking."""
    table, step = np.empty((rows * cols, 2)), WINDOW_CELLS // 2

    def some(_: int, first: int, last: int) -> None:
        if last > first:
            cells = mean[step * first : step * (last - 1) + WINDOW_CELLS]
            window_variances(cells, table[cols * first : cols * last])

    over_bands(rows, some, least=1 if large else rows + 1)
    return table


def measure_spread(
    signal: NDArray[np.float32], valid: NDArray[np.bool_], sigma: Callable[[Array], Array], area: float,
    least: float,
) -> Spread:  # fmt: skip
    """The correlated and the systematic part of the error of the last range channel.

    Parameters
    ----------
    signal : (H, W, Cr) float32
    valid : (H, W) bool
    sigma : the standard deviation of one pixel at signal values, as windows of `area` px show it
    least : pixels of correlation that are known already, from the pixels of small windows
    """
    sizes, found = [], []
    for side, share, bias in zip(CELLS_PX, SMOOTH_SHARES, BIAS, strict=True):
        shape = signal.shape[0] // side, signal.shape[1] // side
        rows, cols = (max(0, (n - WINDOW_CELLS) // (WINDOW_CELLS // 2) + 1) for n in shape)
        if rows * cols < LEAST_WINDOWS:
            continue
        mean = np.empty(shape)

        def sum_rows(_: int, first: int, last: int, side: int = side, mean: Array = mean) -> None:
            sum_cells(signal, valid, signal.shape[2] - 1, side, first, last, mean)

        over_bands(shape[0], sum_rows)
        table = _all_windows(mean, rows, cols, len(signal) >= LEAST_ROWS)
        table = table[np.isfinite(table[:, 1])]
        if len(table) < LEAST_WINDOWS:
            continue
        ratio = table[:, 1] / sigma(table[:, 0]) ** 2
        sizes.append(float(side))
        found.append(quantile(ratio, share) / bias)
    if len(found) < len(CELLS_PX):
        return Spread(least, 0.0, float(seen_share(np.array(least), area)))
    return _explain(np.array(sizes), np.maximum(np.array(found), 1e-9), area, least)


def _explain(sizes: Array, found: Array, area: float, least: float) -> Spread:
    """m and kappa of V(b), by least squares of relative misses; m is at least `least`."""
    m = np.maximum(CANDIDATES, max(least, 1.0))
    share = seen_share(m, area)
    white = np.stack([cell_share(b, m) for b in sizes])  # (sizes, candidates)
    seen = found[:, None] * share
    weight = 1.0 / seen**2
    kappa2 = np.maximum(np.sum(weight * (seen - white), axis=0) / weight.sum(axis=0), 0.0)
    cost = np.sum(weight * (white + kappa2 - seen) ** 2, axis=0)
    best = int(np.argmin(cost))
    sure = max(float(kappa2[best] - DOUBT * white[-1, best]), 0.0)
    return Spread(float(m[best]), float(np.sqrt(sure)), float(share[best]))
