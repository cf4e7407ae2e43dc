"""Additive sufficient statistics of a region: all that eq. (12)-(14) need, without its pixels.

A region keeps the power sums ``sum x^a y^b`` (a, b <= 2k: the Gram matrix R of every model up to degree k),
the cross sums ``sum x^a y^b s`` (a, b <= k: V) and the energies ``sum s^2`` (T T^T), about a centre of its
own: normal equations in image coordinates are unusable (condition 1e17). x and y are pixels / UNIT_PX. Sums
add only about one centre; `shift_grid` moves them there binomially.
"""

from __future__ import annotations

from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.inline import inlined
from rcseg_core.compute.jit import bare
from rcseg_core.compute.parallel import BANDS, over_bands
from rcseg_core.signal.units import UNIT_PX

#: Pivots of the equilibrated Gram matrix below this are linear dependence (too few or collinear pixels).
PIVOT_TOLERANCE = 1e-9


class Moments(NamedTuple):
    """Sums of N regions. Index 0 of the first axis is the background and stays zero.

    center : (N, 2) float64, x then y of the local origin, px (col, row)
    power : (N, 2k+1, 2k+1) float64; cross : (N, C, k+1, k+1) float64; energy : (N, C) float64
    """

    center: NDArray[np.float64]
    power: NDArray[np.float64]
    cross: NDArray[np.float64]
    energy: NDArray[np.float64]

    @property
    def count(self) -> NDArray[np.float64]:  # type: ignore[override]  # no one counts values of a tuple here
        """(N,) number of pixels."""
        return self.power[:, 0, 0]


@cache
def plane_exponents() -> NDArray[np.int64]:
    """Exponents (a, b) of a three-parameter plane: 1, x, y."""
    return np.array([[0, 0], [1, 0], [0, 1]], np.int64)


@cache
def tensor_exponents(degree: int) -> NDArray[np.int64]:
    """Exponents (a, b) of the tensor-product polynomial of eq. (8): all a, b <= degree, a varying slowest."""
    return np.array([[a, b] for a in range(degree + 1) for b in range(degree + 1)], np.int64)


@cache
def model_terms(planes: bool) -> tuple[NDArray[np.int64], ...]:
    """Exponents of models by degree, 0 to 4; planes : those of first degree have three terms, not four."""
    first = plane_exponents() if planes else tensor_exponents(1)
    return (tensor_exponents(0), first, tensor_exponents(2), tensor_exponents(3), tensor_exponents(4))


@bare
def _boxes(labels, first, last, box):  # type: ignore[no-untyped-def]
    """Widen box (N + 1, 4) by the runs of rows first..last-1."""
    width = labels.shape[1]
    for row in range(first, last):
        col = 0
        while col < width:
            k = labels[row, col]
            start = col
            col += 1
            while col < width and labels[row, col] == k:
                col += 1
            if k > 0:
                box[k, 0] = min(box[k, 0], row)
                box[k, 1] = min(box[k, 1], start)
                box[k, 2] = max(box[k, 2], row)
                box[k, 3] = max(box[k, 3], col - 1)


def region_boxes(labels: NDArray[np.int32], count: int) -> NDArray[np.int64]:
    """(count + 1, 4) int64 boxes row_min, col_min, row_max, col_max (inclusive) of labels 1..count."""
    boxes = np.empty((BANDS, count + 1, 4), np.int64)
    boxes[:] = (*labels.shape, -1, -1)
    over_bands(labels.shape[0], lambda i, first, last: _boxes(labels, first, last, boxes[i]))
    return np.concatenate([boxes[..., :2].min(axis=0), boxes[..., 2:].max(axis=0)], axis=1)


@lru_cache(maxsize=4)
def power_table(width: int) -> NDArray[np.float64]:
    """(4 W + 5, 9) sums of powers of x: a run of pixels in a row is the difference of two rows of it.

    Row d + 2 W + 2 holds, for each a, the sum of (e / (2 UNIT_PX))^a over all e of the parity of d from 0 (or
    1) to below d; its negative where d < 0. Counted outwards from the centre of a region no digits are lost.
    """
    reach = 2 * width + 2
    steps = np.arange(-reach, reach + 1)
    powers = (steps[:, None] / (2.0 * UNIT_PX)) ** np.arange(9)
    table = np.zeros_like(powers)
    for first in (0, 1):
        at = reach + first
        table[at + 2 :: 2] = np.cumsum(powers[at:-2:2], axis=0)
        table[at - 2 :: -2] = -np.cumsum(powers[at - 2 :: -2], axis=0)
    table.setflags(write=False)
    return table


@inlined
def _sum_channel(image, flags, row, start, stop, c, center, run):  # type: ignore[no-untyped-def]
    """Sums of x^a s over the unflagged pixels of a run into run (9,), and of s^2 into run[5]."""
    r0 = r1 = r2 = r3 = r4 = energy = 0.0
    for col in range(start, stop):
        x = (col - center) / UNIT_PX
        v = np.float64(image[row, col, c]) * (flags[row, col] == 0)
        energy += v * v
        r0 += v
        v *= x
        r1 += v
        v *= x
        r2 += v
        v *= x
        r3 += v
        v *= x
        r4 += v
    run[0] = r0
    run[1] = r1
    run[2] = r2
    run[3] = r3
    run[4] = r4
    run[5] = energy


@inlined
def _sum_three(image, flags, row, start, stop, c, center, runs):  # type: ignore[no-untyped-def]
    """The same for channels c, c + 1, c + 2 at once, up to x^2, into runs (3, 9)."""
    a0 = a1 = a2 = b0 = b1 = b2 = c0 = c1 = c2 = ea = eb = ec = 0.0
    for col in range(start, stop):
        weight = np.float64(flags[row, col] == 0)
        x = (col - center) / UNIT_PX
        u = np.float64(image[row, col, c]) * weight
        v = np.float64(image[row, col, c + 1]) * weight
        w = np.float64(image[row, col, c + 2]) * weight
        ea += u * u
        eb += v * v
        ec += w * w
        a0 += u
        b0 += v
        c0 += w
        u *= x
        v *= x
        w *= x
        a1 += u
        b1 += v
        c1 += w
        a2 += u * x
        b2 += v * x
        c2 += w * x
    runs[0, 5] = ea
    runs[1, 5] = eb
    runs[2, 5] = ec
    runs[0, 0] = a0
    runs[0, 1] = a1
    runs[0, 2] = a2
    runs[1, 0] = b0
    runs[1, 1] = b1
    runs[1, 2] = b2
    runs[2, 0] = c0
    runs[2, 1] = c1
    runs[2, 2] = c2


@inlined
def _add_run(image, flags, row, start, stop, k, sign, center, table, power, cross, energy, run):  # type: ignore[no-untyped-def]
    """Add (sign 1) or take away (-1) a run: summed in x, then spread over powers of y.

    table : `power_table`; run : (3, 9) float64 scratch
    """
    channels = image.shape[2]
    top = power.shape[1]
    low = cross.shape[2]
    middle = table.shape[0] // 2
    origin = center[k, 0]
    low_end = middle + np.int64(2 * (start - origin))
    high_end = middle + np.int64(2 * (stop - origin))
    for a in range(top):
        run[0, a] = table[high_end, a] - table[low_end, a]
    used = stop - start
    for j in range(start, stop):
        if flags[row, j] != 0:
            used -= 1
            x = (j - origin) / UNIT_PX
            xa = 1.0
            for a in range(top):
                run[0, a] -= xa
                xa *= x
    if used == 0:
        return
    y = (row - center[k, 1]) / UNIT_PX
    for a in range(top):
        value = sign * run[0, a]
        for b in range(top):
            power[k, a, b] += value
            value *= y
    c = 0
    while c < channels:
        count = 3 if low <= 3 and c + 3 <= channels else 1
        if count == 3:
            _sum_three(image, flags, row, start, stop, c, origin, run)
        else:
            _sum_channel(image, flags, row, start, stop, c, origin, run[0])
        for i in range(count):
            energy[k, c + i] += sign * run[i, 5]
            for a in range(low):
                value = sign * run[i, a]
                for b in range(low):
                    cross[k, c + i, a, b] += value
                    value *= y
        c += count


@bare
def _sum_runs(image, flags, labels, first, last, center, table, power, cross, energy, run):  # type: ignore[no-untyped-def]
    """One pass over rows first..last-1, a run of one label at a time."""
    width = image.shape[1]
    for row in range(first, last):
        col = 0
        while col < width:
            k = labels[row, col]
            start = col
            col += 1
            while col < width and labels[row, col] == k:
                col += 1
            if k > 0:
                _add_run(
                    image, flags, row, start, col, k, 1.0, center, table, power, cross, energy, run
                )  # fmt: skip


@bare
def _sum_moves(image, flags, before, after, center, table, power, cross, energy, run):  # type: ignore[no-untyped-def]
    """The same for pixels whose label changed: away from the old one, to the new one. flags : none is set."""
    height, width = before.shape
    for row in range(height):
        differ = 0
        for col in range(width):
            differ |= before[row, col] ^ after[row, col]
        if differ == 0:
            continue
        col = 0
        while col < width:
            old = before[row, col]
            new = after[row, col]
            start = col
            col += 1
            if old == new:
                continue
            while col < width and before[row, col] == old and after[row, col] == new:
                col += 1
            if old > 0:
                _add_run(
                    image, flags, row, start, col, old, -1.0, center, table, power, cross, energy, run
                )  # fmt: skip
            if new > 0:
                _add_run(
                    image, flags, row, start, col, new, 1.0, center, table, power, cross, energy, run
                )  # fmt: skip


def _centers(boxes: NDArray[np.int64]) -> NDArray[np.float64]:
    out = np.empty((len(boxes), 2))
    out[:, 0] = (boxes[:, 1] + boxes[:, 3]) / 2.0
    out[:, 1] = (boxes[:, 0] + boxes[:, 2]) / 2.0
    return out


def extended(moments: Moments, boxes: NDArray[np.int64]) -> Moments:
    """`moments` with empty rows for the regions behind its last; boxes : (N + 1, 4) int64 of all regions."""
    old = len(moments.energy)
    extra = len(boxes) - old
    return Moments(
        np.concatenate([moments.center, _centers(boxes[old:])]),
        *(np.concatenate([a, np.zeros((extra, *a.shape[1:]))]) for a in moments[1:]),
    )


def move_pixels(
    moments: Moments, image: NDArray[np.float32], before: NDArray[np.int32], after: NDArray[np.int32]
) -> None:
    """Bring moments up to date, in place, after pixels changed their regions: only those pixels are read.

    Parameters
    ----------
    before, after : (H, W) int32, labels of the pixels that the moments hold and shall hold, see `counted`
    """
    table, none = power_table(after.shape[1]), np.zeros(after.shape, np.uint8)
    _sum_moves(image, none, before, after, moments.center, table, *moments[1:], np.empty((3, 9)))


@bare
def _count(labels, flags, out):  # type: ignore[no-untyped-def]
    for row in range(labels.shape[0]):
        for col in range(labels.shape[1]):
            out[row, col] = labels[row, col] if flags[row, col] == 0 else 0


def counted(labels: NDArray[np.int32], flags: NDArray[np.uint8]) -> NDArray[np.int32]:
    """(H, W) int32 the region that each pixel counts for: none where it is flagged."""
    out = np.empty_like(labels)
    over_bands(len(out), lambda _, a, b: _count(labels[a:b], flags[a:b], out[a:b]))
    return out


def accumulate(
    image: NDArray[np.float32], flags: NDArray[np.uint8], labels: NDArray[np.int32], count: int, degree: int,
    boxes: NDArray[np.int64] | None = None,
) -> Moments:  # fmt: skip
    """Moments of regions 1..count for models up to `degree`; flagged pixels count for nothing.

    Parameters
    ----------
    image : (H, W, C) float32; flags : (H, W) uint8, non-zero leaves a pixel out; labels : (H, W) int32
    degree : 1 to 4
    boxes : (count + 1, 4) int64, `region_boxes` where they are known
    """
    channels = image.shape[2]
    box = region_boxes(labels, count) if boxes is None else boxes
    center = _centers(box)
    top = 2 * degree + 1
    power = np.zeros((BANDS, count + 1, top, top))
    cross = np.zeros((BANDS, count + 1, channels, degree + 1, degree + 1))
    energy = np.zeros((BANDS, count + 1, channels))
    run = np.empty((BANDS, 3, 9))
    table = power_table(labels.shape[1])

    def sum_band(i: int, first: int, last: int) -> None:
        _sum_runs(
            image, flags, labels, first, last, center, table, power[i], cross[i], energy[i], run[i]
        )  # fmt: skip

    over_bands(labels.shape[0], sum_band)
    return Moments(center, power.sum(axis=0), cross.sum(axis=0), energy.sum(axis=0))


@bare
def shift_grid(grid, dx, dy, out, work):  # type: ignore[no-untyped-def]
    """Sums of x^a y^b (weighted or not) about an origin moved by (-dx, -dy): sum (x+dx)^a (y+dy)^b.

    Binomial theorem by repeated addition (x+dx)^a = (x+dx)^(a-1) x + (x+dx)^(a-1) dx, separably.
    work : like grid.
    """
    size = grid.shape[0]
    for b in range(size):
        for a in range(size):
            work[a, b] = grid[a, b]
        # after step s, work[a] holds sum x^(a-s') (x+dx)^s'; the highest power is finished first
        for s in range(size - 1):
            for a in range(size - 1, s, -1):
                work[a, b] += dx * work[a - 1, b]
    for a in range(size):
        for b in range(size):
            out[a, b] = work[a, b]
        for s in range(size - 1):
            for b in range(size - 1, s, -1):
                out[a, b] += dy * out[a, b - 1]


@bare
def solve(power, cross, first, last, exponents, gram, coef):  # type: ignore[no-untyped-def]
    """Least-squares coefficients of channels first..last-1: A = V R^-1, eq. (13), by equilibrated Cholesky.

    power : (2k+1, 2k+1); cross : (C, k+1, k+1); exponents : (p, 2); gram : (>= p + 1, >= p) work;
    coef : (C, >= p) out. Dependent terms get the coefficient 0. Returns the rank.
    """
    p = exponents.shape[0]
    scale = gram[p]
    for i in range(p):
        d = power[2 * exponents[i, 0], 2 * exponents[i, 1]]
        scale[i] = 1.0 / np.sqrt(d) if d > 0.0 else 0.0
    rank = 0
    for i in range(p):
        for j in range(i + 1):
            total = power[exponents[i, 0] + exponents[j, 0], exponents[i, 1] + exponents[j, 1]]
            total *= scale[i] * scale[j]
            for m in range(j):
                total -= gram[i, m] * gram[j, m]
            if i == j:
                if total > PIVOT_TOLERANCE:
                    gram[i, i] = np.sqrt(total)
                    rank += 1
                else:
                    gram[i, i] = 0.0
            else:
                gram[i, j] = total / gram[j, j] if gram[j, j] > 0.0 else 0.0
    for c in range(first, last):
        for i in range(p):
            if gram[i, i] == 0.0:
                coef[c, i] = 0.0
                continue
            total = cross[c, exponents[i, 0], exponents[i, 1]] * scale[i]
            for m in range(i):
                total -= gram[i, m] * coef[c, m]
            coef[c, i] = total / gram[i, i]
        for i in range(p - 1, -1, -1):
            if gram[i, i] == 0.0:
                continue
            total = coef[c, i]
            for m in range(i + 1, p):
                total -= gram[m, i] * coef[c, m]
            coef[c, i] = total / gram[i, i]
        for i in range(p):
            coef[c, i] *= scale[i]
    return rank


@bare
def residual(power, cross, energy, first, last, exponents, coef):  # type: ignore[no-untyped-def]
    """Sum of squared residuals of any model over a region, eq. (14): tr(T T^T - 2 A V^T + A R A^T), >= 0."""
    p = exponents.shape[0]
    total = 0.0
    for c in range(first, last):
        rss = energy[c]
        for i in range(p):
            ai = exponents[i, 0]
            bi = exponents[i, 1]
            row = -2.0 * cross[c, ai, bi]
            for j in range(p):
                row += coef[c, j] * power[ai + exponents[j, 0], bi + exponents[j, 1]]
            rss += coef[c, i] * row
        total += max(rss, 0.0)
    return total


@bare
def mean_square_gradient(power, terms, coef):  # type: ignore[no-untyped-def]
    """Mean over a region of |grad s|^2 per UNIT_PX^2 for one channel with coefficients coef (p,)."""
    p = terms.shape[0]
    total = 0.0
    for i in range(p):
        ai = terms[i, 0]
        bi = terms[i, 1]
        for j in range(p):
            a = ai + terms[j, 0]
            b = bi + terms[j, 1]
            part = 0.0
            if ai > 0 and terms[j, 0] > 0:
                part += ai * terms[j, 0] * power[a - 2, b]
            if bi > 0 and terms[j, 1] > 0:
                part += bi * terms[j, 1] * power[a, b - 2]
            total += coef[i] * coef[j] * part
    return max(total, 0.0) / max(power[0, 0], 1.0)
