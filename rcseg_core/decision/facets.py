"""The shortest description of the cells of a region: planes and quadrics, or one curved surface (section 7).

Planes that were fitted round each cell are the hypotheses. The one that shortens the description most is
taken, again and again, so that three faces of a corner are found at once; then cells change sides and planes
are fitted until nothing changes, planes that do not pay for themselves are dropped, and those that must bend
become quadrics. Lengths are sums of squares in variances of one independent measurement, with log(n) for a
coefficient (Schwarz 1978).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.inline import inlined
from rcseg_core.compute.jit import bare, kernel
from rcseg_core.models.second_order import second_order
from rcseg_core.models.triangular import solve_triangular

#: Coefficients of a plane and of a quadric: 1, x, y, then xx, xy, yy; of a tensor quartic.
PLANE, QUADRIC, QUARTIC = 3, 6, 25
#: Surfaces that one region is parted into at most.
MOST = 6
#: Length of a border between two cells of different surfaces while cells change sides: without it noise that
#: is correlated falls into two parallel planes.
BORDER = 2.0
#: Rounds in which cells change sides, for what was found and for changes of it that are tried.
ROUNDS, TRIAL_ROUNDS = 8, 3
#: Cells round which planes are fitted as hypotheses, about.
HYPOTHESES = 48
#: Cells that a hypothesis needs.
LEAST_CELLS = 6


class Cells(NamedTuple):
    """Cells of a region, in raster order.

    place : (n, 2) float64, mean x and y, about the region's middle and over its half extent
    value : (n,) float64, mean of the whitened signal, about the region's mean
    weight : (n,) float64, pixels
    beside : (n, 4) int64, cells to the left, right, above and below; -1 for none
    """

    place: NDArray[np.float64]
    value: NDArray[np.float64]
    weight: NDArray[np.float64]
    beside: NDArray[np.int64]


@kernel
def gather(labels, image, flags, unusable, k, box, side, channel):  # type: ignore[no-untyped-def]
    """Fields of `Cells` of region k; number (h, w) of cells or -1; middle x, y and value; half extent."""
    row0, col0 = box[0], box[1]
    height = (box[2] - row0) // side + 1
    width = (box[3] - col0) // side + 1
    sums = np.zeros((height * width, 4))
    for row in range(row0, box[2] + 1):
        for col in range(col0, box[3] + 1):
            if labels[row, col] == k and not flags[row, col] & unusable:
                at = ((row - row0) // side) * width + (col - col0) // side
                sums[at, 0] += 1.0
                sums[at, 1] += col
                sums[at, 2] += row
                sums[at, 3] += image[row, col, channel]
    number = np.full((height, width), -1, np.int64)
    least = 0.3 * side * side
    count = 0
    for at in range(height * width):
        if sums[at, 0] >= least:
            number[at // width, at % width] = count
            count += 1
    place = np.empty((count, 2))
    value = np.empty(count)
    weight = np.empty(count)
    beside = np.full((count, 4), -1, np.int64)
    total = np.zeros(4)
    for i in range(height):
        for j in range(width):
            at = number[i, j]
            if at < 0:
                continue
            part = sums[i * width + j]
            for c in range(4):
                total[c] += part[c]
            weight[at] = part[0]
            place[at, 0] = part[1] / part[0]
            place[at, 1] = part[2] / part[0]
            value[at] = part[3] / part[0]
            if j > 0:
                beside[at, 0] = number[i, j - 1]
            if j + 1 < width:
                beside[at, 1] = number[i, j + 1]
            if i > 0:
                beside[at, 2] = number[i - 1, j]
            if i + 1 < height:
                beside[at, 3] = number[i + 1, j]
    scale = 0.5 * max(max(box[3] - col0, box[2] - row0), 1)
    middle = total[1:] / max(total[0], 1.0)
    for at in range(count):
        place[at, 0] = (place[at, 0] - middle[0]) / scale
        place[at, 1] = (place[at, 1] - middle[1]) / scale
        value[at] -= middle[2]
    return place, value, weight, beside, number, middle, scale


@inlined
def _basis(x, y, terms, out):  # type: ignore[no-untyped-def]
    """1, x, y, xx, xy, yy; or all x^a y^b with a, b <= 4 for a quartic, <= 2 for nine terms."""
    if terms <= QUADRIC:
        out[0], out[1], out[2] = 1.0, x, y
        out[3], out[4], out[5] = x * x, x * y, y * y
        return
    top = 4 if terms == QUARTIC else 2
    at = 0
    power = 1.0
    for _ in range(top + 1):
        part = power
        for _ in range(top + 1):
            out[at] = part
            part *= y
            at += 1
        power *= x


@bare
def _sum_terms(cells, owner, which, cap2, terms, coef, basis, gram):  # type: ignore[no-untyped-def]
    """Normal equations of `_fit`: lower triangle of gram (terms + 1, terms), right side in its last row; and
    the number of cells in them."""
    gram[: terms + 1, :terms] = 0.0
    right = gram[terms]
    count = 0
    first = np.isfinite(coef[0])
    for i in range(cells.value.shape[0]):
        if owner[i] != which:
            continue
        _basis(cells.place[i, 0], cells.place[i, 1], terms, basis)
        if first:
            miss = cells.value[i]
            for a in range(terms):
                miss -= coef[a] * basis[a]
            if miss * miss > cap2:
                continue
        count += 1
        w = cells.weight[i]
        for a in range(terms):
            right[a] += w * basis[a] * cells.value[i]
            for b in range(a + 1):
                gram[a, b] += w * basis[a] * basis[b]
    return count


@bare
def _sum_plane(cells, owner, which, cap2, coef, gram):  # type: ignore[no-untyped-def]
    """`_sum_terms` for a plane, which most fits are of: the same to the bit, without a basis in memory."""
    first = np.isfinite(coef[0])
    c0, c1, c2 = coef[0], coef[1], coef[2]
    g00 = g10 = g11 = g20 = g21 = g22 = r0 = r1 = r2 = 0.0
    count = 0
    for i in range(cells.value.shape[0]):
        if owner[i] != which:
            continue
        x, y, v, w = cells.place[i, 0], cells.place[i, 1], cells.value[i], cells.weight[i]
        miss = v - c0 - c1 * x - c2 * y
        if first and miss * miss > cap2:
            continue
        count += 1
        wx, wy = w * x, w * y
        g00 += w
        g10 += wx
        g11 += wx * x
        g20 += wy
        g21 += wy * x
        g22 += wy * y
        r0 += w * v
        r1 += wx * v
        r2 += wy * v
    gram[0, 0], gram[1, 0], gram[1, 1], gram[2, 0], gram[2, 1], gram[2, 2] = g00, g10, g11, g20, g21, g22
    gram[PLANE, 0], gram[PLANE, 1], gram[PLANE, 2] = r0, r1, r2
    return count


@bare
def _fit(cells, owner, which, cap2, terms, coef, basis, gram):  # type: ignore[no-untyped-def]
    """Least squares of the cells with this owner that a first model misses by no more than the cap, in place.

    coef (25,) holds the first model if coef[0] is finite. Returns whether there were enough cells.
    """
    if terms == PLANE:
        count = _sum_plane(cells, owner, which, cap2, coef, gram)
    else:
        count = _sum_terms(cells, owner, which, cap2, terms, coef, basis, gram)
    if count < terms + 1:
        return False
    ridge = 1e-9 * gram[0, 0]
    for a in range(terms):
        for b in range(a + 1):
            total = gram[a, b] + (ridge if a == b else 0.0)
            for c in range(b):
                total -= gram[a, c] * gram[b, c]
            gram[a, b] = np.sqrt(max(total, ridge)) if a == b else total / gram[b, b]
    solve_triangular(gram, terms, gram[terms], coef)
    coef[terms:] = 0.0
    return True


@inlined
def _cost(cells, i, coef, terms, cap2, unit, basis):  # type: ignore[no-untyped-def]
    """Length of a cell under a surface: its squared miss, capped, over the noise of a measurement."""
    _basis(cells.place[i, 0], cells.place[i, 1], terms, basis)
    miss = cells.value[i]
    for a in range(terms):
        miss -= coef[a] * basis[a]
    return cells.weight[i] * min(miss * miss, cap2) / unit


@bare
def _costs(cells, coef, terms, cap2, unit, out):  # type: ignore[no-untyped-def]
    """`_cost` of all cells under a plane or a quadric into out (n,), several at once; the same to the bit."""
    c0, c1, c2, c3, c4, c5 = coef[0], coef[1], coef[2], coef[3], coef[4], coef[5]
    if terms == PLANE:
        for i in range(cells.value.shape[0]):
            miss = cells.value[i] - c0 - c1 * cells.place[i, 0] - c2 * cells.place[i, 1]
            out[i] = cells.weight[i] * min(miss * miss, cap2) / unit
        return
    for i in range(cells.value.shape[0]):
        x = cells.place[i, 0]
        y = cells.place[i, 1]
        miss = cells.value[i] - c0 - c1 * x - c2 * y - c3 * (x * x) - c4 * (x * y) - c5 * (y * y)
        out[i] = cells.weight[i] * min(miss * miss, cap2) / unit


@bare
def _gains(cells, planes, cost, unit, gains):  # type: ignore[no-untyped-def]
    """gains[h] = what plane h would shorten the costs of all cells by, several planes at once.

    planes : (3, >= H); cost : (n,)
    """
    first, second, third = planes[0], planes[1], planes[2]
    gains[:] = 0.0
    for i in range(cells.value.shape[0]):
        x, y, v, w, before = cells.place[i, 0], cells.place[i, 1], cells.value[i], cells.weight[i], cost[i]
        for h in range(gains.shape[0]):
            miss = v - first[h]
            miss -= second[h] * x + third[h] * y
            gains[h] += max(before - w * miss * miss / unit, 0.0)


@bare
def _assign(cells, coefs, terms, count, cap2, unit, owner, table):  # type: ignore[no-untyped-def]
    """Let each cell choose its surface, with its neighbours in mind; returns how many changed."""
    for k in range(count):
        _costs(cells, coefs[k], terms[k], cap2, unit, table[k])
    changed = 0
    for i in range(cells.value.shape[0]):
        best = np.inf
        choice = owner[i]
        # those of no neighbour differ from no surface
        left, right = cells.beside[i, 0], cells.beside[i, 1]
        above, below = cells.beside[i, 2], cells.beside[i, 3]
        a = owner[left] if left >= 0 else np.int64(-1)
        b = owner[right] if right >= 0 else np.int64(-1)
        c = owner[above] if above >= 0 else np.int64(-1)
        d = owner[below] if below >= 0 else np.int64(-1)
        for k in range(count):
            cost = table[k, i]
            cost += BORDER if a >= 0 and a != k else 0.0
            cost += BORDER if b >= 0 and b != k else 0.0
            cost += BORDER if c >= 0 and c != k else 0.0
            cost += BORDER if d >= 0 and d != k else 0.0
            if cost < best:
                best = cost
                choice = k
        if choice != owner[i]:
            owner[i] = choice
            changed += 1
    return changed


@bare
def _length(cells, coefs, terms, count, owner, cap2, unit, price, table):  # type: ignore[no-untyped-def]
    """Length of the whole description: misses, coefficients, and one number more that names each surface."""
    for k in range(count):
        _costs(cells, coefs[k], terms[k], cap2, unit, table[k])
    total = 0.0
    for i in range(cells.value.shape[0]):
        total += table[owner[i], i]
    for k in range(count):
        total += price * (terms[k] + 1)
    return total


@bare
def _settle(cells, coefs, terms, count, owner, cap2, unit, rounds, table, basis, gram):  # type: ignore[no-untyped-def]
    for _ in range(rounds):
        for k in range(count):
            _fit(cells, owner, k, cap2, terms[k], coefs[k], basis, gram)
        if _assign(cells, coefs, terms, count, cap2, unit, owner, table) == 0:
            break


@bare
def _one_polynomial(cells, single, cap2, wide, unit, price, enough, trial, basis, gram):  # type: ignore[no-untyped-def]
    """Length of the shortest description by one polynomial; single (n,) : zeros; wide : cap of lengths.

    Once it is not above `enough` nobody wants it shorter, and what cannot be as short is not tried.
    """
    shortest = np.inf
    for terms in (PLANE, QUADRIC, 9, QUARTIC):
        if shortest <= enough or price * (terms + 1) > enough:
            break
        trial[0] = np.nan
        for _ in range(2):  # the second time without the cells that the first model misses
            if not _fit(cells, single, 0, cap2, terms, trial, basis, gram):
                break
            total = price * (terms + 1)
            for i in range(cells.value.shape[0]):
                total += _cost(cells, i, trial, terms, wide, unit, basis)
            shortest = min(shortest, total)
    return shortest


@bare
def _joints(cells, owner, coefs, flat, out):  # type: ignore[no-untyped-def]
    """Sums over the borders of each two surfaces: pairs of cells, step, cosine of the angle between them.

    flat : slope of a surface tilted by 45 degrees; out : (K, K, 3), filled where the first is lower
    """
    for i in range(owner.shape[0]):
        for d in range(1, 4, 2):
            j = cells.beside[i, d]
            if j < 0 or owner[j] == owner[i]:
                continue
            a, b = min(owner[i], owner[j]), max(owner[i], owner[j])
            x = 0.5 * (cells.place[i, 0] + cells.place[j, 0])
            y = 0.5 * (cells.place[i, 1] + cells.place[j, 1])
            first, second = coefs[a], coefs[b]
            step = first[0] - second[0] + (first[1] - second[1]) * x + (first[2] - second[2]) * y
            step += (first[3] - second[3]) * x * x + (first[4] - second[4]) * x * y
            step += (first[5] - second[5]) * y * y
            ax = (first[1] + 2.0 * first[3] * x + first[4] * y) / flat
            ay = (first[2] + first[4] * x + 2.0 * first[5] * y) / flat
            bx = (second[1] + 2.0 * second[3] * x + second[4] * y) / flat
            by = (second[2] + second[4] * x + 2.0 * second[5] * y) / flat
            cosine = (1.0 + ax * bx + ay * by) / np.sqrt(
                (1.0 + ax * ax + ay * ay) * (1.0 + bx * bx + by * by)
            )
            out[a, b, 0] += 1.0
            out[a, b, 1] += step * step
            out[a, b, 2] += cosine


@kernel
def describe(cells, cap2, wide, fine, unit, price, flat, owner, coefs, terms, joints):  # type: ignore[no-untyped-def]
    """The shortest description of a region by planes and quadrics that was found.

    cap2 : squared miss beyond which a cell takes no part in a fit
    wide : the same beyond which it counts for no more in lengths
    fine : variance of one independent measurement, by which cells change sides
    unit : the same with the systematic error of the whole region, for lengths
    price : length of a coefficient
    flat : slope of a surface tilted by 45 degrees
    Out: owner (n,) surface of each cell, coefs (MOST + 1, 25), terms (MOST + 1,); joints (MOST, MOST, 3), see
    `_joints`
    Returns the number of surfaces, its length and that of one curved surface; which of the two is the shorter
    is certain, how much longer the other one is may not be.
    """
    n = cells.value.shape[0]
    basis = np.empty(QUARTIC)
    gram = np.empty((QUARTIC + 1, QUARTIC))
    trial = np.empty(QUARTIC)
    single = np.zeros(n, np.int64)
    least = 2 * (PLANE + 1) * price
    curved = _one_polynomial(cells, single, cap2, wide, unit, price, least, trial, basis, gram)
    if curved <= least:  # no two surfaces are as short
        return 1, curved, curved
    # hypotheses: planes round some of the cells, near and farther
    stride = max(1, n // HYPOTHESES)
    planes = np.empty((PLANE, 2 * n))
    found = 0
    ring = np.empty(n, np.int64)
    seen = np.full(n, -1, np.int64)
    steps = np.empty(n, np.int64)
    inside = np.empty(n, np.int64)
    for i in range(stride // 2, n, stride):
        ring[0] = i
        steps[0] = 0
        seen[i] = i
        end = 1
        start = 0
        while start < end:  # cells within four steps, across this region only
            j = ring[start]
            if steps[start] < 4:
                for d in range(4):
                    m = cells.beside[j, d]
                    if m >= 0 and seen[m] != i:
                        seen[m] = i
                        ring[end] = m
                        steps[end] = steps[start] + 1
                        end += 1
            start += 1
        for reach in (2, 4):
            inside[:] = 0
            many = 0
            for j in range(end):
                if steps[j] <= reach:
                    inside[ring[j]] = 1
                    many += 1
            trial[0] = np.nan
            if many >= LEAST_CELLS and _fit(cells, inside, 1, cap2, PLANE, trial, basis, gram):
                planes[:, found] = trial[:PLANE]
                found += 1
    # the one that shortens the description most, again and again
    cost = np.empty(n)
    table = np.empty((MOST, n))
    for i in range(n):
        cost[i] = cells.weight[i] * wide / unit
        owner[i] = 0
    count = 0
    gains = np.empty(found)
    while count < MOST:
        best = price
        choice = -1
        _gains(cells, planes, cost, unit, gains)
        for h in range(found):
            if gains[h] > best:
                best = gains[h]
                choice = h
        if choice < 0:
            break
        coefs[count] = 0.0
        coefs[count, :PLANE] = planes[:, choice]
        terms[count] = PLANE
        for _ in range(2):  # to all that it explains
            inside[:] = 0
            _costs(cells, coefs[count], PLANE, wide, unit, table[0])
            for i in range(n):
                if table[0, i] < cost[i]:
                    inside[i] = 1
            _fit(cells, inside, 1, cap2, PLANE, coefs[count], basis, gram)
        _costs(cells, coefs[count], PLANE, wide, unit, table[0])
        for i in range(n):
            if table[0, i] < cost[i]:
                cost[i] = table[0, i]
                owner[i] = count
        count += 1
    if count == 0:
        return 0, np.inf, curved
    _settle(cells, coefs, terms, count, owner, cap2, fine, ROUNDS, table, basis, gram)
    # drop what does not pay, raise what must bend
    length = _length(cells, coefs, terms, count, owner, wide, unit, price, table)
    other = np.empty(n, np.int64)
    coefs2 = np.empty_like(coefs)
    terms2 = np.empty_like(terms)
    improved = True
    while improved:
        improved = False
        for k in range(count):
            for change in range(2):
                if count == 1 if change == 0 else terms[k] != PLANE:
                    continue
                coefs2[:] = coefs
                terms2[:] = terms
                many = count
                for i in range(n):
                    other[i] = owner[i]
                if change == 0:
                    many = count - 1
                    coefs2[k] = coefs[many]
                    terms2[k] = terms[many]
                    for i in range(n):
                        if owner[i] == k:
                            least = np.inf
                            for m in range(many):
                                c = _cost(cells, i, coefs2[m], terms2[m], wide, unit, basis)
                                if c < least:
                                    least = c
                                    other[i] = m
                        elif owner[i] == many:
                            other[i] = k
                else:
                    terms2[k] = QUADRIC
                _settle(cells, coefs2, terms2, many, other, cap2, fine, TRIAL_ROUNDS, table, basis, gram)
                after = _length(cells, coefs2, terms2, many, other, wide, unit, price, table)
                if after < length - 1e-9:
                    length = after
                    count = many
                    coefs[:] = coefs2
                    terms[:] = terms2
                    for i in range(n):
                        owner[i] = other[i]
                    improved = True
                    break
            if improved:
                break
    # cells across a border lie on neither side: both accounts are compared where there is none
    inside_only = Cells(cells.place, cells.value, cells.weight.copy(), cells.beside)
    across = 0
    for i in range(n):
        for d in range(4):
            j = cells.beside[i, d]
            if j >= 0 and owner[j] != owner[i]:
                inside_only.weight[i] = 0.0
                across += 1
                break
    if count < 2 or 2 * across > n:
        return 1, curved, curved
    _joints(cells, owner, coefs, flat, joints)
    length = _length(inside_only, coefs, terms, count, owner, wide, unit, price, table)
    curved = _one_polynomial(inside_only, single, cap2, wide, unit, price, length, trial, basis, gram)
    if length < curved:
        enough = length - price * 10
        work = np.empty((4, 9))
        curved = min(curved, price * 10 + second_order(inside_only, cap2, wide, unit, enough, gram, work))
    return count, length, curved
