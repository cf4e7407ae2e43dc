"""The last word on pixels that no surface explains: flying pixels at steps of depth, and small holes.

A flying pixel lies in mid-air between a near and a far surface: its range says nothing of which of the two it
shows, its colour does. A hole that one surface surrounds may be seen as a part of it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.compute.parallel import BANDS, over_bands
from rcseg_core.models.polynomials import Models, predict
from rcseg_core.signal.signals import COLOR_OUTLIER, INVALID, Signals, local_scales

#: Squared residual, over noise and half of the tolerance, beyond which a surface does not explain a pixel.
UNEXPLAINED = 9.0
#: Flying pixels are at most this far from both surfaces.
NEAR_PX = 2
#: Cost of a neighbour of another region when a flying pixel chooses, in the units of `pixel_cost`.
SMOOTHNESS = 0.5


@bare
def color_cost(models, k, image, flags, row, col, n_range, color_eps2):  # type: ignore[no-untyped-def]
    """Squared residual of the colour of a pixel under region k, over its noise and half of the tolerance."""
    channels = image.shape[2] - n_range
    if channels == 0 or flags[row, col] & COLOR_OUTLIER != 0:
        return 0.0
    total = 0.0
    for c in range(n_range, n_range + channels):
        d = image[row, col, c] - predict(models, k, row, col, 1, c)
        total += d * d
    return total / (1.0 + 0.25 * color_eps2 / channels)


@bare
def _is_flying(image, labels, models, n_range, law, row, col):  # type: ignore[no-untyped-def]
    """Whether a pixel lies between the surfaces around it and on none of them."""
    height, width = labels.shape
    channel = n_range - 1
    value = np.float64(image[row, col, channel])
    low = np.inf
    high = -np.inf
    before = np.int64(0)
    for r in range(max(row - NEAR_PX, 0), min(row + NEAR_PX + 1, height)):
        for c in range(max(col - NEAR_PX, 0), min(col + NEAR_PX + 1, width)):
            k = labels[r, c]
            if k == 0 or k == before:
                continue
            before = k
            predicted = predict(models, k, row, col, 0, channel)
            var, eps2 = local_scales(law, predicted)
            if (value - predicted) ** 2 <= UNEXPLAINED * (var + 0.25 * eps2 / n_range):
                return False
            low = min(low, predicted)
            high = max(high, predicted)
    return low < value < high


@bare
def find_flying(image, flags, labels, models, n_range, law, first, last, queue):  # type: ignore[no-untyped-def]
    """List flying pixels of rows first..last-1 in queue (pixels,) int64, flat indices in raster order.

    Returns their number.
    """
    height, width = labels.shape
    end = 0
    for row in range(first, last):
        up = max(row - NEAR_PX, 0)
        down = min(row + NEAR_PX, height - 1)
        for col in range(width):
            k = labels[row, col]
            if k == 0 or flags[row, col] & INVALID != 0:
                continue
            left = max(col - NEAR_PX, 0)
            right = min(col + NEAR_PX, width - 1)
            if (
                labels[up, col] == k
                and labels[down, col] == k
                and labels[row, left] == k
                and labels[row, right] == k
                and labels[up, left] == k
                and labels[up, right] == k
                and labels[down, left] == k
                and labels[down, right] == k
            ):
                continue
            if _is_flying(image, labels, models, n_range, law, row, col):
                queue[end] = row * width + col
                end += 1
    return end


@bare
def choose_by_color(image, flags, labels, leaves, models, n_range, color_eps2, queue, end):  # type: ignore[no-untyped-def]
    """Each listed pixel joins the region around it whose colour and company suit it best, in place."""
    height, width = labels.shape
    for i in range(end):
        row = queue[i] // width
        col = queue[i] % width
        best = labels[row, col]
        best_at = queue[i]
        best_cost = np.inf
        for place in range(9):
            j = (place + 4) % 9  # itself first: it stays where nothing is better
            r = row + j // 3 - 1
            c = col + j % 3 - 1
            if r < 0 or c < 0 or r >= height or c >= width:
                continue
            k = labels[r, c]
            if k == 0 or (place > 0 and k == best):
                continue
            cost = color_cost(models, k, image, flags, row, col, n_range, color_eps2)
            for rr in range(max(row - 1, 0), min(row + 2, height)):
                for cc in range(max(col - 1, 0), min(col + 2, width)):
                    if labels[rr, cc] != k and (rr != row or cc != col):
                        cost += SMOOTHNESS
            if cost < best_cost:
                best_cost = cost
                best = k
                best_at = r * width + c
        labels[row, col] = best
        leaves[row, col] = leaves[best_at // width, best_at % width]


@bare
def _fill(labels, leaves, surface_of, largest, seen, queue):  # type: ignore[no-untyped-def]
    """Fill holes, see `fill_holes`. seen : (H, W) uint8 zeros, work; queue : (pixels,) int64, work."""
    height, width = labels.shape
    filled = 0
    for start in range(height * width):
        if seen[start // width, start % width] != 0 or labels[start // width, start % width] != 0:
            continue
        # the hole, and which surfaces are around it
        queue[0] = start
        seen[start // width, start % width] = 1
        end = 1
        at = 0
        around = np.int64(0)
        closed = True
        while at < end:
            row = queue[at] // width
            col = queue[at] % width
            at += 1
            for d in range(4):
                r = row + (d == 1) - (d == 0)
                c = col + (d == 3) - (d == 2)
                if r < 0 or c < 0 or r >= height or c >= width:
                    closed = False
                    continue
                if labels[r, c] != 0:
                    s = surface_of[labels[r, c]]
                    closed = closed and around in (0, s)
                    around = s
                elif seen[r, c] == 0:
                    seen[r, c] = 1
                    queue[end] = r * width + c
                    end += 1
        if not closed or end > largest or around == 0:
            continue
        # from its rim inwards, a ring at a time
        filled += end
        left = end
        while left > 0:
            ring = 0
            for i in range(left):
                row = queue[i] // width
                col = queue[i] % width
                giver = np.int64(-1)
                for d in range(4):
                    r = row + (d == 1) - (d == 0)
                    c = col + (d == 3) - (d == 2)
                    if labels[r, c] > 0 and giver < 0:
                        giver = r * width + c
                if giver >= 0:
                    labels[row, col] = -labels[giver // width, giver % width]
                    leaves[row, col] = leaves[giver // width, giver % width]
            for i in range(left):
                row = queue[i] // width
                col = queue[i] % width
                if labels[row, col] < 0:
                    labels[row, col] = -labels[row, col]
                else:
                    queue[ring] = queue[i]
                    ring += 1
            left = ring
    return filled


def fill_holes(
    labels: NDArray[np.int32], leaves: NDArray[np.int32], surface_of: NDArray[np.int64], largest: int
) -> int:
    """Give unlabelled pixels that one surface surrounds the regions around them, in place.

    Parameters
    ----------
    labels, leaves : (H, W) int32
    surface_of : (N + 1,) int64, surface of each region
    largest : pixels of the largest hole (4-connected) that is filled; one at the rim of the image is none

    Returns
    -------
    int
        Number of filled pixels.
    """
    filled: int = _fill(
        labels, leaves, surface_of, largest, np.zeros(labels.shape, np.uint8), np.empty(labels.size, np.int64)
    )
    return filled


def treat_flying(
    signals: Signals, labels: NDArray[np.int32], leaves: NDArray[np.int32], models: Models, mode: str
) -> int:
    """Free flying pixels ("unassigned") or let their colours decide ("color"), in place.

    labels, leaves : (H, W) int32; models : of the regions; returns the number of flying pixels.
    """
    room = np.empty(labels.size, np.int64)
    lists: list[NDArray[np.int64]] = [room[:0]] * BANDS

    def list_band(i: int, first: int, last: int) -> None:
        queue = room[first * labels.shape[1] : last * labels.shape[1]]
        found = find_flying(
            signals.image, signals.flags, labels, models, signals.n_range, signals.law, first, last, queue
        )
        lists[i] = queue[:found]

    over_bands(len(labels), list_band)
    queue = np.concatenate(lists)
    end = len(queue)
    if mode == "unassigned":
        flying = queue[:end]
        labels.ravel()[flying] = 0
        leaves.ravel()[flying] = 0
    else:
        choose_by_color(
            signals.image,
            signals.flags,
            labels,
            leaves,
            models,
            signals.n_range,
            signals.color_eps2,
            queue,
            end,
        )
    return end
