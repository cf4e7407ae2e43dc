"""The region adjacency graph: which regions touch, along how many pixels, and how much of that crosses edges.

Regions are first spread over unassigned pixels by half of the allowed gap, so that an edge band or a missing
pixel does not part neighbours. A spreading pixel remembers which kinds of edge it came across.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.compute.parallel import BANDS, over_bands
from rcseg_core.graph.components import mark_borders


class Pairs(NamedTuple):
    """E adjacent pairs, sorted.

    nodes : (E, 2) int64, lower id first; boundary : (E,) float64 number of touching pixel pairs;
    range_crossed, color_crossed : (E,) float64, those of them that meet a range or a colour edge
    """

    nodes: NDArray[np.int64]
    boundary: NDArray[np.float64]
    range_crossed: NDArray[np.float64]
    color_crossed: NDArray[np.float64]

    def relabelled(self, mapping: NDArray[np.int32]) -> Pairs:
        """The pairs after regions were joined or freed (0 in `mapping`); parallel pairs add up."""
        nodes = np.sort(mapping[self.nodes], axis=1).astype(np.int64)
        kept = (nodes[:, 0] != nodes[:, 1]) & (nodes[:, 0] > 0)
        size = int(mapping.max()) + 1
        keys, inverse = np.unique(nodes[kept, 0] * size + nodes[kept, 1], return_inverse=True)
        weights = (self.boundary, self.range_crossed, self.color_crossed)
        sums = (np.bincount(inverse, a[kept], minlength=keys.size).astype(np.float64) for a in weights)
        return Pairs(np.stack([keys // size, keys % size], 1), *sums)


@bare
def _front(labels, edges, first, last, cells, met, queue):  # type: ignore[no-untyped-def]
    """Copy rows and list their labelled pixels that have an unlabelled neighbour; returns how many."""
    height, width = labels.shape
    end = 0
    for row in range(first, last):
        above = max(row - 1, 0)
        below = min(row + 1, height - 1)
        free = 0
        for col in range(width):
            cells[row, col] = labels[row, col]
            met[row, col] = edges[row, col]
            free |= (labels[above, col] == 0) | (labels[row, col] == 0) | (labels[below, col] == 0)
        if free == 0:  # nothing to spread to
            continue
        for col in range(width):
            if labels[row, col] > 0 and (
                labels[above, col] == 0
                or labels[below, col] == 0
                or labels[row, max(col - 1, 0)] == 0
                or labels[row, min(col + 1, width - 1)] == 0
            ):
                queue[end, 0] = row
                queue[end, 1] = col
                end += 1
    return end


@bare
def _advance(cells, met, queue, start, stop):  # type: ignore[no-untyped-def]
    """The pixels in queue[start:stop] take their unlabelled neighbours, which join the queue; its new end."""
    height, width = cells.shape
    end = stop
    for i in range(start, stop):
        row = queue[i, 0]
        col = queue[i, 1]
        for d in range(4):
            r = row + (d == 1) - (d == 0)
            c = col + (d == 3) - (d == 2)
            if r < 0 or c < 0 or r >= height or c >= width or cells[r, c] != 0:
                continue
            cells[r, c] = cells[row, col]
            met[r, c] |= met[row, col]
            queue[end, 0] = r
            queue[end, 1] = c
            end += 1
    return end


def spread(
    labels: NDArray[np.int32], edges: NDArray[np.uint8], rounds: int
) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
    """Labels grown into unassigned pixels for `rounds` steps (4-neighbours, breadth first, raster order).

    Returns the grown labels (H, W) int32, and (H, W) uint8 the edge bits met on the way to each pixel.
    """
    cells, met = np.empty_like(labels), np.empty(labels.shape, np.uint8)
    queue = np.empty((labels.size, 2), np.int32)
    lists: list[NDArray[np.int32]] = [queue[:0]] * BANDS

    def list_band(i: int, first: int, last: int) -> None:
        room = queue[first * labels.shape[1] : last * labels.shape[1]]
        lists[i] = room[: _front(labels, edges, first, last, cells, met, room)]

    over_bands(labels.shape[0], list_band)
    end = 0
    for front in lists:  # close up; the queue is read in raster order
        queue[end : end + len(front)] = front
        end += len(front)
    start = 0
    for _ in range(rounds):
        start, end = end, _advance(cells, met, queue, start, end)
    return cells, met


@bare
def enter(keys, tally, key, count, range_met, color_met):  # type: ignore[no-untyped-def]
    """Add to the entry of `key`; returns whether it is a new one."""
    mask = keys.shape[0] - 1
    slot = (key * 0x9E3779B1) & mask
    while keys[slot] != key:
        if keys[slot] < 0:
            keys[slot] = key
            tally[slot, 0] = count
            tally[slot, 1] = range_met
            tally[slot, 2] = color_met
            return True
        slot = (slot + 1) & mask
    tally[slot, 0] += count
    tally[slot, 1] += range_met
    tally[slot, 2] += color_met
    return False


@bare
def touching(cells, met, first, last, count, keys, tally, marked):  # type: ignore[no-untyped-def]
    """Count 4-neighbour pixel pairs of different cells by their two labels, in an open-addressed hash table.

    first, last : rows of the upper or left pixel of each pair
    keys : (size,) int64 filled with -1, size a power of two; tally : (size, 3) float64: pixel pairs,
    those that met a range edge, those that met a colour edge; marked : (W,) bool, work. Returns the number of
    entries, or -1 when the table is too full.
    """
    height, width = cells.shape
    entries = 0
    for row in range(first, last):
        below = min(row + 1, height - 1)
        mark_borders(cells, row, marked)
        for col in range(width):
            if not marked[col]:
                continue
            a = cells[row, col]
            right = cells[row, min(col + 1, width - 1)]
            under = cells[below, col]
            if a <= 0 or (right == a and under == a):
                continue
            for d in range(2):
                b = right if d == 0 else under
                if b <= 0 or b == a:
                    continue
                bits = met[row, col] | (met[row, col + 1] if d == 0 else met[below, col])
                key = np.int64(min(a, b)) * (count + 1) + max(a, b)
                if enter(keys, tally, key, 1.0, (bits & 3) != 0, (bits & 4) != 0):
                    entries += 1
                    if 2 * entries > keys.shape[0]:
                        return -1
    return entries


@bare
def _join_tables(keys, tally, more_keys, more_tally, entries):  # type: ignore[no-untyped-def]
    """Enter one table into another; returns its number of entries, or -1 when it is too full."""
    for slot in range(more_keys.shape[0]):
        if more_keys[slot] >= 0:
            t = more_tally[slot]
            entries += enter(keys, tally, more_keys[slot], t[0], t[1], t[2])
            if 2 * entries > keys.shape[0]:
                return -1
    return entries


def find_pairs(
    labels: NDArray[np.int32], count: int, edges: NDArray[np.uint8], max_gap: int,
    group: NDArray[np.int64] | None = None,
) -> Pairs:  # fmt: skip
    """Adjacent pairs of regions 1..count at most `max_gap` pixels apart.

    Parameters
    ----------
    labels : (H, W) int32; edges : (H, W) uint8 bit mask (depth 1, orientation 2, colour 4)
    group : (count + 1,) int64, optional; only pairs of one group are listed
    """
    cells, met = spread(labels, edges, (max_gap + 1) // 2)
    size = 1 << int(np.ceil(np.log2(4 * (count + 64))))
    while (table := _count_pairs(cells, met, count, size)) is None:
        size *= 2
    keys, tally = table
    used = np.nonzero(keys >= 0)[0]
    used = used[np.argsort(keys[used])]
    keys = keys[used]
    pairs = Pairs(
        np.stack([keys // (count + 1), keys % (count + 1)], 1),
        *np.ascontiguousarray(tally[used].T),
    )
    if group is None:
        return pairs
    same = group[pairs.nodes[:, 0]] == group[pairs.nodes[:, 1]]
    return Pairs(*(a[same] for a in pairs))


def _count_pairs(
    cells: NDArray[np.int32], met: NDArray[np.uint8], count: int, size: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]] | None:
    """The hash table of `touching` for the whole image; None where `size` is too small."""
    keys, tally = np.full((BANDS, size), -1, np.int64), np.empty((BANDS, size, 3))
    entries = [0] * BANDS

    def count_band(i: int, first: int, last: int) -> None:
        marked = np.empty(cells.shape[1], np.bool_)
        entries[i] = touching(cells, met, first, last, count, keys[i], tally[i], marked)

    over_bands(cells.shape[0], count_band)
    total = entries[0]
    for i in range(1, BANDS):
        if min(total, entries[i]) < 0:
            return None
        total = _join_tables(keys[0], tally[0], keys[i], tally[i], total)
    return (keys[0], tally[0]) if total >= 0 else None
