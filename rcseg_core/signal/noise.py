"""The noise Sigma_r and Sigma_c that eq. (3) whitens with: measured on the frame, or a sensor's model.

Window residuals about a robust plane tell the noise wherever a scene is smooth; their lower quantile ignores
windows on edges and texture. Second differences would be zero on quantised depth. Structured-light depth and
demosaiced colour are correlated over a few pixels, so n of them are worth fewer: the means of 5x5 blocks of
the residuals tell how many pixels make one independent measurement.

The standard deviation of the range signal is a quadratic of the signal itself,
``sigma(w) = a + b w + c w^2``, which holds every usual sensor: structured light and stereo (a), constant
depth noise (c, since dw = w^2 dz) and Kinect after Nguyen et al. (all three).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from rcseg_core.compute.jit import bare
from rcseg_core.compute.parallel import LEAST_ROWS, over_bands
from rcseg_core.compute.small import lower_quantile, quantile
from rcseg_core.compute.small import median as median_of
from rcseg_core.config import NoiseConfig
from rcseg_core.signal.spread import Spread, measure_spread, seen_share

WINDOW_PX = 21
#: Windows to a side of the image that are enough for its quantiles; small images overlap them.
WINDOWS_A_SIDE = 16
COLOR_WINDOWS_A_SIDE = 10
BLOCK_PX = 5
#: Mean square of block means over variance / BLOCK_PX^2 on white noise: the plane takes a little of it.
WHITE_BLOCKS = 0.84
MAX_CORRELATION_PX = 25.0
#: Share of windows whose residual is taken as pure noise: smooth windows are assumed to be at least half.
QUANTILE = 0.3
#: Rounds of fitting the law, and how far above it the windows of a part may lie before they count for less.
ROUNDS, CLUTTER = 6, 1.2
#: Windows that tell the noise of a part of the signals, least and enough; change of the signal within one.
LEAST_PART, ENOUGH_PART, MOST_CHANGE = 4, 40, 1.25
#: Parts that the signals of a frame are cut into, each of which tells its noise with this many windows.
PRIOR_PARTS, PRIOR_WINDOWS = 5, 8
#: Relative floor: no range sensor repeats better than this, and exact synthetic data must not divide by zero.
RELATIVE_FLOOR = 2e-5
COLOR_FLOOR_LEVELS = 1.5

#: How well a frame tells the variance of its own noise, relative.
KNOWN_VARIANCE = 0.03

#: sigma of inverse depth, 1/m, as (a, b, c); sources in docs/notation.md.
SENSOR_MODELS = {
    "kinect_v1": (0.0019, -0.00152, 0.001504),  # 0.0012 + 0.0019 (z - 0.4)^2, Nguyen, Izadi & Lovell 2012
    "realsense_d435": (0.1 / (0.05 * 640.0), 0.0, 0.0),  # z^2 s/(f b), s = 0.1 px, b = 50 mm, f = 640 px
}


@dataclass(frozen=True)
class NoiseModel:
    """Standard deviations that whiten the signals.

    Attributes
    ----------
    range_law : (Cr, 3) float64
        ``sigma_c(s) = a + b s + c s^2`` for range channel c and signal value s: 1/m of inverse depth, or
        metres of x, y, z (constant then: b = c = 0).
    color : (3,) float64, levels.
    range_correlation, color_correlation : pixels that make one independent measurement, 1 for white noise
    range_systematic : float
        Systematic part of the range error, in `range_sigma`: what no number of pixels averages away.
    source : str
        "estimated" (and with which prior) or the name of the model.
    """

    range_law: NDArray[np.float64]
    color: NDArray[np.float64]
    range_correlation: float
    color_correlation: float
    source: str
    range_systematic: float = 0.0

    @property
    def range_doubt2(self) -> float:
        """Squared misfit a pixel, in variances, that is no evidence however many pixels show it.

        The systematic part, and what the variance of the noise itself may be off by.
        """
        return self.range_systematic**2 + KNOWN_VARIANCE

    @property
    def systematic_law(self) -> NDArray[np.float64]:
        """(Cr, 3) float64, the law of the systematic part, as `range_law`."""
        return self.range_law * self.range_systematic

    def range_sigma(self, signal: NDArray[np.floating]) -> NDArray[np.float64]:
        """Standard deviation of the first range channel at signal values (any shape), in their units."""
        a, b, c = self.range_law[0]
        return np.asarray(a + b * signal + c * signal * signal, np.float64)


@bare
def window_residuals(values, median, valid, channel, spread, stride, first, last, out):  # type: ignore[no-untyped-def]
    """Residuals about a plane in windows of one channel, impulses (> 6 spread from the median) left out.

    values, median : (H, W, C) float32 or uint8; valid : (H, W) bool, or (1, 1) where all are;
    spread : (n,) float64, scale of values - median in each window; first, last : rows of windows, `stride`
    apart; out : (n, 4) float64, mean, rms, the mean square of 5x5 block means times 25, and the mean size of
    the steps between pixels that differ, beside the slope (the quantum of a quantised sensor); NaN where
    under half of a window is usable.
    """
    height, width = values.shape[0], values.shape[1]
    masked = valid.shape[0] == height
    half = WINDOW_PX // 2
    per_side = WINDOW_PX // BLOCK_PX
    index = first * ((width - WINDOW_PX) // stride + 1)
    for row0 in range(first * stride, last * stride, stride):
        for col0 in range(0, width - WINDOW_PX + 1, stride):
            s0 = sx = sy = sxx = sxy = syy = v0 = vx = vy = vv = 0.0
            ref = np.float64(median[row0 + half, col0 + half, channel])
            far = 6.0 * spread[index]
            for i in range(WINDOW_PX):
                for j in range(WINDOW_PX):
                    r = row0 + i
                    c = col0 + j
                    if masked and not valid[r, c]:
                        continue
                    value = np.float64(values[r, c, channel])
                    if abs(value - median[r, c, channel]) > far:
                        continue
                    x = j - half
                    y = i - half
                    v = value - ref
                    s0 += 1.0
                    sx += x
                    sy += y
                    sxx += x * x
                    sxy += x * y
                    syy += y * y
                    v0 += v
                    vx += x * v
                    vy += y * v
                    vv += v * v
            out[index, :] = np.nan
            index += 1
            if s0 < WINDOW_PX * WINDOW_PX // 2:
                continue
            # centred 2x2 normal equations of the plane
            axx = sxx - sx * sx / s0
            axy = sxy - sx * sy / s0
            ayy = syy - sy * sy / s0
            bx = vx - sx * v0 / s0
            by = vy - sy * v0 / s0
            det = axx * ayy - axy * axy
            if det <= 1e-9:
                continue
            gx = (ayy * bx - axy * by) / det
            gy = (axx * by - axy * bx) / det
            g0 = ref + (v0 - gx * sx - gy * sy) / s0
            rss = vv - v0 * v0 / s0 - gx * bx - gy * by
            out[index - 1, 0] = ref + v0 / s0
            out[index - 1, 1] = np.sqrt(max(rss, 0.0) / (s0 - 3.0))
            blocks = 0.0
            square = 0.0
            steps = 0.0
            quantum = 0.0
            for block in range(per_side * per_side):
                n = 0.0
                total = 0.0
                for i in range(BLOCK_PX):
                    for j in range(BLOCK_PX):
                        y = (block // per_side) * BLOCK_PX + i
                        x = (block % per_side) * BLOCK_PX + j
                        r = row0 + y
                        c = col0 + x
                        if masked and not valid[r, c]:
                            continue
                        value = np.float64(values[r, c, channel])
                        if abs(value - median[r, c, channel]) > far:
                            continue
                        n += 1.0
                        total += value - g0 - gx * (x - half) - gy * (y - half)
                        step = np.float64(values[r, c + 1, channel]) - value
                        if step == 0.0 or (masked and not valid[r, c + 1]):
                            continue
                        if abs(step - gx) <= 8.0 * out[index - 1, 1]:
                            steps += 1.0
                            quantum += abs(step - gx)
                if n >= 12.0:
                    blocks += 1.0
                    square += total * total / n
            if blocks > 0.0:
                out[index - 1, 2] = square / blocks
            if steps > 0.0:
                out[index - 1, 3] = quantum / steps


class _Windows(NamedTuple):
    """Usable windows of one channel: mean and residual rms of each; the correlation of the quieter half."""

    mean: NDArray[np.float64]
    rms: NDArray[np.float64]
    correlation: float


@bare
def _count_steps(values, median, channel, stride, tally):  # type: ignore[no-untyped-def]
    """tally[d] += pixels, every `stride`-th, whose level is d from the median; levels are bytes."""
    for row in range(0, values.shape[0], stride):
        for col in range(0, values.shape[1], stride):
            tally[abs(np.int64(values[row, col, channel]) - np.int64(median[row, col, channel]))] += 1


def _quantile_of_levels(tally: NDArray[np.int64], share: float) -> float:
    """``numpy.quantile`` of whole numbers from 0 that occur tally[k] times; 0 of none."""
    below = np.cumsum(tally)
    if below[-1] == 0:
        return 0.0
    place = share * float(below[-1] - 1)
    low, high = np.searchsorted(below, [np.floor(place), np.ceil(place)], side="right").tolist()
    return float(low + (high - low) * (place - np.floor(place)))


@bare
def _near(signal, median, valid, law, floor, first, last, near):  # type: ignore[no-untyped-def]
    """near = whether a pixel is valid and within six sigmas of its median, in the last channel."""
    a, b, c = law[0], law[1], law[2]
    channel = signal.shape[2] - 1
    for row in range(first, last):
        for col in range(valid.shape[1]):
            v = np.float64(median[row, col, channel])
            sigma = max(a + b * v + c * v * v, floor)
            away = abs(signal[row, col, channel] - median[row, col, channel])
            near[row, col] = valid[row, col] and away <= 6.0 * sigma


def _measure(
    values: NDArray[Any], median: NDArray[Any], valid: NDArray[np.bool_] | None, channel: int,
    windows_a_side: int = WINDOWS_A_SIDE,
) -> _Windows:  # fmt: skip
    """Residuals of all windows of one channel; valid = None: every pixel counts."""
    height, width = values.shape[:2]
    stride = max(8, min(height, width) // windows_a_side)
    rows = max(0, (height - WINDOW_PX) // stride + 1)
    count = rows * max(0, (width - WINDOW_PX) // stride + 1)
    table = np.full((count, 4), np.nan)
    # on a quantised sensor most pixels equal the median; then the quantum is what they may be away
    if valid is None:
        tally = np.zeros(256, np.int64)
        _count_steps(values, median, channel, 3, tally)
        least = max(_quantile_of_levels(np.concatenate([[0], tally[1:]]), 0.3), 1e-9)
        spread = np.full(count, max(_quantile_of_levels(tally, 0.7), least))
    else:
        away = np.abs(values[::3, ::3, channel] - median[::3, ::3, channel])[valid[::3, ::3]]
        moved = away[away > 0]
        least = max(float(np.quantile(moved, 0.3)) if moved.size else 0.0, 1e-9)
        spread = np.maximum(_local_spread(values, median, valid, channel, stride), least)
    if count:
        mask = np.ones((1, 1), np.bool_) if valid is None else valid

        def measure_rows(_: int, first: int, last: int) -> None:
            window_residuals(values, median, mask, channel, spread, stride, first, last, table)

        over_bands(rows, measure_rows, least=1 if height >= LEAST_ROWS else rows + 1)
    table = table[np.isfinite(table[:, :2]).all(axis=1)]
    quiet = table[table[:, 1] <= median_of(table[:, 1])] if len(table) else table
    quiet = quiet[np.isfinite(quiet[:, 2]) & (quiet[:, 1] > 0)]
    correlation = 1.0
    if len(quiet) >= 4:
        correlation = median_of(quiet[:, 2] / quiet[:, 1] ** 2) / WHITE_BLOCKS
    # rounding alone makes a deviation of quantum / sqrt(12); a window on one step shows none of it
    stepped = np.isfinite(table[:, 3])
    if stepped.sum() > 0.3 * len(table):
        table = table[stepped]
    rms = np.fmax(table[:, 1], table[:, 3] / np.sqrt(12.0))
    return _Windows(table[:, 0], rms, float(np.clip(correlation, 1.0, MAX_CORRELATION_PX)))


def _local_spread(
    values: NDArray[Any], median: NDArray[Any], valid: NDArray[np.bool_], channel: int, stride: int
) -> NDArray[np.float64]:
    """(n,) scale of values - median in each window, whose noise may be many times that of the frame.

    70 % of the distances are noise even when 20 % of the pixels are impulses; 1.04 sigma at 70 %.
    """
    steps = np.arange(0, WINDOW_PX, 3)
    starts = [np.arange(0, n - WINDOW_PX + 1, stride) for n in valid.shape]
    rows = (starts[0][:, None] + steps)[:, None, :, None]
    cols = (starts[1][:, None] + steps)[None, :, None, :]
    away = np.abs(values[rows, cols, channel].astype(np.float64) - median[rows, cols, channel])
    away = np.sort(np.where(valid[rows, cols], away, np.inf).reshape(-1, steps.size**2), axis=1)
    known = np.isfinite(away).sum(axis=1)
    quantile = away[np.arange(len(away)), (0.7 * np.maximum(known - 1, 0)).astype(np.int64)]
    return np.where(known > 0, quantile, 0.0)


def _parts(mean: NDArray[np.float64]) -> list[NDArray[np.int64]]:
    """Windows of like signal, in order: no part holds many of them, nor two depths.

    Without the second, the few windows of a near board would be lost among those of the wall behind it. What
    lies between, the windows on its edge, is rough and far above any law.
    """
    order = np.argsort(mean, kind="stable")
    enough = max(ENOUGH_PART, -(-mean.size // 8))
    parts, first = [], 0
    for at in range(1, mean.size + 1):
        full = at - first >= enough
        if at == mean.size or full or mean[order[at]] > MOST_CHANGE * mean[order[first]]:
            parts.append(order[first:at])
            first = at
    return [part for part in parts if part.size >= LEAST_PART] or [order]


def _quiet_rms(rms: NDArray[np.float64]) -> float:
    return quantile(rms, QUANTILE) if rms.size else 0.0


def _range_law(mean: NDArray[np.float64], rms: NDArray[np.float64], floor: float) -> NDArray[np.float64]:
    """Non-negative (a, b, c) through the lower quantile of the residuals in bins of the signal."""
    if mean.size < 8:
        return np.array([max(floor, median_of(rms) if rms.size else floor), 0.0, 0.0])
    parts = _parts(mean)
    s = np.array([median_of(mean[part]) for part in parts])
    y = np.array([max(lower_quantile(rms[part], QUANTILE), floor) for part in parts])
    if s[-1] <= MOST_CHANGE * s[0]:
        return np.array([median_of(y), 0.0, 0.0])
    powers = np.stack([np.ones_like(s), s, s * s], 1)
    law, trust = np.zeros(3), np.ones_like(y)
    for _ in range(ROUNDS):
        weight = np.sqrt(trust) / y
        law, _ = nnls(powers * weight[:, None], y * weight)
        # parts far above the law are all clutter: they tell the less, the farther they are
        trust = np.minimum(1.0, np.maximum(powers @ law, floor) * CLUTTER / y) ** 4
    return np.asarray(law, np.float64)


def _with_prior(windows: _Windows, low: float, high: float, prior: str, floor: float) -> NDArray[np.float64]:
    """(3,) law of inverse depth from the windows of a frame and, where they are few, the law of its sensor.

    The signals of the frame, `low` to `high`, are cut into PRIOR_PARTS. A part with less than PRIOR_WINDOWS
    windows, as at a depth that only clutter has, gets what it lacks from the sensor, whose law is scaled
    first as the windows that there are say, less so where they are few. Fitted is
    ``sigma = t prior(s) + a + b s + c s^2``, none negative: the prior itself without any window, and what
    was measured where there are enough.
    """
    law = np.array(SENSOR_MODELS[prior])
    edges = np.linspace(low, max(high, low * (1.0 + 1e-6)), PRIOR_PARTS + 1)
    lacking = np.maximum(PRIOR_WINDOWS - np.histogram(windows.mean, edges)[0], 0.0)
    order = np.argsort(windows.mean, kind="stable")
    parts = [p for p in np.array_split(order, int(np.clip(order.size // 20, 1, 8))) if p.size]
    s = np.array([float(np.median(windows.mean[p])) for p in parts] + list(0.5 * (edges[1:] + edges[:-1])))
    powers = np.stack([np.ones_like(s), s, s * s], 1)
    expected = np.maximum(powers @ law, floor)
    measured = np.array([max(float(np.quantile(windows.rms[p], QUANTILE)), floor) for p in parts])
    if parts:
        trust = order.size / (order.size + PRIOR_WINDOWS)
        expected *= np.exp(trust * float(np.median(np.log(measured / expected[: len(parts)]))))
    y = np.concatenate([measured, expected[len(parts) :]])
    weight = np.sqrt(np.concatenate([[float(p.size) for p in parts], lacking])) / y
    table = np.concatenate([(powers @ law)[:, None], powers], axis=1)
    factors, _ = nnls(table * weight[:, None], y * weight)
    return np.asarray(factors[0] * law + factors[1:], np.float64)


def typical_values(signal: NDArray[np.float32], valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(Cr,) medians of the valid pixels, of every sixteenth where that leaves enough."""
    coarse = valid[::4, ::4]
    if np.count_nonzero(coarse) < 1000:
        return np.asarray(np.median(signal[valid], axis=0), np.float64)
    return np.asarray(np.median(signal[::4, ::4][coarse], axis=0), np.float64)


def _stated_law(config: NoiseConfig) -> tuple[float, float, float]:
    """(a, b, c) of a sensor, or as the configuration states them."""
    if config.range_model == "law":
        return config.range_law_a, config.range_law_b, config.range_law_c
    return SENSOR_MODELS[config.range_model]


def _with_stated(found: Spread, config: NoiseConfig) -> Spread:
    """What was found, where the configuration states nothing else."""
    if config.range_correlation > 0:
        m = max(config.range_correlation, 1.0)
        found = Spread(m, found.systematic, float(seen_share(np.array(m), WINDOW_PX**2)))
    if config.range_systematic >= 0:
        found = found._replace(systematic=config.range_systematic)
    return found


def estimate_noise(
    signal: NDArray[np.float32],
    median: NDArray[np.float32],
    valid: NDArray[np.bool_],
    color: NDArray[np.uint8],
    color_median: NDArray[np.uint8],
    inverse_depth: bool,
    config: NoiseConfig,
    typical: NDArray[np.float64] | None = None,
) -> NoiseModel:
    """The noise of one frame.

    Parameters
    ----------
    signal, median : (H, W, Cr) float32, range signal and its 5x5 median
    valid : (H, W) bool
    color, color_median : (H, W, 3) uint8
    inverse_depth : bool, Cr = 1 and the signal is 1/z in 1/m; else x, y, z in metres
    typical : (Cr,), `typical_values` where they are known

    Returns
    -------
    NoiseModel
    """
    typical = typical_values(signal, valid) if typical is None else typical
    scale = float(np.abs(typical[-1]))
    floor = RELATIVE_FLOOR * scale
    windows = [_measure(signal, median, valid, c) for c in range(signal.shape[2])]
    source: str = config.range_model
    if config.range_model == "auto":
        source = "estimated"
        if inverse_depth:
            law = _range_law(windows[0].mean, windows[0].rms, floor)[None]
            if config.range_prior != "none":
                low, high = np.quantile(signal[valid], [0.02, 0.98])
                law = _with_prior(windows[0], float(low), float(high), config.range_prior, floor)[None]
                source += f" with prior {config.range_prior}"
        else:
            sigmas = [_quiet_rms(w.rms) for w in windows]
            # a channel cannot be trusted far beyond the noisiest: x and y follow from the same measurement
            least = max(0.3 * max(sigmas), floor)
            law = np.array([[max(s, least), 0.0, 0.0] for s in sigmas])
    elif config.range_model == "constant":
        row = (0.0, 0.0, config.range_sigma) if inverse_depth else (config.range_sigma, 0.0, 0.0)
        law = np.array([row] * signal.shape[2])
    elif inverse_depth:
        law = np.array([_stated_law(config)])
    else:
        a, b, c = _stated_law(config)
        sigma_m = (a + b / scale + c / scale**2) * scale**2  # at the median depth: dz = z^2 dw
        law = np.array([(sigma_m, 0.0, 0.0)] * 3)

    def sigma(values: NDArray[np.float64]) -> NDArray[np.float64]:
        a, b, c = (float(term) for term in law[-1])  # single precision stays single
        return np.asarray(np.maximum(a + b * values + c * values * values, floor))

    spread = Spread(1.0, 0.0, 1.0)
    if config.range_correlation == 0 or config.range_systematic < 0:
        # impulses are no noise: a fifth of them would make the mean of any cell
        near = np.empty(valid.shape, np.bool_)
        over_bands(
            len(near), lambda _, first, last: _near(signal, median, valid, law[-1], floor, first, last, near)
        )
        spread = measure_spread(signal, near, sigma, WINDOW_PX**2, windows[-1].correlation)
    spread = _with_stated(spread, config)
    if config.range_model == "auto" and windows[-1].mean.size:
        law = law / np.sqrt(spread.shortfall)
    colors = [_measure(color, color_median, None, c, COLOR_WINDOWS_A_SIDE) for c in range(3)]
    sigma_c = np.maximum([_quiet_rms(w.rms) for w in colors], COLOR_FLOOR_LEVELS)
    if config.color_sigma > 0:
        sigma_c = np.full(3, config.color_sigma)
    return NoiseModel(
        law,
        sigma_c,
        range_correlation=spread.correlation,
        color_correlation=float(np.median([w.correlation for w in colors])),
        source=source,
        range_systematic=spread.systematic,
    )
