"""Labels of an image: connected parts numbered in raster order, and numbers by size."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.signal.signals import INVALID


@bare
def mark_borders(labels, row, marked):  # type: ignore[no-untyped-def]
    """marked[col] = whether a pixel of a row has another label beside it (4-neighbours), always at both ends.

    Several columns at once: most pixels lie inside of their region, and to pass over them is most of the time
    of what looks at borders only. marked : (W,) bool
    """
    width = labels.shape[1]
    here, over, under = labels[row], labels[max(row - 1, 0)], labels[min(row + 1, labels.shape[0] - 1)]
    for col in range(1, width - 1):
        k = here[col]
        marked[col] = (over[col] != k) | (under[col] != k) | (here[col - 1] != k) | (here[col + 1] != k)
    marked[0] = True
    marked[width - 1] = True


@bare
def _count(labels, flags, total):  # type: ignore[no-untyped-def]
    for row in range(labels.shape[0]):
        found = 0
        for col in range(labels.shape[1]):
            found += (labels[row, col] == 0) & (flags[row, col] & INVALID == 0)
        total[0] += found


def count_unassigned(labels: NDArray[np.int32], flags: NDArray[np.uint8]) -> int:
    """Measured pixels without a region."""
    total = np.zeros(1, np.int64)
    _count(labels, flags, total)
    return int(total[0])


@bare
def _flood(labels, leaves, flags, within, least, first_label, first_leaf, queue):  # type: ignore[no-untyped-def]
    """`label_parts` with scratch: queue (unassigned pixels,) int64."""
    height, width = labels.shape
    bounded = within.shape[0] == height
    found = 0
    end = 0
    for row in range(height):
        for col in range(width):
            if labels[row, col] != 0 or flags[row, col] & INVALID != 0:
                continue
            start = end
            queue[end] = row * width + col
            end += 1
            labels[row, col] = -1
            at = start
            while at < end:
                y = queue[at] // width
                x = queue[at] - y * width
                at += 1
                for d in range(4):
                    r = y + (d == 1) - (d == 0)
                    c = x + (d == 3) - (d == 2)
                    if r < 0 or c < 0 or r >= height or c >= width:
                        continue
                    if labels[r, c] != 0 or flags[r, c] & INVALID != 0:
                        continue
                    if bounded and within[r, c] != within[y, x]:
                        continue
                    labels[r, c] = -1
                    queue[end] = r * width + c
                    end += 1
            if end - start >= least:
                for i in range(start, end):
                    y = queue[i] // width
                    x = queue[i] - y * width
                    labels[y, x] = first_label + found
                    leaves[y, x] = first_leaf + found
                found += 1
    for i in range(end):
        y = queue[i] // width
        x = queue[i] - y * width
        labels[y, x] = max(labels[y, x], 0)
    return found


def label_parts(
    labels: NDArray[np.int32], leaves: NDArray[np.int32], flags: NDArray[np.uint8],
    within: NDArray[np.int32] | None, least: int, first_label: int, first_leaf: int,
) -> int:  # fmt: skip
    """Number the 4-connected parts of at least `least` unassigned pixels, in place; returns how many.

    Parameters
    ----------
    labels, leaves : (H, W) int32, 0 unassigned; parts get first_label, first_label + 1, ... and so on
    flags : (H, W) uint8, INVALID where a pixel takes no part
    within : (H, W) int32, optional; a part keeps to one value of it
    """
    room = count_unassigned(labels, flags)
    if room == 0:
        return 0
    bounds = np.zeros((1, 1), np.int32) if within is None else within
    found: int = _flood(
        labels, leaves, flags, bounds, least, first_label, first_leaf, np.empty(room, np.int64)
    )
    return found


def by_size(sizes: NDArray[np.number]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Labels 0..N numbered anew from the largest down (ties by label), empty ones left out; 0 stays 0.

    Returns the old label of each new one, and (N + 1,) the new label of each old one, 0 for empty ones.
    """
    order = np.argsort(-sizes[1:], kind="stable") + 1
    order = np.concatenate([[0], order[sizes[order] > 0]])
    number = np.zeros(sizes.size, np.int32)
    number[order] = np.arange(order.size)
    return order, number
