"""Narrow regions along a crease that are not there: windows which straddled it and hang together.

Such a chamfer is off both of the surfaces that meet there by a sigma or two, too far to be absorbed whole by
either. But together they explain it: every pixel is near one of the two. So a small region has to pay for its
coefficients (Schwarz 1978, in independent pixels): it stays only where it explains its pixels by so much
better than the best of its larger neighbours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.compute.parallel import BANDS, over_bands
from rcseg_core.graph.adjacency import Pairs
from rcseg_core.models.polynomials import Models, predict
from rcseg_core.partition.partition import Partition
from rcseg_core.signal.signals import INVALID, MISFIT, RANGE_OUTLIER, Signals, scales

#: Neighbours that are looked at, and how many times larger they are.
NEIGHBORS, LARGER = 6, 2


@bare
def _explain(labels, image, flags, n_range, models, slot, neighbors, first, last, out):  # type: ignore[no-untyped-def]
    """Sums over each region in question: pixels, squared misses of its own model and of the best neighbour.

    slot : (N + 1,) row of `out` (E, 3), -1 for regions not in question; neighbors : (E, M) labels, 0 for none
    """
    for row in range(first, last):
        for col in range(labels.shape[1]):
            k = labels[row, col]
            at = slot[k]
            if at < 0 or flags[row, col] & (INVALID | RANGE_OUTLIER | MISFIT) != 0:
                continue
            least = np.inf
            for m in range(-1, neighbors.shape[1]):
                other = k if m < 0 else neighbors[at, m]
                if other == 0:
                    break
                total = 0.0
                for c in range(n_range):
                    d = image[row, col, c] - predict(models, other, row, col, 0, c)
                    total += d * d
                if m < 0:
                    out[at, 1] += total
                else:
                    least = min(least, total)
            out[at, 0] += 1.0
            out[at, 2] += least


def larger_neighbors(
    sizes: NDArray[np.int64], small: NDArray[np.int64], pairs: Pairs
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Row of each label in the table, -1 for none, and the table (E, NEIGHBORS) of larger neighbours."""
    slot = np.full(sizes.size, -1, np.int64)
    slot[small] = np.arange(small.size)
    table = np.zeros((small.size, NEIGHBORS), np.int64)
    a, b = np.concatenate([pairs.nodes, pairs.nodes[:, ::-1]]).T
    wanted = (slot[a] >= 0) & (sizes[b] > LARGER * sizes[a])
    filled = np.zeros(small.size, np.int64)
    for k, other in zip(a[wanted], b[wanted], strict=True):
        at = slot[k]
        if filled[at] < NEIGHBORS:
            table[at, filled[at]] = other
            filled[at] += 1
    return slot, table


def dissolve_chamfers(partition: Partition, signals: Signals, models: Models, pairs: Pairs, most: int) -> int:
    """Free the pixels of small regions which the surfaces that meet there explain as well.

    models, pairs : of the current regions; most : only smaller regions are looked at, px
    Returns how many regions were dissolved.
    """
    sizes = partition.sizes()
    sizes[0] = 0
    small = np.nonzero((sizes > 0) & (sizes < most))[0]
    slot, neighbors = larger_neighbors(sizes, small, pairs)
    tables = np.zeros((BANDS, small.size, 3))
    over_bands(
        len(partition.labels),
        lambda i, first, last: _explain(
            partition.labels, signals.image, signals.flags, signals.n_range, models, slot, neighbors, first,
            last, tables[i],
        ),
    )  # fmt: skip
    sums = tables.sum(axis=0)
    keep = np.ones(sizes.size, np.bool_)
    variances = scales(signals.law, models.coef[small, 0, 0, 0])[0]
    for k, (n, own, others), var in zip(small, sums, variances, strict=True):
        if n == 0 or not others < np.inf:
            continue
        independent = max(n / signals.noise.range_correlation, 1.0)
        coefficients = (models.degree[k, 0] + 1) ** 2 * signals.n_range
        keep[k] = (others - own) * independent / (n * var) > coefficients * np.log(max(independent, np.e))
    if not keep.all():
        partition.free(keep)
    return int(np.count_nonzero(~keep))
