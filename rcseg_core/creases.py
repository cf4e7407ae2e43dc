"""Regions that bend along a line: two surfaces which meet there, instead of one that is curved (section 7).

A quartic bends round the crease of a small far box to within the noise, above all where windows that
straddled the crease blur it. But two simple surfaces which meet along their own intersection line do better
with a fraction of the coefficients. So each bent region is asked which account is the shorter (Schwarz 1978,
counted in independent pixels): one curved surface, or two of first or second degree, divided where they are
equal. Under a pinhole two surfaces have the same inverse depth exactly on the image of their intersection.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_core.edges import ORIENTATION
from rcseg_core.generalization import residuals_by_degree
from rcseg_core.jit import bare, kernel
from rcseg_core.moments import UNIT_PX, Moments, tensor_exponents
from rcseg_core.partition import Partition
from rcseg_core.signals import INVALID, MISFIT, RANGE_OUTLIER, Signals, local_scales, scales

#: Pixels of a region that are looked at.
SAMPLES = 500
#: First divisions: straight lines in this many directions, at this many places each; rounds of improvement.
DIRECTIONS, PLACES, ROUNDS = 8, 16, 6
#: A face has at least this share of the region.
LEAST_SHARE = 0.04
#: Squared distance from a model that is held to be an outlier, in noise and half of the tolerance.
CUT2 = 9.0
#: Surfaces that meet at a smaller angle are left to one model; from the second on a crease may be within the
#: tolerance (the limb of a ball bends by some 30 degrees against its middle).
LEAST_ANGLE_RAD, SURE_ANGLE_RAD = np.deg2rad(25.0), np.deg2rad(45.0)
#: Least gain of a division, as a share of the squared tolerance.
EFFECT = 0.25
#: Coefficients of a plane and of a quadric: 1, x, y, then xx, xy, yy.
PLANE, QUADRIC = 3, 6
#: Kinds of the two sides that are tried.
KINDS = np.array([[PLANE, PLANE], [PLANE, QUADRIC], [QUADRIC, PLANE], [QUADRIC, QUADRIC]])


class Division(NamedTuple):
    """Two surfaces of a region.

    center : (2,) float64, x and y of the origin, px; scale : px that are 1 in the coordinates
    gap : (6,) float64, coefficients of (surface 0 - surface 1) in the last range channel
    side : +1 where surface 0 is seen where it is the larger, else -1
    """

    center: NDArray[np.float64]
    scale: float
    gap: NDArray[np.float64]
    side: float

    def on_second(self, rows: NDArray[np.int64], cols: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(n,) whether each pixel belongs to the second surface."""
        xy = np.stack([cols - self.center[0], rows - self.center[1]], axis=1) / self.scale
        return np.asarray(self.side * (bases(xy) @ self.gap) < 0.0)


def bases(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 6) values of 1, x, y, xx, xy, yy."""
    x, y = xy.T
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


@bare
def _add(gram, cross, basis, values, i):  # type: ignore[no-untyped-def]
    """Add sample i to the normal equations: gram (6, 6) lower, cross (C, 7), last the sum of squares."""
    for a in range(QUADRIC):
        for b in range(a + 1):
            gram[a, b] += basis[i, a] * basis[i, b]
    for c in range(values.shape[1]):
        v = values[i, c]
        for a in range(QUADRIC):
            cross[c, a] += basis[i, a] * v
        cross[c, QUADRIC] += v * v


@bare
def _solve(gram, cross, terms, work, coef):  # type: ignore[no-untyped-def]
    """Least squares with the first `terms` of the basis: coef (C, 6); returns the residual sum of squares."""
    n = gram[0, 0]
    if n < terms:
        return np.inf
    for a in range(terms):  # Cholesky; the ridge keeps pixels on a line from dividing by zero
        for b in range(a + 1):
            total = gram[a, b] + (1e-7 * n if a == b else 0.0)
            for k in range(b):
                total -= work[a, k] * work[b, k]
            work[a, b] = np.sqrt(max(total, 1e-12 * n)) if a == b else total / work[b, b]
    rss = 0.0
    for c in range(cross.shape[0]):
        rest = cross[c, QUADRIC]
        for a in range(terms):
            total = cross[c, a]
            for k in range(a):
                total -= work[a, k] * coef[c, k]
            coef[c, a] = total / work[a, a]
            rest -= coef[c, a] * coef[c, a]
        for a in range(terms - 1, -1, -1):
            total = coef[c, a]
            for k in range(a + 1, terms):
                total -= work[k, a] * coef[c, k]
            coef[c, a] = total / work[a, a]
        for a in range(terms, QUADRIC):
            coef[c, a] = 0.0
        rss += max(rest, 0.0)
    return rss


@bare
def _value(coef, basis, i):  # type: ignore[no-untyped-def]
    total = 0.0
    for a in range(QUADRIC):
        total += coef[a] * basis[i, a]
    return total


@bare
def _miss2(coef, basis, values, i):  # type: ignore[no-untyped-def]
    total = 0.0
    for c in range(values.shape[1]):
        d = values[i, c] - _value(coef[c], basis, i)
        total += d * d
    return total


class Normals(NamedTuple):
    """Normal equations of parts (see `_add`) and scratch: gram (n, 6, 6), cross (n, C, 7), work (6, 6)."""

    gram: NDArray[np.float64]
    cross: NDArray[np.float64]
    work: NDArray[np.float64]


@kernel
def _cut(basis, values, kinds, least, bins, both, trial, rss, found):  # type: ignore[no-untyped-def]
    """The best straight line for each pair of kinds: found (K, 4) residual, direction x, y and place."""
    count = basis.shape[0]
    found[:] = np.inf
    bins.gram[PLACES] = 0.0
    bins.cross[PLACES] = 0.0
    for i in range(count):  # the whole, in the last row
        _add(bins.gram[PLACES], bins.cross[PLACES], basis, values, i)
    for direction in range(DIRECTIONS):
        nx = np.cos(np.pi * direction / DIRECTIONS)
        ny = np.sin(np.pi * direction / DIRECTIONS)
        low = np.inf
        high = -np.inf
        for i in range(count):
            s = nx * basis[i, 1] + ny * basis[i, 2]
            low = min(low, s)
            high = max(high, s)
        step = (high - low) / PLACES + 1e-9
        bins.gram[:PLACES] = 0.0
        bins.cross[:PLACES] = 0.0
        both.gram[0] = 0.0
        both.cross[0] = 0.0
        both.gram[1] = bins.gram[PLACES]
        both.cross[1] = bins.cross[PLACES]
        for i in range(count):
            at = min(int((nx * basis[i, 1] + ny * basis[i, 2] - low) / step), PLACES - 1)
            _add(bins.gram[at], bins.cross[at], basis, values, i)
        for place in range(PLACES - 1):
            for s in range(2):
                sign = 1.0 - 2.0 * s
                for a in range(QUADRIC):
                    for b in range(a + 1):
                        both.gram[s, a, b] += sign * bins.gram[place, a, b]
                for c in range(values.shape[1]):
                    for a in range(QUADRIC + 1):
                        both.cross[s, c, a] += sign * bins.cross[place, c, a]
            if both.gram[0, 0, 0] < least or both.gram[1, 0, 0] < least:
                continue
            for s in range(2):
                rss[s, 0] = _solve(both.gram[s], both.cross[s], PLANE, both.work, trial[s])
                rss[s, 1] = _solve(both.gram[s], both.cross[s], QUADRIC, both.work, trial[s])
            for p in range(kinds.shape[0]):
                total = rss[0, kinds[p, 0] // QUADRIC] + rss[1, kinds[p, 1] // QUADRIC]
                if total < found[p, 0]:
                    found[p, 0] = total
                    found[p, 1] = nx
                    found[p, 2] = ny
                    found[p, 3] = low + (place + 1) * step


@bare
def _improve(basis, values, kind, least, cut2, half, both, trial, coef):  # type: ignore[no-untyped-def]
    """Fit both sides and divide anew where they are equal, until nothing is gained.

    half : (n,) side of each sample, changed in place; coef : (2, C, 6) out. Returns the mean capped square
    (inf if a side vanished) and on which side of the other surface 0 lies.
    """
    count = basis.shape[0]
    last = values.shape[1] - 1
    best = np.inf
    side = 0.0
    for turn in range(ROUNDS):
        both.gram[:] = 0.0
        both.cross[:] = 0.0
        for i in range(count):
            if turn == 0 or _miss2(trial[half[i]], basis, values, i) <= cut2:
                _add(both.gram[half[i]], both.cross[half[i]], basis, values, i)
        if both.gram[0, 0, 0] < least or both.gram[1, 0, 0] < least:
            break
        for s in range(2):
            _solve(both.gram[s], both.cross[s], kind[s], both.work, trial[s])
        if turn == 0:  # convex or concave: which of the two is above on its own side
            for i in range(count):
                above = _value(trial[0, last], basis, i) - _value(trial[1, last], basis, i)
                side += above if half[i] == 0 else -above
            side = 1.0 if side >= 0.0 else -1.0
        total = 0.0
        for i in range(count):
            above = _value(trial[0, last], basis, i) - _value(trial[1, last], basis, i)
            half[i] = 0 if side * above >= 0.0 else 1
            total += min(_miss2(trial[half[i]], basis, values, i), cut2)
        if total / count >= best:
            break
        best = total / count
        for s in range(2):
            for c in range(last + 1):
                for a in range(QUADRIC):
                    coef[s, c, a] = trial[s, c, a]
    return best, side


@kernel
def divide(basis, values, cut2, kinds, coefs, sides):  # type: ignore[no-untyped-def]
    """For each pair of kinds the two surfaces that explain samples best, divided where they are equal.

    basis : (n, 6) float64, see `bases`; values : (n, C) float64; cut2 : squared misses count for no more
    coefs : (K, 2, C, 6), sides : (K,) out. Returns (K,) mean capped squares, inf where nothing was found.
    """
    count, channels = values.shape
    work = np.empty((QUADRIC, QUADRIC))
    bins = Normals(
        np.empty((PLACES + 1, QUADRIC, QUADRIC)), np.empty((PLACES + 1, channels, QUADRIC + 1)), work
    )
    both = Normals(np.empty((2, QUADRIC, QUADRIC)), np.empty((2, channels, QUADRIC + 1)), work)
    trial = np.empty((2, channels, QUADRIC))
    found = np.empty((kinds.shape[0], 4))
    half = np.empty(count, np.int64)
    least = max(LEAST_SHARE * count, 8.0)
    _cut(basis, values, kinds, least, bins, both, trial, np.empty((2, 2)), found)
    out = np.full(kinds.shape[0], np.inf)
    for p in range(kinds.shape[0]):
        if found[p, 0] == np.inf:
            continue
        for i in range(count):
            half[i] = 0 if found[p, 1] * basis[i, 1] + found[p, 2] * basis[i, 2] < found[p, 3] else 1
        out[p], sides[p] = _improve(basis, values, kinds[p], least, cut2, half, both, trial, coefs[p])
    return out


def bent_miss2(xy: NDArray[np.float64], values: NDArray[np.float64], degree: int, cut2: float) -> float:
    """Mean capped square of samples about the best surface of a tensor degree, fitted without outliers."""
    powers = np.stack([xy**a for a in range(degree + 1)], axis=2)  # (n, 2, k + 1)
    design = np.stack([powers[:, 0, a] * powers[:, 1, b] for a, b in tensor_exponents(degree)], axis=1)
    keep = np.ones(len(xy), np.bool_)
    best = np.inf
    for _ in range(2):
        if keep.sum() < 2 * design.shape[1]:
            break
        used = design[keep]
        gram = used.T @ used + 1e-9 * keep.sum() * np.eye(design.shape[1])
        r2 = np.sum((values - design @ np.linalg.solve(gram, used.T @ values[keep])) ** 2, axis=1)
        best = min(best, float(np.minimum(r2, cut2).mean()))
        keep = r2 <= cut2
    return best


def meeting_angle(
    coef: NDArray[np.float64], xy: NDArray[np.float64], basis: NDArray[np.float64], flat: float
) -> float:
    """Mean angle, radians, between two surfaces at the tenth of the samples next to where they are equal.

    coef : (2, 6) of the last range channel; flat : slope of a surface tilted by 45 degrees in the same units
    """
    x, y = xy.T
    zero, one = np.zeros_like(x), np.ones_like(x)
    gx = np.stack([zero, one, zero, 2 * x, y, zero], axis=1) @ coef.T  # (n, 2)
    gy = np.stack([zero, zero, one, zero, x, 2 * y], axis=1) @ coef.T
    # distance to the division in the image, to first order
    slope = np.hypot(gx[:, 0] - gx[:, 1], gy[:, 0] - gy[:, 1])
    away = np.abs(basis @ (coef[0] - coef[1])) / np.maximum(slope, 1e-9)
    near = away <= np.quantile(away, 0.1)
    gx, gy = gx[near] / flat, gy[near] / flat
    steep = 1.0 + gx**2 + gy**2
    cosine = (1.0 + gx[:, 0] * gx[:, 1] + gy[:, 0] * gy[:, 1]) / np.sqrt(steep[:, 0] * steep[:, 1])
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)).mean())


def find_crease(rows: NDArray[np.int64], cols: NDArray[np.int64], signals: Signals) -> Division | None:
    """The division of a bent region along its crease, or None where one curved surface is the better account.

    rows, cols : (n,) the measured pixels of the region
    """
    n_range = signals.n_range
    step = max(1, -(-rows.size // SAMPLES))
    center = np.array([cols.mean(), rows.mean()])
    scale = 0.5 * max(float(np.ptp(cols)), float(np.ptp(rows)), 1.0)
    xy = np.stack([cols[::step] - center[0], rows[::step] - center[1]], axis=1) / scale
    basis = bases(xy)
    values = signals.image[rows[::step], cols[::step], :n_range].astype(np.float64)
    mean = values.mean(axis=0)
    values -= mean
    var, eps2 = local_scales(signals.law, mean[0])
    cut2 = CUT2 * (n_range * var + 0.25 * eps2)
    coefs, sides = np.empty((len(KINDS), 2, n_range, QUADRIC)), np.empty(len(KINDS))
    two = divide(basis, values, cut2, KINDS, coefs, sides)

    independent = min(rows.size / signals.noise.range_correlation, float(len(xy)))
    price = var * n_range * np.log(max(independent, np.e)) / independent
    cost = two + KINDS.sum(axis=1) * price
    k = int(np.argmin(cost))
    flat_miss2 = bent_miss2(xy, values, 1, cut2)
    # two planes that hardly differ from one are one
    if not cost[k] < np.inf or flat_miss2 - two[k] <= EFFECT * eps2:
        return None
    bent = np.array([bent_miss2(xy, values, degree, cut2) for degree in (2, 4)])
    curved = min(flat_miss2 + 4 * price, bent[0] + 9 * price, bent[1] + 25 * price)
    if two[k] >= bent[0] or curved <= cost[k]:
        return None
    flat = (signals.slope[0] + signals.slope[1] * mean[0]) * scale / UNIT_PX
    angle = meeting_angle(coefs[k, :, -1], xy, basis, flat)
    if angle < (LEAST_ANGLE_RAD if bent.min() - two[k] > EFFECT * eps2 else SURE_ANGLE_RAD):
        return None
    return Division(center, scale, coefs[k, 0, -1] - coefs[k, 1, -1], float(sides[k]))


def bent_regions(moments: Moments, signals: Signals, least: int) -> NDArray[np.int64]:
    """Regions of at least `least` pixels that a plane misses by more than the noise."""
    flat = residuals_by_degree(moments, signals.n_range, 1)[:, 0, 0]
    count = np.maximum(moments.count, 1.0)
    var, eps2 = scales(signals.law, moments.cross[:, 0, 0, 0] / count)
    bent = (moments.count >= least) & (flat / count > signals.n_range * var + EFFECT * eps2)
    bent[0] = False
    return np.nonzero(bent)[0]


def split_creases(partition: Partition, signals: Signals, edges: NDArray[np.uint8], least: int) -> int:
    """Divide the regions that bend along a crease; the smaller part becomes a region of its own.

    edges : (H, W) uint8, gets the creases that were found as orientation edges
    least : pixels of a region that is looked at, and of a part. Returns how many were divided.
    """
    boxes = partition.boxes()
    regions = bent_regions(partition.moments(signals, 1), signals, least)
    usable = signals.flags & (INVALID | RANGE_OUTLIER | MISFIT) == 0
    freed = np.zeros(partition.labels.shape, np.bool_)
    divided = 0
    for k in regions:
        window, own = _cutout(partition.labels, boxes[k], k)
        rows, cols = np.nonzero(own & usable[window])
        if rows.size < least:
            continue
        division = find_crease(rows + window[0].start, cols + window[1].start, signals)
        if division is None:
            continue
        rows, cols = np.nonzero(own)
        second = division.on_second(rows + window[0].start, cols + window[1].start)
        if 2 * second.sum() > second.size:
            second = ~second
        part = np.zeros(own.shape, np.uint8)
        part[rows[second], cols[second]] = 1
        near = np.ones((5, 5), np.uint8)
        met = (cv2.dilate(part, near) != 0) & (cv2.dilate(own.astype(np.uint8) - part, near) != 0)
        edges[window][own & met] |= ORIENTATION
        freed[window] |= part != 0
        divided += 1
    if divided:
        partition.separate(freed, signals.flags, least)
    return divided


def _cutout(
    labels: NDArray[np.int32], box: NDArray[np.int64], k: int
) -> tuple[tuple[slice, slice], NDArray[np.bool_]]:
    """The box of region k as slices, and its pixels in there."""
    row_min, col_min, row_max, col_max = (int(side) for side in box)
    window = slice(row_min, row_max + 1), slice(col_min, col_max + 1)
    return window, labels[window] == k
