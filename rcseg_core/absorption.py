"""Single pixels: absorbed by the region that predicts them, moved where a neighbour predicts them better.

The paper groups regions "with other regions or points" (step 3): a point is a region of one pixel, so it can be
absorbed and never absorbs. Growth is best-first over the whole image (a bucket queue over the cost), which makes
regions meet where their models cross. `refine` then lets boundary pixels change sides, and `fill` gives the
remaining specks to a neighbour. A pixel takes over the leaf (seed) of the pixel it joined, so that the merge tree
stays a tree of pixels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rcseg_core.jit import kernel
from rcseg_core.models import Models, pixel_cost
from rcseg_core.signals import COLOR_OUTLIER, INVALID, RANGE_OUTLIER, Signals

BUCKETS = 256
#: What an impulse costs more than a measured pixel, as a share of the limit: it comes after its neighbours.
IMPULSE_SHARE = 0.5


@kernel
def _grow(image, flags, labels, leaves, within, models, n_range, law, color_eps2, max_cost):  # type: ignore[no-untyped-def]
    """Best-first growth: each bucket is a linked list of (pixel, region) offers, cheapest bucket first."""
    height, width = labels.shape
    first = np.full(BUCKETS, -1, np.int64)
    last = np.full(BUCKETS, -1, np.int64)
    capacity = height * width
    following = np.empty(capacity, np.int64)
    offer = np.empty((capacity, 2), np.int64)  # pixel, pixel it would join
    used = 0
    scale = BUCKETS / max_cost
    current = 0
    scan = 0
    total = height * width
    while True:
        # every region makes its first offers in a raster scan; after that every absorbed pixel, cheapest first
        source = np.int64(-1)
        if scan < total:
            row = scan // width
            col = scan % width
            if labels[row, col] > 0:
                source = scan
            scan += 1
            if source < 0:
                continue
        else:
            while current < BUCKETS and first[current] < 0:
                current += 1
            if current == BUCKETS:
                break
            item = first[current]
            first[current] = following[item]
            if first[current] < 0:
                last[current] = -1
            row = offer[item, 0] // width
            col = offer[item, 0] % width
            if labels[row, col] != 0:
                continue
            giver_row = offer[item, 1] // width
            giver_col = offer[item, 1] % width
            labels[row, col] = labels[giver_row, giver_col]
            leaves[row, col] = leaves[giver_row, giver_col]
            source = offer[item, 0]
        row = source // width
        col = source % width
        k = labels[row, col]
        for d in range(4):
            r = row + (d == 1) - (d == 0)
            c = col + (d == 3) - (d == 2)
            if r < 0 or c < 0 or r >= height or c >= width:
                continue
            if labels[r, c] != 0 or flags[r, c] & INVALID != 0 or within[r, c] != within[row, col]:
                continue
            cost = pixel_cost(models, k, image, flags, r, c, n_range, law, color_eps2)
            if flags[r, c] & (RANGE_OUTLIER | COLOR_OUTLIER) != 0:
                cost += IMPULSE_SHARE * max_cost
            if not cost < max_cost:
                continue
            bucket = np.int64(cost * scale)
            if used == capacity:
                bigger = np.empty((2 * capacity, 2), np.int64)
                bigger[:capacity] = offer
                offer = bigger
                longer = np.empty(2 * capacity, np.int64)
                longer[:capacity] = following
                following = longer
                capacity *= 2
            offer[used, 0] = r * width + c
            offer[used, 1] = source
            following[used] = -1
            if first[bucket] < 0:
                first[bucket] = used
            else:
                following[last[bucket]] = used
            last[bucket] = used
            used += 1
            if bucket < current:
                current = bucket


@kernel
def _refine(image, flags, labels, leaves, within, models, n_range, law, color_eps2, smoothness):  # type: ignore[no-untyped-def]
    """One raster pass: each boundary pixel takes the label with the least cost plus smoothness per other neighbour.

    Returns the number of pixels that changed.
    """
    height, width = labels.shape
    moved = 0
    for row in range(height):
        for col in range(width):
            k = labels[row, col]
            if k <= 0:
                continue
            border = False
            for d in range(4):
                r = row + (d == 1) - (d == 0)
                c = col + (d == 3) - (d == 2)
                if 0 <= r < height and 0 <= c < width and labels[r, c] > 0 and labels[r, c] != k:
                    border = True
            if not border:
                continue
            best = k
            best_cost = np.inf
            best_at = np.int64(-1)
            for candidate in range(5):
                r = row
                c = col
                if candidate < 4:
                    r = row + (candidate == 1) - (candidate == 0)
                    c = col + (candidate == 3) - (candidate == 2)
                    if r < 0 or c < 0 or r >= height or c >= width:
                        continue
                m = labels[r, c]
                if m <= 0 or (candidate < 4 and m == k) or within[r, c] != within[row, col]:
                    continue
                cost = pixel_cost(models, m, image, flags, row, col, n_range, law, color_eps2)
                for i in range(-1, 2):
                    for j in range(-1, 2):
                        rr = row + i
                        cc = col + j
                        if 0 <= rr < height and 0 <= cc < width and labels[rr, cc] > 0 and labels[rr, cc] != m:
                            cost += smoothness
                if cost < best_cost or (cost == best_cost and m < best):
                    best_cost = cost
                    best = m
                    best_at = r * width + c
            if best != k:
                labels[row, col] = best
                leaves[row, col] = leaves[best_at // width, best_at % width]
                moved += 1
    return moved


def absorb(
    signals: Signals, labels: NDArray[np.int32], leaves: NDArray[np.int32], models: Models, max_cost: float,
    within: NDArray[np.int32] | None = None,
) -> None:  # fmt: skip
    """Grow regions over unassigned measured pixels, best first, in place; invalid pixels stay 0.

    within : (H, W) int32, optional; growth never crosses from one value of it to another
    """
    if not ((labels == 0) & (signals.flags & INVALID == 0)).any():
        return
    if within is None:
        within = np.zeros_like(labels)
    _grow(
        signals.image, signals.flags, labels, leaves, within, models, signals.n_range, signals.law,
        signals.color_eps2, max_cost,
    )  # fmt: skip


#: Cost of one disagreeing neighbour out of eight, in the units of `pixel_cost`.
SMOOTHNESS = 0.5


def refine(
    signals: Signals, labels: NDArray[np.int32], leaves: NDArray[np.int32], models: Models, passes: int,
    within: NDArray[np.int32] | None = None,
) -> None:  # fmt: skip
    """Let boundary pixels move to the adjacent region that predicts them better, in place; `within` as in absorb."""
    if within is None:
        within = np.zeros_like(labels)
    for _ in range(passes):
        moved = _refine(
            signals.image, signals.flags, labels, leaves, within, models, signals.n_range, signals.law,
            signals.color_eps2, SMOOTHNESS,
        )  # fmt: skip
        if moved == 0:
            break
