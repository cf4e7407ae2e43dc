"""The region adjacency graph: which regions touch, along how many pixels, and how much of that crosses edges.

Regions are first spread over unassigned pixels by half of the allowed gap, so that an edge band or a missing
pixel does not part neighbours. A spreading pixel remembers which kinds of edge it came across.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.jit import kernel


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


@kernel
def spread(labels, edges, rounds, cells, met):  # type: ignore[no-untyped-def]
    """Grow labels into unassigned pixels for `rounds` steps (4-neighbours, breadth first, raster order).

    cells (H, W) int32 out: the grown labels; met (H, W) uint8 out: edge bits met on the way to each pixel.
    """
    height, width = labels.shape
    queue = np.empty((height * width, 2), np.int32)
    end = 0
    for row in range(height):
        for col in range(width):
            k = labels[row, col]
            cells[row, col] = k
            met[row, col] = edges[row, col]
            if k > 0:
                inside = (
                    (row == 0 or labels[row - 1, col] != 0)
                    and (row == height - 1 or labels[row + 1, col] != 0)
                    and (col == 0 or labels[row, col - 1] != 0)
                    and (col == width - 1 or labels[row, col + 1] != 0)
                )
                if not inside:
                    queue[end, 0] = row
                    queue[end, 1] = col
                    end += 1
    start = 0
    for _ in range(rounds):
        stop = end
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
        start = stop


@kernel
def touching(cells, met, count, keys, tally):  # type: ignore[no-untyped-def]
    """Count 4-neighbour pixel pairs of different cells by their two labels, in an open-addressed hash table.

    keys : (size,) int64 filled with -1, size a power of two; tally : (size, 3) float64 zeros: pixel pairs,
    those that met a range edge, those that met a colour edge. Returns the number of entries, or -1 when the
    table is too full.
    """
    height, width = cells.shape
    size = keys.shape[0]
    entries = 0
    for row in range(height):
        for col in range(width):
            a = cells[row, col]
            if a <= 0:
                continue
            for d in range(2):
                r = row + (d == 1)
                c = col + (d == 0)
                if r >= height or c >= width:
                    continue
                b = cells[r, c]
                if b <= 0 or b == a:
                    continue
                key = np.int64(min(a, b)) * (count + 1) + max(a, b)
                slot = (key * 0x9E3779B1) & (size - 1)
                while keys[slot] != key:
                    if keys[slot] < 0:
                        keys[slot] = key
                        entries += 1
                        if 2 * entries > size:
                            return -1
                        break
                    slot = (slot + 1) & (size - 1)
                bits = met[row, col] | met[r, c]
                tally[slot, 0] += 1.0
                tally[slot, 1] += (bits & 3) != 0
                tally[slot, 2] += (bits & 4) != 0
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
    cells, met = np.empty_like(labels), np.empty(labels.shape, np.uint8)
    spread(labels, edges, (max_gap + 1) // 2, cells, met)
    size = 1 << int(np.ceil(np.log2(16 * (count + 16))))
    entries = -1
    while entries < 0:
        keys, tally = np.full(size, -1, np.int64), np.zeros((size, 3))
        entries = touching(cells, met, count, keys, tally)
        size *= 2
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
