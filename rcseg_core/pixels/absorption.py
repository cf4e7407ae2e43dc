"""Single pixels: absorbed by the region that predicts them, moved where a neighbour predicts them better.

The paper groups regions "with other regions or points" (step 3): a point is a region of one pixel, so it can
be absorbed and never absorbs. Growth is best-first over the whole image (a bucket queue over the cost), which
makes regions meet where their models cross. `refine` then lets boundary pixels change sides. A pixel takes
over the leaf (seed) of the pixel it joined, so that the merge tree stays a tree of pixels.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.inline import inlined
from rcseg_core.compute.jit import bare
from rcseg_core.compute.parallel import bands, over_bands
from rcseg_core.graph.components import count_unassigned, mark_borders
from rcseg_core.models.polynomials import Models, pixel_cost
from rcseg_core.signal.signals import COLOR_OUTLIER, INVALID, RANGE_OUTLIER, Signals

BUCKETS = 256
#: What an impulse costs more than a measured pixel, as a share of the limit: it comes after its neighbours.
IMPULSE_SHARE = 0.5


class Before(NamedTuple):
    """What the last frame decided of pixels and regions; see `grouping.Held`, a pixel being a small region.

    labels : (H, W) int32, regions of the last frame as this one shows them, 0 not known; (1, 1): nothing is
    names : (N + 1,) int64, of these what each region was part of, 0 not known
    favour : 1 or more; a pixel costs a region of which it was this many times less
    """

    labels: NDArray[np.int32]
    names: NDArray[np.int64]
    favour: float


def alone() -> Before:
    """Of a frame that stands alone."""
    return Before(np.zeros((1, 1), np.int32), np.zeros(1, np.int64), 1.0)


class Offers(NamedTuple):
    """A bucket queue of offers, each a pixel and the labelled pixel that it would join (flat indices).

    first, last : (BUCKETS,) int64 offer or -1; following, pixel, giver : (n,) int32
    """

    first: NDArray[np.int64]
    last: NDArray[np.int64]
    following: NDArray[np.int32]
    pixel: NDArray[np.int32]
    giver: NDArray[np.int32]


def _make_offers(pixels: int) -> Offers:
    """Room for every offer that can be made: each pixel gets at most one from each of its four neighbours."""
    return Offers(
        np.full(BUCKETS, -1, np.int64),
        np.full(BUCKETS, -1, np.int64),
        *(np.empty(4 * pixels, np.int32) for _ in range(3)),
    )


@inlined
def _offer(offers, used, bucket, pixel, giver):  # type: ignore[no-untyped-def]
    offers.pixel[used] = pixel
    offers.giver[used] = giver
    offers.following[used] = -1
    if offers.first[bucket] < 0:
        offers.first[bucket] = used
    else:
        offers.following[offers.last[bucket]] = used
    offers.last[bucket] = used


@inlined
def _cost(models, k, image, flags, row, col, n_range, law, color_eps2, before):  # type: ignore[no-untyped-def]
    """Cost of a pixel under region k, less where it was of that before."""
    cost = pixel_cost(models, k, image, flags, row, col, n_range, law, color_eps2)
    if before.labels.shape[0] > 1:
        name = before.labels[row, col]
        if name > 0 and name == before.names[k]:
            cost /= before.favour
    return cost


@inlined
def _bucket(  # type: ignore[no-untyped-def]
    models, k, image, flags, row, col, n_range, law, color_eps2, before, max_cost
):
    """Bucket of the cost of a pixel under region k, or -1 where it exceeds max_cost."""
    cost = _cost(models, k, image, flags, row, col, n_range, law, color_eps2, before)
    if flags[row, col] & (RANGE_OUTLIER | COLOR_OUTLIER) != 0:
        cost += IMPULSE_SHARE * max_cost
    return np.int64(cost * (BUCKETS / max_cost)) if cost < max_cost else np.int64(-1)


@bare
def _grow(  # type: ignore[no-untyped-def]
    image, flags, labels, leaves, within, models, n_range, law, color_eps2, before, max_cost, offers, offered
):
    """Best-first growth: unassigned pixels get an offer of each region they touch; the cheapest comes first.

    A second offer of the same region costs the same and comes later, so it is not made.

    within : (H, W) int32, or (1, 1) for no bounds
    offered : (H, W) int32 of zeros, the region that made the last offer to a pixel
    Returns the number of pixels that were absorbed.
    """
    height, width = labels.shape
    bounded = within.shape[0] == height
    absorbed = 0
    used = 0
    for row in range(height):
        for col in range(width):
            if labels[row, col] != 0 or flags[row, col] & INVALID != 0:
                continue
            for d in range(4):
                r = row + (d == 1) - (d == 0)
                c = col + (d == 3) - (d == 2)
                if r < 0 or c < 0 or r >= height or c >= width:
                    continue
                if labels[r, c] == 0 or (bounded and within[r, c] != within[row, col]):
                    continue
                k = labels[r, c]
                if offered[row, col] == k:
                    continue
                offered[row, col] = k
                bucket = _bucket(
                    models, k, image, flags, row, col, n_range, law, color_eps2, before, max_cost
                )
                if bucket >= 0:
                    _offer(offers, used, bucket, row * width + col, r * width + c)
                    used += 1
    current = 0
    while True:
        while current < BUCKETS and offers.first[current] < 0:
            current += 1
        if current == BUCKETS:
            break
        item = offers.first[current]
        offers.first[current] = offers.following[item]
        row = offers.pixel[item] // width
        col = offers.pixel[item] % width
        if labels[row, col] != 0:
            continue
        k = labels[offers.giver[item] // width, offers.giver[item] % width]
        absorbed += 1
        labels[row, col] = k
        leaves[row, col] = leaves[offers.giver[item] // width, offers.giver[item] % width]
        for d in range(4):
            r = row + (d == 1) - (d == 0)
            c = col + (d == 3) - (d == 2)
            if r < 0 or c < 0 or r >= height or c >= width:
                continue
            if labels[r, c] != 0 or flags[r, c] & INVALID != 0:
                continue
            if offered[r, c] == k or (bounded and within[r, c] != within[row, col]):
                continue
            offered[r, c] = k
            bucket = _bucket(models, k, image, flags, r, c, n_range, law, color_eps2, before, max_cost)
            if bucket >= 0:
                _offer(offers, used, bucket, r * width + c, offers.pixel[item])
                used += 1
                current = min(current, bucket)
    return absorbed


@bare
def _refine(  # type: ignore[no-untyped-def]
    image, flags, labels, leaves, models, n_range, law, color_eps2, before, smoothness, settled, asleep,
    marked, first, last,
):  # fmt: skip
    """One raster pass over rows: each boundary pixel takes the label of least cost, smoothness included.

    settled : (H, W) uint8, 1 where a pixel was looked at and no label round it has changed since
    asleep : (H,) uint8, 1 where this holds of all pixels of a row that have another label beside them
    marked : (W,) bool, work
    Returns the number of pixels that changed.
    """
    height, width = labels.shape
    moved = 0
    for row in range(first, last):
        if asleep[row] != 0:
            continue
        asleep[row] = 1
        above = max(row - 1, 0)
        below = min(row + 1, height - 1)
        mark_borders(labels, row, marked)
        for col in range(width):
            if not marked[col]:
                continue
            k = labels[row, col]
            right = labels[row, min(col + 1, width - 1)]
            left = labels[row, max(col - 1, 0)]
            up = labels[above, col]
            down = labels[below, col]
            # a pixel before it may have joined its region
            if (up == k) & (down == k) & (left == k) & (right == k):
                continue
            if k <= 0 or settled[row, col] != 0:
                continue
            settled[row, col] = 1
            best = k
            best_cost = np.inf
            best_at = np.int64(-1)
            for candidate in range(5):
                r = row
                c = col
                m = k
                if candidate == 0:
                    m = up
                    r = row - 1
                elif candidate == 1:
                    m = down
                    r = row + 1
                elif candidate == 2:
                    m = left
                    c = col - 1
                elif candidate == 3:
                    m = right
                    c = col + 1
                # each label once; its own comes last
                if m <= 0 or (candidate < 4 and m == k):
                    continue
                if (candidate == 1 and m == up) or (candidate == 2 and m in (up, down)):
                    continue
                if candidate == 3 and m in (up, down, left):
                    continue
                cost = _cost(models, m, image, flags, row, col, n_range, law, color_eps2, before)
                for rr in range(max(row - 1, 0), min(row + 2, height)):
                    for cc in range(max(col - 1, 0), min(col + 2, width)):
                        if labels[rr, cc] > 0 and labels[rr, cc] != m:
                            cost += smoothness
                if cost < best_cost or (cost == best_cost and m < best):
                    best_cost = cost
                    best = m
                    best_at = r * width + c
            if best != k:
                labels[row, col] = best
                leaves[row, col] = leaves[best_at // width, best_at % width]
                moved += 1
                for rr in range(above, below + 1):
                    asleep[rr] = 0
                    for cc in range(max(col - 1, 0), min(col + 2, width)):
                        settled[rr, cc] = 0
                marked[min(col + 1, width - 1)] = True
    return moved


def absorb(
    signals: Signals, labels: NDArray[np.int32], leaves: NDArray[np.int32], models: Models, max_cost: float,
    within: NDArray[np.int32] | None = None, before: Before | None = None,
) -> int:  # fmt: skip
    """Grow regions over unassigned measured pixels, best first, in place; invalid pixels stay 0.

    within : (H, W) int32, optional; growth never crosses from one value of it to another
    Returns the number of pixels that were absorbed.
    """
    unassigned = count_unassigned(labels, signals.flags)
    if unassigned == 0:
        return 0
    if within is None:
        within = np.zeros((1, 1), np.int32)
    absorbed: int = _grow(
        signals.image, signals.flags, labels, leaves, within, models, signals.n_range, signals.law,
        signals.color_eps2, before or alone(), max_cost, _make_offers(unassigned),
        np.zeros(labels.shape, np.int32),
    )  # fmt: skip
    return absorbed


#: Cost of one disagreeing neighbour out of eight, in the units of `pixel_cost`.
SMOOTHNESS = 0.5


def refine(
    signals: Signals, labels: NDArray[np.int32], leaves: NDArray[np.int32], models: Models, passes: int,
    before: Before | None = None,
) -> int:  # fmt: skip
    """Move boundary pixels, in place, to the adjacent region that predicts them better; returns how many."""
    height = len(labels)
    rows = bands(height)
    inner = [0] * len(rows)
    settled, asleep = np.zeros(labels.shape, np.uint8), np.zeros(height, np.uint8)
    before = before or alone()

    def refine_rows(first: int, last: int) -> int:
        moved: int = _refine(
            signals.image, signals.flags, labels, leaves, models, signals.n_range, signals.law,
            signals.color_eps2, before, SMOOTHNESS, settled, asleep, np.empty(labels.shape[1], np.bool_),
            first, last,
        )  # fmt: skip
        return moved

    def refine_inside(i: int, first: int, last: int) -> None:
        inner[i] = refine_rows(first + (i > 0), last - (i + 1 < len(rows)))

    total = 0
    for _ in range(passes):
        # a pixel looks at the rows above and below: those between bands come after, so that all bands see the
        # same whatever their order
        over_bands(height, refine_inside)
        between = sum(refine_rows(max(last - 1, first), last + 1) for first, last in rows[:-1])
        total += sum(inner) + between
        if sum(inner) + between == 0:
            break
    return total
