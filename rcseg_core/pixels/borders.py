"""Borders where surfaces meet: on the curve in which their models intersect.

Boulanger, Osorio & Prieto (2005) recompute the boundaries of regions in this way. Near a crease both models
predict a pixel within its noise, so that a choice pixel by pixel is a matter of chance. The models know
better: they average thousands of pixels and cross along a sharp curve. Which side of it belongs to which
surface does not change along a ridge or a valley, and pixels a few steps away from the border are sure of
theirs: they vote.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.graph.components import mark_borders
from rcseg_core.graph.continuity import tangent
from rcseg_core.models.polynomials import Models, predict
from rcseg_core.signal.edges import DEPTH
from rcseg_core.signal.signals import COLOR_OUTLIER, RANGE_OUTLIER, Signals, local_scales
from rcseg_core.signal.units import UNIT_PX

#: Balance of the votes, as a share of them, below which it is unknown which side belongs to which surface.
LEAST_BALANCE = 0.5
#: A pixel stays when its own range speaks against the move by more than this, sigma^2.
VETO = 9.0
#: How well a crossing is placed at best: pixels have a size, and colour is registered to range no better.
BLUR_PX = 0.2
#: The colour of one pixel counts no more than this, sigma^2.
MAX_COLOR_COST = 16.0


class Pixels(NamedTuple):
    """What was measured, see `signals.Signals`."""

    image: NDArray[np.float32]
    flags: NDArray[np.uint8]
    law: NDArray[np.float64]
    n_range: int
    color_eps2: float


class Sides(NamedTuple):
    """The surfaces on both sides of the borders.

    surface_of : (N + 1,) int64, surface 1..S of each region, 0 for none
    models : of the surfaces (range)
    doubt : (S + 1,) float64, variance of the model of each surface, as a share of that of one pixel
    """

    surface_of: NDArray[np.int64]
    models: Models
    doubt: NDArray[np.float64]


class Votes(NamedTuple):
    """Which side of their intersection two surfaces a < b lie on, in an open-addressed hash table.

    keys : (size,) int64, a (S + 1) + b, or -1; size a power of two
    balance : (size,) float64, votes that each has the larger signal on its own side, minus votes against
    total : (size,) float64, number of votes
    """

    keys: NDArray[np.int64]
    balance: NDArray[np.float64]
    total: NDArray[np.float64]


@bare
def _slot(votes, sides, a, b):  # type: ignore[no-untyped-def]
    """Key of two surfaces, and its place in the table: where it is, or the free place where it belongs."""
    key = np.int64(min(a, b)) * sides.doubt.shape[0] + max(a, b)
    slot = (key * 0x9E3779B1) & (votes.keys.shape[0] - 1)
    while votes.keys[slot] != key and votes.keys[slot] >= 0:
        slot = (slot + 1) & (votes.keys.shape[0] - 1)
    return key, slot


@bare
def _crossing(sides, a, b, row, col, channel):  # type: ignore[no-untyped-def]
    """Signal of a minus signal of b at a pixel, its slope (a px), and the mean of the two signals."""
    value_a, x_a, y_a = tangent(sides.models, a, row, col, channel)
    value_b, x_b, y_b = tangent(sides.models, b, row, col, channel)
    difference = value_a - value_b
    slope = np.sqrt((x_a - x_b) ** 2 + (y_a - y_b) ** 2) / UNIT_PX
    return difference, slope, 0.5 * (value_a + value_b)


@bare
def _vote(labels, sides, channel, reach, row, col, down, right, slot, votes):  # type: ignore[no-untyped-def]
    """Votes of both sides of the border between a pixel and the one below or right of it."""
    height, width = labels.shape
    a = sides.surface_of[labels[row, col]]
    b = sides.surface_of[labels[row + down, col + right]]
    low = min(a, b)
    for side in range(2):
        step = reach + 2 if side == 1 else -reach - 1  # beyond what may lie on the wrong side
        r = row + down * step
        c = col + right * step
        own = b if side == 1 else a
        if r < 0 or c < 0 or r >= height or c >= width or sides.surface_of[labels[r, c]] != own:
            continue
        difference, slope, _ = _crossing(sides, low, max(a, b), r, c, channel)
        if abs(difference) < 2 * (reach + 1) * slope:
            votes.balance[slot] += 1.0 if (difference > 0.0) == (own == low) else -1.0
            votes.total[slot] += 1.0


@bare
def collect(labels, sides, channel, reach, queue, votes, marked):  # type: ignore[no-untyped-def]
    """Hold the votes, and list the pixels beside a border of two surfaces in queue[0] (flat indices).

    marked : (W,) bool, work. Returns their number, or -1 when the table of votes is too full.
    """
    height, width = labels.shape
    surface_of = sides.surface_of
    end = 0
    entries = 0
    for row in range(height):
        mark_borders(labels, row, marked)
        for col in range(width):
            if not marked[col]:
                continue
            k = labels[row, col]
            if surface_of[k] == 0:
                continue
            beside = False
            for d in range(4):
                r = row + (d == 1) - (d == 0)
                c = col + (d == 3) - (d == 2)
                if r < 0 or c < 0 or r >= height or c >= width:
                    continue
                b = surface_of[labels[r, c]]
                if b == 0 or b == surface_of[k]:
                    continue
                beside = True
                if d == 1 or d == 3:
                    key, slot = _slot(votes, sides, surface_of[k], b)
                    if votes.keys[slot] < 0:
                        votes.keys[slot] = key
                        entries += 1
                        if 2 * entries > votes.keys.shape[0]:
                            return -1
                    _vote(labels, sides, channel, reach, row, col, d == 1, d == 3, slot, votes)
            if beside:
                queue[0, end] = row * width + col
                end += 1
    return end


@bare
def _color_cost(pixels, models, k, row, col):  # type: ignore[no-untyped-def]
    """Squared residual of the colour of a pixel under region k, over its noise and half of the tolerance."""
    channels = pixels.image.shape[2] - pixels.n_range
    if channels == 0 or pixels.flags[row, col] & COLOR_OUTLIER != 0:
        return 0.0
    total = 0.0
    for c in range(pixels.n_range, pixels.n_range + channels):
        d = pixels.image[row, col, c] - predict(models, k, row, col, 1, c)
        total += d * d
    return min(total / (1.0 + 0.25 * pixels.color_eps2 / channels), MAX_COLOR_COST)


@bare
def _gain(pixels, labels, sides, regions, reach, votes, row, col, r, c):  # type: ignore[no-untyped-def]
    """What speaks for a pixel's move to the surface of a neighbour (sigma^2); not positive: it stays.

    The signed square of the models' difference over its variance, and the difference of the colour costs. The
    range of the pixel itself has only a veto: in the mean of all pixels, the models hold it already.
    """
    k = labels[row, col]
    m = labels[r, c]
    a = sides.surface_of[k]
    b = sides.surface_of[m]
    if b == 0 or b == a:
        return 0.0
    _, slot = _slot(votes, sides, a, b)
    if abs(votes.balance[slot]) < max(LEAST_BALANCE * votes.total[slot], 1.0):
        return 0.0
    channel = pixels.n_range - 1
    difference, slope, mean = _crossing(sides, a, b, row, col, channel)
    if abs(difference) > reach * slope:
        return 0.0
    var, _ = local_scales(pixels.law, mean)
    if pixels.flags[row, col] & RANGE_OUTLIER == 0:
        # residual of b squared minus residual of a squared
        own = pixels.image[row, col, channel] - mean
        if 2.0 * own * difference > VETO * var:
            return 0.0
    spread = var * (sides.doubt[a] + sides.doubt[b]) + (BLUR_PX * slope) ** 2
    gain = difference * abs(difference) / spread if spread > 0.0 else 0.0
    if votes.balance[slot] > 0.0:  # each has the larger signal on its own side
        gain = -gain
    return gain + _color_cost(pixels, regions, k, row, col) - _color_cost(pixels, regions, m, row, col)


@bare
def parts(values, value, key_of, row, col):  # type: ignore[no-untyped-def]
    """Yokoi's connectivity number (4-neighbours) of a pixel within the pixels with key_of[values] == value.

    At a pixel of the border: 0 where it is alone, 1 where it may go, more where it holds parts together.
    """
    height, width = values.shape
    ring = 0  # one bit a neighbour, clockwise from the one above
    for i in range(8):
        r = row + (3 <= i <= 5) - (i == 7 or i <= 1)
        c = col + (1 <= i <= 3) - (i >= 5)
        if r >= 0 and c >= 0 and r < height and c < width and key_of[values[r, c]] == value:
            ring |= 1 << i
    ring |= (ring & 1) << 8
    number = 0
    for i in range(0, 8, 2):
        number += ((ring >> i) & 1) - ((ring >> i) & 7 == 7)
    return number


@bare
def move(pixels, edges, labels, leaves, sides, regions, itself, reach, votes, queue, queued, end):  # type: ignore[no-untyped-def]
    """Pixels on the other side of an intersection join it: from the border outwards, a ring at a time.

    queue : (2, pixels) int64, the first `end` of its first row are the pixels to begin with; queued : (H, W)
    uint8 zeros, work; itself : (N + 1,) int64 0..N. No pixel goes that holds its region, or its surface,
    together. Returns the number of moved pixels.
    """
    height, width = labels.shape
    moved = 0
    for ring in range(reach):
        now = ring % 2
        following = 0
        for i in range(end):
            row = queue[now, i] // width
            col = queue[now, i] % width
            if edges[row, col] & DEPTH != 0:
                continue
            k = labels[row, col]
            best = np.int64(-1)
            best_gain = 0.0
            for d in range(4):
                r = row + (d == 1) - (d == 0)
                c = col + (d == 3) - (d == 2)
                if r < 0 or c < 0 or r >= height or c >= width or labels[r, c] == k:
                    continue
                gain = _gain(pixels, labels, sides, regions, reach, votes, row, col, r, c)
                if gain > best_gain:
                    best_gain = gain
                    best = r * width + c
            a = sides.surface_of[k]
            if (
                best < 0
                or parts(labels, k, itself, row, col) > 1
                or parts(labels, a, sides.surface_of, row, col) > 1
            ):
                continue
            labels[row, col] = labels[best // width, best % width]
            leaves[row, col] = leaves[best // width, best % width]
            moved += 1
            for d in range(4):
                r = row + (d == 1) - (d == 0)
                c = col + (d == 3) - (d == 2)
                if r < 0 or c < 0 or r >= height or c >= width:
                    continue
                if sides.surface_of[labels[r, c]] == a and queued[r, c] != ring + 1:
                    queued[r, c] = ring + 1
                    queue[1 - now, following] = r * width + c
                    following += 1
        end = following
    return moved


def sharpen(
    signals: Signals, edges: NDArray[np.uint8], labels: NDArray[np.int32], leaves: NDArray[np.int32],
    sides: Sides, regions: Models, reach: int,
) -> int:  # fmt: skip
    """Move the borders between surfaces, in place, to where their models intersect.

    Parameters
    ----------
    edges : (H, W) uint8 bit mask; nothing moves across a step of depth
    labels, leaves : (H, W) int32; a pixel takes both from the neighbour that it joins
    regions : models of the regions, for their colours
    reach : borders at most this far from an intersection move to it, px

    Returns
    -------
    int
        Number of moved pixels.
    """
    size = 1 << int(np.ceil(np.log2(16 * (sides.doubt.size + 16))))
    queue = np.empty((2, labels.size), np.int64)
    end, marked = -1, np.empty(labels.shape[1], np.bool_)
    while end < 0:
        votes = Votes(np.full(size, -1, np.int64), np.zeros(size), np.zeros(size))
        end = collect(labels, sides, signals.n_range - 1, reach, queue, votes, marked)
        size *= 2
    pixels = Pixels(signals.image, signals.flags, signals.law, signals.n_range, signals.color_eps2)
    itself, queued = np.arange(sides.surface_of.size), np.zeros(labels.shape, np.uint8)
    moved: int = move(pixels, edges, labels, leaves, sides, regions, itself, reach, votes, queue, queued, end)
    return moved
