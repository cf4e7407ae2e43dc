"""Step 2: the initial partition, windows of 11 to 3 pixels with a least-median-of-squares fit (section 5).

For each window size, largest first: every window without edge and without assigned pixel gets a first-order
model of range and colour; outliers of the fit are released for other regions. A window whose plain
least-squares residual is already pure noise needs no robust search (``fit = "auto"``); the others get 72
random planes, judged by the median of the joint Mahalanobis residual, whose scale in d dimensions is
med/chi2_{d,0.5} with the cut at chi2_{d,0.975}.
"""

from __future__ import annotations

from functools import cache, partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from rcseg_core.compute.jit import bare, kernel
from rcseg_core.compute.parallel import BANDS, together
from rcseg_core.config import SeedsConfig
from rcseg_core.partition.plain import plain_surfaces
from rcseg_core.signal.signals import Signals, local_scales

#: Windows beyond the largest of the paper, tried first and taken only where plain least squares leaves pure
#: noise: fewer seeds to group on wide plain surfaces.
WIDE_WINDOWS_PX = (31, 19)
#: Least height of a band of rows that is filled on its own.
BAND_PX = 100
#: A seed must keep this share of its usable pixels as inliers (LMS breaks down at half).
MIN_INLIERS = 0.5
#: Three pixels span a plane; two more tell whether it fits.
LEAST_PIXELS = 5
#: Draws for a subset of three pixels that span a plane; of pixels on two crossing lines one in three does.
MOST_DRAWS = 32
#: Steps after which the states of two windows have nothing in common.
MIXING_ROUNDS = 12
#: The residual variance of a window may exceed the noise by this factor, besides the tolerance.
NOISE_FACTOR = 1.4


@kernel
def _random(state):  # type: ignore[no-untyped-def]
    """xorshift64 (Marsaglia 2003): a frame gives the same seeds on every run and any number of threads."""
    state ^= state >> np.uint64(12)
    state ^= state << np.uint64(25)
    state ^= state >> np.uint64(27)
    return state


@kernel
def first_state(row, col, size):  # type: ignore[no-untyped-def]
    """State to draw from in a window; those of neighbours differ in a few bits until they are mixed."""
    state = np.uint64(88172645463325252) ^ np.uint64((row * 65536 + col) * 64 + size)
    for _ in range(MIXING_ROUNDS):
        state = _random(state)
    return state


@kernel
def fit_plane(samples, use, count, coef):  # type: ignore[no-untyped-def]
    """Least-squares planes through the used samples of a window.

    samples : (2 + C, m) float64, rows x, y, then the channels; use : (m,) bool; coef : (C, 3) float64 out,
    the value at the window centre and the slopes. Returns False where the samples do not span a plane.
    """
    channels = samples.shape[0] - 2
    s0 = sx = sy = sxx = sxy = syy = 0.0
    for i in range(count):
        if use[i]:
            x = samples[0, i]
            y = samples[1, i]
            s0 += 1.0
            sx += x
            sy += y
            sxx += x * x
            sxy += x * y
            syy += y * y
    if s0 < 3.0:
        return False
    mx = sx / s0
    my = sy / s0
    axx = sxx - sx * mx
    axy = sxy - sx * my
    ayy = syy - sy * my
    det = axx * ayy - axy * axy
    if det < 1e-9 * (axx + ayy) * (axx + ayy) or det <= 0.0:
        return False
    for c in range(channels):
        v0 = vx = vy = 0.0
        for i in range(count):
            if use[i]:
                v = samples[2 + c, i]
                v0 += v
                vx += (samples[0, i] - mx) * v
                vy += (samples[1, i] - my) * v
        gx = (ayy * vx - axy * vy) / det
        gy = (axx * vy - axy * vx) / det
        coef[c, 1] = gx
        coef[c, 2] = gy
        coef[c, 0] = v0 / s0 - gx * mx - gy * my
    return True


@kernel
def joint_residuals(samples, count, coef, n_range, weight_r, weight_c, out):  # type: ignore[no-untyped-def]
    """Squared Mahalanobis residual of each sample, range and colour together.

    Channel by channel over all samples: the processor does several of them at once.
    """
    channels = samples.shape[0] - 2
    for i in range(count):
        out[i] = 0.0
    alone = n_range if n_range > 0 else channels
    weight = weight_r if n_range > 0 else weight_c
    for c in range(alone):
        a = coef[c, 0]
        gx = coef[c, 1]
        gy = coef[c, 2]
        for i in range(count):
            d = samples[2 + c, i] - a - gx * samples[0, i] - gy * samples[1, i]
            out[i] += d * d
    for i in range(count):
        out[i] *= weight
    if alone == channels:
        return
    for i in range(count):
        total = 0.0
        for c in range(alone, channels):
            d = samples[2 + c, i] - coef[c, 0] - coef[c, 1] * samples[0, i] - coef[c, 2] * samples[1, i]
            total += d * d
        out[i] += total * weight_c


@kernel
def _minimal_plane(samples, a, b, c, coef):  # type: ignore[no-untyped-def]
    """The plane through three samples; False where they are nearly collinear."""
    ux = samples[0, b] - samples[0, a]
    uy = samples[1, b] - samples[1, a]
    vx = samples[0, c] - samples[0, a]
    vy = samples[1, c] - samples[1, a]
    det = ux * vy - uy * vx
    if abs(det) < 2.0:
        return False
    for k in range(samples.shape[0] - 2):
        du = samples[2 + k, b] - samples[2 + k, a]
        dv = samples[2 + k, c] - samples[2 + k, a]
        gx = (vy * du - uy * dv) / det
        gy = (ux * dv - vx * du) / det
        coef[k, 1] = gx
        coef[k, 2] = gy
        coef[k, 0] = samples[2 + k, a] - gx * samples[0, a] - gy * samples[1, a]
    return True


@kernel
def lms_inliers(samples, count, n_range, w_r, w_c, half, cut, subsets, state, coef, trial, res, use):  # type: ignore[no-untyped-def]
    """Least median of squares: mark the inliers of the best of `subsets` random minimal planes in `use`.

    half, cut : chi2_{d,0.5} and chi2_{d,0.975} for the joint dimension d. Returns the number of inliers.
    Three pixels on a line count for no subset, as long as MOST_DRAWS draws a subset are not used up.
    """
    best = np.inf
    middle = count // 2
    tried = 0
    for _ in range(MOST_DRAWS * subsets):
        if tried == subsets:
            break
        state = _random(state)
        a = np.int64(state % np.uint64(count))
        state = _random(state)
        b = np.int64(state % np.uint64(count))
        state = _random(state)
        c = np.int64(state % np.uint64(count))
        if not _minimal_plane(samples, a, b, c, trial):
            continue
        tried += 1
        joint_residuals(samples, count, trial, n_range, w_r, w_c, res)
        # only a median below the best so far is worth sorting for
        below = 0
        for i in range(count):
            if res[i] < best:
                below += 1
        if below <= middle:
            continue
        best = np.partition(res[:count], middle)[middle]
        coef[:, :] = trial
    if best == np.inf:
        return 0
    # the sensor's sigma is the floor: quantised depth can give a zero median
    scale2 = max(1.0, best / half)
    joint_residuals(samples, count, coef, n_range, w_r, w_c, res)
    inliers = 0
    for i in range(count):
        use[i] = res[i] <= cut * scale2
        inliers += use[i]
    return inliers


@kernel
def _fits(samples, use, count, coef, n_range, var, eps2_r, eps2_c):  # type: ignore[no-untyped-def]
    """Whether the residuals of the used samples are noise (within NOISE_FACTOR) plus tolerance."""
    channels = samples.shape[0] - 2
    n = 0
    rss_r = 0.0
    rss_c = 0.0
    for i in range(count):
        if not use[i]:
            continue
        n += 1
        for c in range(channels):
            d = samples[2 + c, i] - coef[c, 0] - coef[c, 1] * samples[0, i] - coef[c, 2] * samples[1, i]
            if c < n_range:
                rss_r += d * d
            else:
                rss_c += d * d
    dof = max(n - 3, 1)
    slack = NOISE_FACTOR + 4.0 / np.sqrt(dof)
    good_r = rss_r <= dof * n_range * slack * var + n * eps2_r
    good_c = rss_c <= dof * (channels - n_range) * slack + n * eps2_c
    return good_r and good_c


@kernel
def _try_window(  # type: ignore[no-untyped-def]
    image, flags, row0, col0, size, n_range, law, eps2_c, half, cut, search, robust, subsets, min_valid, work,
    labels, label,
):  # fmt: skip
    """Fit one free window; write its inliers as `label`. Returns the number of pixels, 0 if it is no seed."""
    samples, coef, trial, res, use = work
    channels = image.shape[2]
    center = size // 2
    count = 0
    for i in range(size):
        if count + (size - i) * size < min_valid * size * size:
            return 0
        for j in range(size):
            if flags[row0 + i, col0 + j] != 0:
                continue
            samples[0, count] = j - center
            samples[1, count] = i - center
            for c in range(channels):
                samples[2 + c, count] = image[row0 + i, col0 + j, c]
            use[count] = True
            count += 1
    if count < min_valid * size * size or count < LEAST_PIXELS:
        return 0
    if not fit_plane(samples, use, count, coef):
        return 0
    var, eps2_r = local_scales(law, coef[0, 0])
    # half of the tolerance, as for single pixels: a seed is held to more than a grown region
    noise_only = _fits(samples, use, count, coef, n_range, var, 0.25 * eps2_r, 0.25 * eps2_c)
    if not noise_only and not search:
        return 0
    if robust or not noise_only:
        w_r = 1.0 / (var + 0.25 * eps2_r / max(n_range, 1))  # colour alone has no range residual
        w_c = 1.0 / (1.0 + 0.25 * eps2_c / 3.0)
        inliers = lms_inliers(
            samples, count, n_range, w_r, w_c, half, cut, subsets, first_state(row0, col0, size), coef,
            trial, res, use,
        )  # fmt: skip
        if inliers < MIN_INLIERS * count or inliers < LEAST_PIXELS:
            return 0
        if not fit_plane(samples, use, count, coef):
            return 0
        var, eps2_r = local_scales(law, coef[0, 0])
        if not _fits(samples, use, count, coef, n_range, var, 0.25 * eps2_r, 0.25 * eps2_c):
            return 0
    index = 0
    taken = 0
    for i in range(size):
        for j in range(size):
            if flags[row0 + i, col0 + j] != 0:
                continue
            if use[index]:
                labels[row0 + i, col0 + j] = label
                taken += 1
            index += 1
    return taken


@bare
def _lengthen(run, edges, labels):  # type: ignore[no-untyped-def]
    """run[col] = rows without edge or seed that end in this one, several columns at once."""
    for col in range(run.shape[0]):
        run[col] = run[col] + 1 if (edges[col] == 0) & (labels[col] == 0) else 0


@kernel
def place_windows(  # type: ignore[no-untyped-def]
    image, flags, edges, first, last, n_range, law, eps2_c, sizes, max_window, half, cut, robust, subsets,
    min_valid, labels,
):  # fmt: skip
    """Fill rows first..last-1 of `labels` (H, W) int32 with seeds 1..N; returns N.

    Windows in raster order, sizes largest first. A window is free when each of its `size` columns ends a run
    of `size` rows without edge or seed.
    """
    width, channels = image.shape[1], image.shape[2]
    most = sizes[0] * sizes[0]
    work = (
        np.empty((2 + channels, most)),
        np.empty((channels, 3)),
        np.empty((channels, 3)),
        np.empty(most),
        np.empty(most, np.bool_),
    )
    count = 0
    run = np.empty(width, np.int32)
    for size in sizes:
        run[:] = 0
        for row in range(first, last):
            _lengthen(run, edges[row], labels[row])
            col0 = 0
            while col0 + size <= width:
                col = col0 + size - 1
                while col >= col0 and run[col] >= size:
                    col -= 1
                if col >= col0:  # no window reaches across it
                    col0 = col + 1
                    continue
                taken = _try_window(
                    image, flags, row - size + 1, col0, size, n_range, law, eps2_c, half, cut,
                    size <= max_window, robust and size <= max_window, subsets, min_valid, work, labels,
                    count + 1,
                )  # fmt: skip
                if taken > 0:
                    count += 1
                    run[col0 : col0 + size] = 0
                    col0 += size
                else:
                    # a window that failed tells of its neighbours: step by half a window, in rows as well
                    step = size - size // 2
                    run[col0 : col0 + step] = size // 2
                    col0 += step
    return count


@bare
def _renumber(labels, first, last, offset):  # type: ignore[no-untyped-def]
    for row in range(first, last):
        for col in range(labels.shape[1]):
            if labels[row, col] > 0:
                labels[row, col] += offset


@bare
def _add(labels, more, offset):  # type: ignore[no-untyped-def]
    """Write the labels of `more` over `labels`, numbered from offset + 1."""
    for row in range(labels.shape[0]):
        for col in range(labels.shape[1]):
            if more[row, col] > 0:
                labels[row, col] = more[row, col] + offset


@cache
def _chi2_cuts(dims: int) -> tuple[float, float]:
    """chi2_{d,0.5} and chi2_{d,0.975}; scipy.stats has them by name, and takes half a second to import."""
    return 2.0 * float(gammaincinv(dims / 2, 0.5)), 2.0 * float(gammaincinv(dims / 2, 0.975))


def _fence(edges: NDArray[np.uint8], within: NDArray[np.int32]) -> NDArray[np.uint8]:
    """`edges` plus the upper left side of every border of `within`, and all that lies outside it."""
    fence: NDArray[np.bool_] = (edges != 0) | (within <= 0)
    fence[:-1] |= within[:-1] != within[1:]
    fence[:, :-1] |= within[:, :-1] != within[:, 1:]
    return fence.astype(np.uint8)


def initial_partition(
    signals: Signals, edges: NDArray[np.uint8], config: SeedsConfig, within: NDArray[np.int32] | None = None
) -> tuple[NDArray[np.int32], int]:
    """The initial partition.

    Parameters
    ----------
    edges : (H, W) uint8, non-zero where no window may lie
    within : (H, W) int32, optional; windows keep to one positive value of it

    Returns
    -------
    labels : (H, W) int32, 0 unassigned, 1..count seeds
    count : int
    """
    labels = np.zeros(signals.flags.shape, np.int32)
    blocked = edges if within is None else _fence(edges, within)
    top = min(config.max_window, *(side - 1 + side % 2 for side in signals.flags.shape))
    sizes = np.arange(top, min(config.min_window, top) - 1, -2, dtype=np.int64)
    if config.fit == "auto":
        wide = [w for w in WIDE_WINDOWS_PX if top < w <= min(labels.shape)]
        sizes = np.concatenate([np.array(wide, np.int64), sizes])
    cuts = _chi2_cuts(signals.image.shape[2])
    # on known surfaces windows keep to bands of rows, which are filled side by side; the surfaces themselves
    # come out better without (docs/performance.md)
    height = len(labels)
    bands = max(1, min(BANDS, height // BAND_PX)) if within is not None and config.fit == "auto" else 1
    rows = [height * i // bands for i in range(bands + 1)]
    counts = [0] * bands
    plain, found = labels, 0
    if within is not None and config.fit == "auto":
        plain, found = plain_surfaces(signals, blocked, within, cuts[1], NOISE_FACTOR)
        blocked |= plain > 0

    def place(i: int) -> None:
        counts[i] = place_windows(
            signals.image, signals.flags, blocked, rows[i], rows[i + 1], signals.n_range, signals.law,
            signals.color_eps2, sizes, top, *cuts, config.fit == "lms", config.subsets, config.min_valid,
            labels,
        )  # fmt: skip

    together(*(partial(place, i) for i in range(bands)))
    for i in range(1, bands):
        _renumber(labels, rows[i], rows[i + 1], sum(counts[:i]))
    total = sum(counts)
    if found:
        _add(labels, plain, total)
    return labels, total + found
