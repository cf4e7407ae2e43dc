"""Best-first grouping against a grouper that looks at every pair anew each time; the heap; invariants."""

import heapq

import numpy as np
import pytest
from crafted import crafted_signals
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import naive_graph

from rcseg_core.config import SegmenterConfig
from rcseg_core.graph import grouping
from rcseg_core.graph.adjacency import find_pairs
from rcseg_core.models.moments import accumulate, region_boxes
from rcseg_core.signal.units import UNIT_PX
from rcseg_core.stages.measures import make_rule

SHAPE = (32, 40)


def scene(seed, pieces=(4, 5), levels=(0.0, 0.5, 1.0, 4.0)):
    """A grid of seeds of unequal size on patches of a few levels, with noise 1 and some edges."""
    rng = np.random.default_rng(seed)
    rows = np.sort(rng.choice(np.arange(3, SHAPE[0] - 2, 3), pieces[0] - 1, replace=False))
    cols = np.sort(rng.choice(np.arange(3, SHAPE[1] - 2, 3), pieces[1] - 1, replace=False))
    row_of = np.searchsorted(rows, np.arange(SHAPE[0]), side="right")
    col_of = np.searchsorted(cols, np.arange(SHAPE[1]), side="right")
    labels = (row_of[:, None] * pieces[1] + col_of[None] + 1).astype(np.int32)
    level = rng.choice(levels, size=(pieces[0] * pieces[1] + 1, 1)) * np.array([1.0, 1.0, -1.0, 0.5])
    image = level[labels] + rng.normal(size=(*SHAPE, 4))
    edges = np.where(rng.random(SHAPE) < 0.15, rng.integers(1, 8, SHAPE), 0).astype(np.uint8)
    return crafted_signals(image, 1, eps=0.5, color_eps=1.0, correlation=1.2, systematic=0.2), labels, edges


def grouped(signals, labels, edges, gated=True, limit=1.0, degree=1, planes=True, **changes):
    config = SegmenterConfig().replace(changes)
    count = int(labels.max())
    moments = accumulate(signals.image, signals.flags, labels, count, degree)
    pairs = find_pairs(labels, count, edges, 3)
    rule = make_rule(signals, np.full((count + 1, 2), degree, np.int64), config, planes=planes)
    result = grouping.group(moments, region_boxes(labels, count), pairs, rule, gated, limit)
    return result, moments, pairs, rule


def errors_of(rule):
    return tuple(zip(rule.correlation, rule.systematic2, strict=True))


def by_hand(signals, labels, edges, rule, gated, whole=False):
    rows, cols = np.indices(SHAPE).reshape(2, -1)
    tallies = naive_graph.pairs(labels, edges, 3)
    ratio = naive_graph.PlaneRatio(
        cols / UNIT_PX, rows / UNIT_PX, signals.image.reshape(-1, 4).astype(float), labels.ravel(), 1,
        errors_of(rule), (0.25, signals.color_eps2), tallies if gated else None, whole,
    )  # fmt: skip
    return naive_graph.group(int(labels.max()), set(tallies), ratio)


@pytest.fixture
def eager(monkeypatch):
    """Compare all pairs of a region again after each merge, as the naive grouper does."""
    monkeypatch.setattr(grouping, "GROWTH", 1.0)
    monkeypatch.setattr(grouping, "_run", getattr(grouping._run, "py_func", grouping._run))


@pytest.mark.parametrize("criterion", ["bounded", "chow"])
@pytest.mark.parametrize("gated", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_the_merges_are_those_of_looking_at_every_pair_each_time(eager, seed, gated, criterion):
    signals, labels, edges = scene(seed)
    result, _, _, rule = grouped(signals, labels, edges, gated, **{"grouping.criterion": criterion})
    merges, _ = by_hand(signals, labels, edges, rule, gated, criterion == "chow")
    assert 3 < len(merges) < labels.max() - 1, "the scene is to leave some pairs apart"
    assert result.merges.tolist() == [list(pair) for pair in merges]


@pytest.mark.parametrize("seed", [11, 14, 21, 4])
def test_no_merge_exceeds_the_limit_when_it_is_made(seed):
    """A pair that was allowed may be so no more once its larger side has grown."""
    signals, labels, edges = scene(seed, (8, 10), levels=(0.0, 0.5, 1.0, 1.5))
    result, _, _, rule = grouped(signals, labels, edges)
    rows, cols = np.indices(SHAPE).reshape(2, -1)
    ratio = naive_graph.PlaneRatio(
        cols / UNIT_PX, rows / UNIT_PX, signals.image.reshape(-1, 4).astype(float), labels.ravel(), 1,
        errors_of(rule), (0.25, signals.color_eps2), naive_graph.pairs(labels, edges, 3),
    )  # fmt: skip
    members = {k: {k} for k in range(1, int(labels.max()) + 1)}
    for keep, gone in result.merges.tolist():
        assert ratio(members[keep], members[gone]) <= 1.0
        members[keep] |= members.pop(gone)


def partition_of(count, merges):
    group = np.arange(count + 1)
    for keep, gone in merges:
        group[group == group[gone]] = group[keep]
    return group


@pytest.mark.parametrize("seed", range(6))
def test_comparing_less_often_gives_the_same_partition_of_clear_scenes(seed):
    """The compiled loop as it is used; patches are 8 sigmas apart, so no order of merges can matter."""
    signals, labels, edges = scene(seed, (5, 6), levels=(0.0, 8.0, 16.0))
    edges[:] = 0
    result, _, pairs, rule = grouped(signals, labels, edges, gated=False)
    merges, _ = by_hand(signals, labels, edges, rule, gated=False)
    count = int(labels.max())
    ours, theirs = partition_of(count, result.merges), partition_of(count, merges)
    for a in range(1, count + 1):
        assert ((ours == ours[a]) == (theirs == theirs[a])).all()
    assert result.comparisons >= len(pairs.boundary)


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10**6), st.booleans())
def test_every_merge_joins_two_living_neighbours_and_keeps_the_larger(seed, gated):
    signals, labels, edges = scene(seed)
    result, _, pairs, _ = grouped(signals, labels, edges, gated)
    sizes = np.bincount(labels.ravel())
    links = {tuple(pair) for pair in pairs.nodes.tolist()}
    gone_before = set()
    for keep, gone in result.merges.tolist():
        assert gone not in gone_before and keep not in gone_before
        assert (min(keep, gone), max(keep, gone)) in links
        assert sizes[keep] > sizes[gone] or (sizes[keep] == sizes[gone] and keep < gone)
        sizes[keep] += sizes[gone]
        gone_before.add(gone)
        links = {tuple(sorted(keep if k == gone else k for k in pair)) for pair in links}
        links = {pair for pair in links if pair[0] != pair[1]}
    assert (result.heights <= 1).all()


def test_ties_go_to_the_lowest_pair():
    """Equal seeds of one constant: every value is the same, so the numbers decide."""
    labels = np.repeat(np.arange(1, 9, dtype=np.int32), 5)[None].repeat(6, 0)
    signals = crafted_signals(np.ones((*labels.shape, 4)))
    result, *_ = grouped(signals, labels, np.zeros(labels.shape, np.uint8))
    assert result.merges[0].tolist() == [1, 2]
    assert len(result.merges) == 7
    again, *_ = grouped(signals, labels, np.zeros(labels.shape, np.uint8))
    assert np.array_equal(result.merges, again.merges)


@pytest.mark.parametrize("planes", [True, False])
def test_moments_of_the_merged_are_those_of_their_pixels(planes):
    signals, labels, edges = scene(7)
    degree = 1 if planes else 2
    result, moments, _, _ = grouped(signals, labels, edges, degree=degree, planes=planes)
    if planes:
        grouping.add_merged(moments, result.merges)
    count = int(labels.max())
    group = partition_of(count, result.merges)
    kept = np.setdiff1d(np.arange(1, count + 1), result.merges[:, 1])
    assert len(kept) == count - len(result.merges)
    for k in kept:
        members = np.isin(labels, np.nonzero(group == group[k])[0]).astype(np.int32)
        direct = accumulate(signals.image, signals.flags, members, 1, degree)
        assert moments.count[k] == members.sum()
        np.testing.assert_allclose(moments.energy[k], direct.energy[1], rtol=1e-10)
        # about its own centre, wherever that is by now: compare what it says of the mean
        mean_x = moments.center[k, 0] + UNIT_PX * moments.power[k, 1, 0] / moments.count[k]
        assert mean_x == pytest.approx(np.nonzero(members)[1].mean(), rel=1e-9)


def test_a_wider_limit_joins_more_and_tells_how_wide():
    signals, labels, edges = scene(2)
    narrow, *_ = grouped(signals, labels, edges)
    wide, *_ = grouped(signals, labels, edges, limit=50.0)
    assert len(wide.merges) > len(narrow.merges)
    assert 1 < wide.heights.max() <= 50


def test_the_degree_of_a_merged_region_is_the_higher_of_the_two():
    """Step 6 of the algorithm box."""
    signals, labels, edges = scene(1, levels=(0.0,))
    count = int(labels.max())
    moments = accumulate(signals.image, signals.flags, labels, count, 2)
    degree = np.ones((count + 1, 2), np.int64)
    degree[3, 0], degree[5, 1] = 2, 2
    rule = make_rule(signals, degree, SegmenterConfig())
    result = grouping.group(
        moments, region_boxes(labels, count), find_pairs(labels, count, edges, 3), rule, False
    )
    assert len(result.merges) == count - 1
    root = int(np.setdiff1d(np.arange(1, count + 1), result.merges[:, 1])[0])
    assert rule.degree[root].tolist() == [2, 2]


entries = st.lists(
    st.tuples(st.sampled_from([0.0, 0.5, 1.0, 2.5]), st.integers(0, 50)), min_size=1, max_size=40
)


@given(entries)
def test_the_heap_gives_back_its_entries_in_order(items):
    n = len(items)
    heap = grouping.Heap(np.empty(n), *(np.empty(n, np.int64) for _ in range(3)))
    for at, (value, pair) in enumerate(items):
        grouping._sift_up(heap, at, value, pair, at, 0)
    wanted, got = list(items), []
    heapq.heapify(wanted)
    for size in range(n - 1, -1, -1):
        got.append((heap.value[0], heap.pair[0]))
        grouping._sift_down(
            heap, 0, size, heap.value[size], heap.pair[size], heap.edge[size], heap.version[size]
        )
    assert got == [heapq.heappop(wanted) for _ in range(n)]


@given(entries, st.integers(0, 2**40 - 1))
def test_dropping_stale_entries_keeps_the_others_in_order(items, stale):
    n = len(items)
    heap = grouping.Heap(np.empty(n), *(np.empty(n, np.int64) for _ in range(3)))
    alive = np.array([not (stale >> k) & 1 for k in range(n)])
    for at, (value, pair) in enumerate(items):
        grouping._sift_up(heap, at, value, pair, at, 7)
    size = grouping._drop_stale(heap, n, alive, np.full(n, 7))
    wanted = sorted(item for k, item in enumerate(items) if alive[k])
    assert size == len(wanted)
    got = []
    for left in range(size - 1, -1, -1):
        got.append((heap.value[0], heap.pair[0]))
        grouping._sift_down(
            heap, 0, left, heap.value[left], heap.pair[left], heap.edge[left], heap.version[left]
        )
    assert got == wanted
