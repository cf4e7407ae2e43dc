"""The region adjacency graph: which regions touch, along how many pixels, and how much of that crosses edges.

Regions are first spread over unassigned pixels by half of the allowed gap, so that an edge band or a missing pixel
does not part neighbours. A spreading pixel remembers which kinds of edge it came across.
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
def touching(cells, met, keys, bits, count):  # type: ignore[no-untyped-def]
    """List every 4-neighbour pixel pair of different cells as key = low * (count + 1) + high; returns how many."""
    height, width = cells.shape
    n = 0
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
                keys[n] = np.int64(min(a, b)) * (count + 1) + max(a, b)
                bits[n] = met[row, col] | met[r, c]
                n += 1
    return n


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
    keys = np.empty(2 * labels.size, np.int64)
    bits = np.empty(2 * labels.size, np.uint8)
    n = touching(cells, met, keys, bits, count)
    keys, inverse = np.unique(keys[:n], return_inverse=True)
    bits = bits[:n]
    size = keys.size
    pairs = Pairs(
        np.stack([keys // (count + 1), keys % (count + 1)], 1),
        np.bincount(inverse, minlength=size).astype(np.float64),
        np.bincount(inverse, (bits & 3) != 0, minlength=size).astype(np.float64),
        np.bincount(inverse, (bits & 4) != 0, minlength=size).astype(np.float64),
    )
    if group is None:
        return pairs
    same = group[pairs.nodes[:, 0]] == group[pairs.nodes[:, 1]]
    return Pairs(*(a[same] for a in pairs))
