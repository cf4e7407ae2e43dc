"""Steps 3, 4 and 6: best-first grouping of adjacent regions until the best one exceeds the limit (section 6).

A heap holds every allowed pair; the best is merged, its moments added, and the pairs around it compared
again. Entries made stale by a merge are left in the heap and skipped when they surface (lazy invalidation);
a pair whose regions have grown since it was compared is compared once more before it is merged.
Ties are broken by (value, lower id, higher id): a frame always gives the same labels. No pixel is touched.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.inline import inlined
from rcseg_core.compute.jit import bare
from rcseg_core.decision.evidence import Work, compare, compare_planes, make_work, move, own_residuals
from rcseg_core.decision.rule import BOUNDED, CHOW, Rule
from rcseg_core.graph.adjacency import Pairs
from rcseg_core.graph.links import make_graph, merge_edges
from rcseg_core.models.moments import Moments
from rcseg_core.models.planes import Planes, add_planes, center_planes

#: All pairs of a region are compared again once it has grown by this; until then those of the smaller side,
#: and the others when their turn comes.
GROWTH = 1.3


class Heap(NamedTuple):
    """A binary heap of pairs, smallest (value, pair) on top; pair = lower id * (N + 1) + higher id for ties.

    value : (n,) float64; pair, edge, version : (n,) int64
    """

    value: NDArray[np.float64]
    pair: NDArray[np.int64]
    edge: NDArray[np.int64]
    version: NDArray[np.int64]


@inlined
def _set(heap, at, value, pair, edge, version):  # type: ignore[no-untyped-def]
    heap.value[at] = value
    heap.pair[at] = pair
    heap.edge[at] = edge
    heap.version[at] = version


@inlined
def _copy_entry(heap, to, source):  # type: ignore[no-untyped-def]
    _set(heap, to, heap.value[source], heap.pair[source], heap.edge[source], heap.version[source])


@inlined
def _sift_up(heap, at, value, pair, edge, version):  # type: ignore[no-untyped-def]
    """Put an entry at the hole `at`, or where it belongs above."""
    while at > 0:
        up = (at - 1) // 2
        if value > heap.value[up] or (value == heap.value[up] and pair >= heap.pair[up]):
            break
        _copy_entry(heap, at, up)
        at = up
    _set(heap, at, value, pair, edge, version)


@inlined
def _sift_down(heap, at, size, value, pair, edge, version):  # type: ignore[no-untyped-def]
    """Put an entry at the hole `at`, or where it belongs below."""
    while True:
        child = 2 * at + 1
        if child >= size:
            break
        if child + 1 < size and (
            heap.value[child + 1] < heap.value[child]
            or (heap.value[child + 1] == heap.value[child] and heap.pair[child + 1] < heap.pair[child])
        ):
            child += 1
        if value < heap.value[child] or (value == heap.value[child] and pair <= heap.pair[child]):
            break
        _copy_entry(heap, at, child)
        at = child
    _set(heap, at, value, pair, edge, version)


@bare
def _drop_stale(heap, size, alive, version):  # type: ignore[no-untyped-def]
    """Keep only entries that still hold, in heap order; returns how many."""
    kept = 0
    for at in range(size):
        edge = heap.edge[at]
        if alive[edge] and version[edge] == heap.version[at]:
            _sift_up(heap, kept, heap.value[at], heap.pair[at], edge, heap.version[at])
            kept += 1
    return kept


class Held(NamedTuple):
    """What was decided before, of which a decision near the limit keeps.

    names : (N + 1,) int64, what each region was part of; 0: not known
    favour : 1 or more; pairs of one name are measured this many times better, those of two as many worse
    """

    names: NDArray[np.int64]
    favour: float


class State(NamedTuple):
    """What grouping changes, besides the graph.

    held : see `Held`; a region that grows keeps the name of its larger part
    moments : sums of the regions; planes : the same centred, used alone while `flat`; own : (N, 5) see
    `own_residuals`; boxes : (N, 4); rule, work : see `evidence`; shape (6,), signal (C, 5) : scratch
    """

    flat: bool
    held: Held
    moments: Moments
    planes: Planes
    own: NDArray[np.float64]
    boxes: NDArray[np.int64]
    rule: Rule
    work: Work
    shape: NDArray[np.float64]
    signal: NDArray[np.float64]


@inlined
def _size(state, k):  # type: ignore[no-untyped-def]
    return state.planes.shape[k, 0] if state.flat else state.moments.power[k, 0, 0]


@inlined
def _evaluate(graph, edge, state, gated, limit, heap, size):  # type: ignore[no-untyped-def]
    """Compare the ends of an edge; push the pair if it is allowed. Returns the size of the heap."""
    graph.version[edge] += 1
    i = graph.ends[edge, 0]
    j = graph.ends[edge, 1]
    graph.pixels[edge] = _size(state, i) + _size(state, j)
    gate_r = 1.0
    gate_c = 1.0
    if gated:
        gate_r -= graph.range_crossed[edge] / graph.boundary[edge]
        gate_c -= graph.color_crossed[edge] / graph.boundary[edge]
    first, second = state.held.names[i], state.held.names[j]
    favour = 1.0
    if first > 0 and second > 0:
        favour = state.held.favour if first == second else 1.0 / state.held.favour
    if state.flat:
        value, height, allowed = compare_planes(
            state.planes, i, j, state.rule, gate_r, gate_c, favour, state.shape, state.signal
        )
    else:
        value, height, allowed = compare(
            state.moments, i, j, state.rule, state.own, state.boxes, gate_r, gate_c, favour, state.work
        )
    if allowed or height <= limit:
        graph.height[edge] = height
        if size == heap.value.shape[0]:
            size = _drop_stale(heap, size, graph.alive, graph.version)
        pair = min(i, j) * state.boxes.shape[0] + max(i, j)
        _sift_up(heap, size, value, pair, edge, graph.version[edge])
        size += 1
    return size


@bare
def _absorb_moments(moments, big, small, work):  # type: ignore[no-untyped-def]
    """Add the sums of `small` to those of `big`, about the centre of `big`."""
    move(moments, small, moments.center[big, 0], moments.center[big, 1], work, work.power, work.cross)
    for a in range(work.power.shape[0]):
        for b in range(work.power.shape[1]):
            moments.power[big, a, b] += work.power[a, b]
    for c in range(work.cross.shape[0]):
        moments.energy[big, c] += moments.energy[small, c]
        for a in range(work.cross.shape[1]):
            for b in range(work.cross.shape[2]):
                moments.cross[big, c, a, b] += work.cross[c, a, b]


@bare
def _recenter(moments, k, box, work):  # type: ignore[no-untyped-def]
    """Move the origin back to the middle of the box once it is off by more than a quarter of its size."""
    x = 0.5 * (box[1] + box[3])
    y = 0.5 * (box[0] + box[2])
    off_x = abs(moments.center[k, 0] - x)
    off_y = abs(moments.center[k, 1] - y)
    if off_x > 0.25 * (box[3] - box[1]) + 1.0 or off_y > 0.25 * (box[2] - box[0]) + 1.0:
        move(moments, k, x, y, work, work.power, work.cross)
        for a in range(work.power.shape[0]):
            for b in range(work.power.shape[1]):
                moments.power[k, a, b] = work.power[a, b]
        for c in range(work.cross.shape[0]):
            for a in range(work.cross.shape[1]):
                for b in range(work.cross.shape[2]):
                    moments.cross[k, c, a, b] = work.cross[c, a, b]
        moments.center[k, 0] = x
        moments.center[k, 1] = y


@bare
def _join(keep, gone, state):  # type: ignore[no-untyped-def]
    """Region `keep` takes in `gone`: moments, box, the higher degree of the two; its residuals anew."""
    boxes = state.boxes
    boxes[keep, 0] = min(boxes[keep, 0], boxes[gone, 0])
    boxes[keep, 1] = min(boxes[keep, 1], boxes[gone, 1])
    boxes[keep, 2] = max(boxes[keep, 2], boxes[gone, 2])
    boxes[keep, 3] = max(boxes[keep, 3], boxes[gone, 3])
    names = state.held.names
    if names[keep] == 0:
        names[keep] = names[gone]
    if state.flat:
        add_planes(state.planes, keep, gone, state.shape, state.signal)
        return
    _absorb_moments(state.moments, keep, gone, state.work)
    _recenter(state.moments, keep, boxes[keep], state.work)
    degree = state.rule.degree
    for modality in range(2):
        degree[keep, modality] = max(degree[keep, modality], degree[gone, modality])
    state.rule.settled[keep] = degree[keep, 0]
    own_residuals(state.moments, keep, state.rule, state.work, state.own[keep])


@bare
def _run(graph, state, scratch, gated, limit, merges, heights):  # type: ignore[no-untyped-def]
    """Best-first loop. Fills merges (kept, gone) and heights; returns how many, and the comparisons made."""
    count = state.boxes.shape[0] - 1
    edges = graph.ends.shape[0]
    full_at = scratch.full_at
    heap = scratch.heap
    fresh = scratch.fresh
    for k in range(1, count + 1):
        full_at[k] = _size(state, k)
        if not state.flat:
            own_residuals(state.moments, k, state.rule, state.work, state.own[k])
    for edge in range(edges):
        fresh[edge] = edge
    fresh_count = edges
    comparisons = 0
    merged = 0
    size = 0
    while fresh_count > 0:
        for at in range(fresh_count):
            size = _evaluate(graph, fresh[at], state, gated, limit, heap, size)
        comparisons += fresh_count
        fresh_count = 0
        while size > 0 and fresh_count == 0:
            edge = heap.edge[0]
            current = graph.alive[edge] and graph.version[edge] == heap.version[0]
            size -= 1
            _sift_down(heap, 0, size, heap.value[size], heap.pair[size], heap.edge[size], heap.version[size])
            if not current:
                continue
            i = graph.ends[edge, 0]
            j = graph.ends[edge, 1]
            n_i = _size(state, i)
            n_j = _size(state, j)
            if n_i + n_j != graph.pixels[edge]:
                fresh[0] = edge
                fresh_count = 1
                continue
            keep, gone = (i, j) if n_i > n_j or (n_i == n_j and i < j) else (j, i)
            merges[merged, 0] = keep
            merges[merged, 1] = gone
            heights[merged] = graph.height[edge]
            merged += 1
            _join(keep, gone, state)
            fresh_count = merge_edges(graph, keep, gone, fresh)
            grown = _size(state, keep)
            if grown >= GROWTH * full_at[keep]:
                full_at[keep] = grown
                fresh_count = 0
                half = graph.first[keep]
                while half >= 0:
                    if graph.alive[half // 2]:
                        fresh[fresh_count] = half // 2
                        fresh_count += 1
                    half = graph.following[half]
    return merged, comparisons


class Scratch(NamedTuple):
    """Arrays of the loop: the heap, edges to compare anew, size of each region when last compared in full."""

    heap: Heap
    fresh: NDArray[np.int64]
    full_at: NDArray[np.float64]


def make_scratch(edges: int, count: int) -> Scratch:
    """Arrays for `_run`. One entry of an edge holds; the others are stale and dropped when room is short."""
    room = 4 * edges + 64
    heap = Heap(np.empty(room), np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room, np.int64))
    return Scratch(heap, np.empty(max(edges, 1), np.int64), np.empty(count + 1))


class Grouped(NamedTuple):
    """What a pass of grouping did, in order: (M, 2) int64 (kept, gone), (M,) heights; comparisons made."""

    merges: NDArray[np.int64]
    heights: NDArray[np.float64]
    comparisons: int


def group(
    moments: Moments, boxes: NDArray[np.int64], pairs: Pairs, rule: Rule, gated: bool, limit: float = 1.0,
    held: Held | None = None,
) -> Grouped:  # fmt: skip
    """Merge the best allowed pair until none is left.

    Parameters
    ----------
    moments : sums of regions 1..N; changed in place, except in a pass of planes, where they are only read
    boxes : (N + 1, 4) int64, and rule.degree, changed in place
    limit : pairs whose height is at most this are allowed as well; above 1 for the coarser levels of the tree
    held : what was decided before; None: nothing. Its names are changed in place

    Returns
    -------
    Grouped
    """
    count, channels = moments.energy.shape
    flat = rule.kind in (BOUNDED, CHOW) and len(rule.terms[1]) == 3 and not (rule.degree[1:] > 1).any()
    planes = center_planes(moments) if flat else Planes(np.empty((0, 6)), np.empty((0, channels, 5)))
    held = held or Held(np.zeros(count, np.int64), 1.0)
    state = State(
        flat, held, moments, planes, np.ones((count, 5)), boxes, rule, make_work(moments), np.empty(6),
        np.empty((channels, 5)),
    )  # fmt: skip
    merges = np.empty((count, 2), np.int64)
    heights = np.empty(count)
    beyond = limit if limit > 1.0 else 0.0  # what the rule itself allows needs no second limit
    graph, scratch = make_graph(pairs, count - 1), make_scratch(len(pairs.boundary), count - 1)
    merged, comparisons = _run(graph, state, scratch, gated, beyond, merges, heights)
    return Grouped(merges[:merged], heights[:merged], int(comparisons))


@bare
def _add_merged(moments, merges, work):  # type: ignore[no-untyped-def]
    for t in range(merges.shape[0]):
        _absorb_moments(moments, merges[t, 0], merges[t, 1], work)


def add_merged(moments: Moments, merges: NDArray[np.int64]) -> None:
    """Carry the merges of a pass of planes over to the power sums, in place."""
    _add_merged(moments, merges, make_work(moments))
