"""Parts of one curved surface that no polynomial joins: continuous in position and slope along their border.

A quartic follows a hemisphere to 2 % of its radius on the whole, but misses more at the limb, where the
surface turns away; slivers stay behind there. Where the models of a curved region and of a smaller neighbour
agree along the border, in position within the tolerance and in orientation, the two are one continuous
surface (the aim of section 2), and the smaller is taken in. Flat ones are left to the criterion of grouping,
which knows how much a sensor bends planes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.graph.adjacency import Pairs
from rcseg_core.graph.components import mark_borders
from rcseg_core.graph.grouping import Grouped
from rcseg_core.models.polynomials import Models
from rcseg_core.signal.signals import Signals, local_scales
from rcseg_core.signal.units import UNIT_PX

#: Largest mean angle between the two surfaces along the border.
MAX_ANGLE_RAD = np.deg2rad(25.0)
#: Only a neighbour of at most this share of the pixels is taken in.
MAX_SHARE = 0.5
#: A sliver is too narrow for a sure slope of its own: its border must be free of edges and near in position.
MAX_SLIVER_CROSSED, MAX_SLIVER_DISTANCE2, MAX_SLIVER_ANGLE_RAD = 0.3, 2.5, np.deg2rad(60.0)
#: Pixels for each pixel of common border; the cap of a cylinder is wider.
MAX_SLIVER_WIDTH_PX = 3.5


@bare
def tangent(models, k, row, col, c):  # type: ignore[no-untyped-def]
    """Range channel c of region k at a pixel, and its derivatives along x and y (whitened, per UNIT_PX)."""
    degree = models.degree[k, 0]
    x = (col - models.center[k, 0]) / UNIT_PX
    y = (row - models.center[k, 1]) / UNIT_PX
    value = along_x = along_y = 0.0
    for a in range(degree, -1, -1):
        part = part_y = 0.0
        for b in range(degree, -1, -1):
            part_y = part_y * y + part
            part = part * y + models.coef[k, c, a, b]
        along_x = along_x * x + value
        value = value * x + part
        along_y = along_y * x + part_y
    return value, along_x, along_y


@bare
def _place(keys, key):  # type: ignore[no-untyped-def]
    """Place of a key among sorted ones, or -1."""
    low = 0
    high = keys.shape[0]
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low if low < keys.shape[0] and keys[low] == key else -1


@bare
def _border(labels, keys, models, c, law, slope, marked, out):  # type: ignore[no-untyped-def]
    """Sums over the border of each pair: squared distance over tolerance, angle, pixel pairs; out (E, 3).

    keys : (E,) int64, sorted, lower label * N + higher label of each pair, N = labels of the models
    marked : (W,) bool, work
    """
    count = models.degree.shape[0]
    height, width = labels.shape
    for row in range(height):
        mark_borders(labels, row, marked)
        for col in range(width):
            i = labels[row, col]
            if i <= 0 or not marked[col]:
                continue
            for d in range(2):
                r = row + (d == 1)
                cc = col + (d == 0)
                if r >= height or cc >= width:
                    continue
                j = labels[r, cc]
                if j <= 0 or j == i:
                    continue
                pair = _place(keys, np.int64(min(i, j)) * count + max(i, j))
                if pair < 0:
                    continue
                y = 0.5 * (row + r)
                x = 0.5 * (col + cc)
                value_i, x_i, y_i = tangent(models, i, y, x, c)
                value_j, x_j, y_j = tangent(models, j, y, x, c)
                flat = slope[0] + slope[1] * 0.5 * (value_i + value_j)
                x_i /= flat
                y_i /= flat
                x_j /= flat
                y_j /= flat
                steep_i = 1.0 + x_i * x_i + y_i * y_i
                steep_j = 1.0 + x_j * x_j + y_j * y_j
                cosine = (1.0 + x_i * x_j + y_i * y_j) / np.sqrt(steep_i * steep_j)
                var, eps2 = local_scales(law, 0.5 * (value_i + value_j))
                distance2 = (value_i - value_j) ** 2 / np.sqrt(steep_i * steep_j)
                out[pair, 0] += distance2 / (var + eps2)
                out[pair, 1] += np.arccos(min(max(cosine, -1.0), 1.0))
                out[pair, 2] += 1.0


def continuous_pairs(
    labels: NDArray[np.int32], signals: Signals, models: Models, pairs: Pairs, curved: NDArray[np.bool_],
    sizes: NDArray[np.int64], sliver_px: float,
) -> Grouped:  # fmt: skip
    """The groupings that continuity asks for, the smoothest first; each region is taken in at most once.

    Parameters
    ----------
    labels : (H, W) int32; models : fitted to its regions
    curved : (N + 1,) bool, regions whose relief exceeds the tolerance
    sizes : (N + 1,) int64, pixels of each region
    sliver_px : smaller neighbours are judged by their position alone
    """
    count = models.degree.shape[0] - 1
    a, b = pairs.nodes.T
    big = np.where(sizes[a] >= sizes[b], a, b)
    small = a + b - big
    # only pairs in question are looked at
    crossed = pairs.range_crossed / pairs.boundary
    rows = np.nonzero(curved[big] & (sizes[small] <= MAX_SHARE * sizes[big]))[0]
    merges: list[tuple[int, int]] = []
    if rows.size:
        keys = a[rows] * (count + 1) + b[rows]
        rows, keys = rows[np.argsort(keys)], np.sort(keys)
        sums = np.zeros((rows.size, 3))
        marked = np.empty(labels.shape[1], np.bool_)
        _border(labels, keys, models, signals.n_range - 1, signals.law, signals.slope, marked, sums)
        with np.errstate(invalid="ignore", divide="ignore"):
            distance2, angle = sums[:, 0] / sums[:, 2], sums[:, 1] / sums[:, 2]
            width = sizes[small[rows]] / sums[:, 2]
        sliver = (sizes[small[rows]] < sliver_px) & (width <= MAX_SLIVER_WIDTH_PX)
        sliver &= (crossed[rows] <= MAX_SLIVER_CROSSED) & (angle <= MAX_SLIVER_ANGLE_RAD)
        near = distance2 <= np.where(sliver, MAX_SLIVER_DISTANCE2, 1.0)
        smooth = np.nonzero(near & (sliver | (angle <= MAX_ANGLE_RAD)))[0]
        taken = np.zeros(count + 1, np.bool_)
        for p in smooth[np.argsort(angle[smooth], kind="stable")]:
            keep, gone = int(big[rows[p]]), int(small[rows[p]])
            if not taken[gone] and not taken[keep]:
                merges.append((keep, gone))
                taken[gone] = True
    return Grouped(np.array(merges, np.int64).reshape(-1, 2), np.ones(len(merges)), int(rows.size))
