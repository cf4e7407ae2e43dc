"""Label image, leaf image and merge tree stay in step whatever is done to the partition."""

import tracemalloc

import cv2
import numpy as np
import pytest
from crafted import crafted_signals
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle.invariants import check_tree

from rcseg_core.config import SegmenterConfig
from rcseg_core.graph.adjacency import find_pairs
from rcseg_core.graph.continuity import continuous_pairs
from rcseg_core.graph.grouping import Grouped, add_merged
from rcseg_core.models.moments import accumulate, region_boxes
from rcseg_core.models.polynomials import fit_models
from rcseg_core.partition.partition import Partition, majority
from rcseg_core.signal.signals import INVALID, MISFIT
from rcseg_core.signal.units import UNIT_PX
from rcseg_core.stages.passes import settle

SHAPE = (18, 24)
NO_REFINEMENT = {"absorption.refine_passes": 0}


def seeds(seed, count=8, free=0.2):
    rng = np.random.default_rng(seed)
    labels = rng.permutation(12)[np.arange(12).reshape(3, 4)].repeat(6, 0).repeat(6, 1)
    labels = np.where((labels < count) & (rng.random(SHAPE) > free), labels + 1, 0)
    return np.ascontiguousarray(labels).astype(np.int32)


def grouped(*merges, height=0.5):
    pairs = np.array(merges, np.int64).reshape(-1, 2)
    return Grouped(pairs, np.full(len(pairs), height), 0)


def check(partition):
    """Every pixel of a region hangs below the node of that region, and of no other."""
    tree = partition.tree.build()
    check_tree(tree)
    parents = tree.parents()
    root = np.arange(tree.node_count + 1)
    for node in range(tree.node_count, 0, -1):
        if parents[node]:
            root[node] = root[parents[node]]
    present = np.unique(partition.labels)
    assert present.max(initial=0) <= partition.count
    assert len(partition.nodes) == partition.count + 1
    labelled = partition.labels > 0
    wanted = partition.nodes[partition.labels[labelled]]
    assert np.array_equal(root[partition.leaves[labelled]], wanted)
    assert len(set(partition.nodes[1:].tolist())) == partition.count


def test_moments_hold_what_is_labelled_and_unflagged_whenever_a_flag_was_set():
    """Pixels are flagged, moved and freed in any order: nothing is taken away that was never added."""
    signals = crafted_signals(np.random.default_rng(0).normal(size=(*SHAPE, 1)), 1)
    partition = Partition(seeds(4, free=0.0), 8)
    rng = np.random.default_rng(1)
    for _ in range(6):
        moments = partition.moments(signals, 2)
        wanted = accumulate(signals.image, signals.flags, partition.labels, 8, 2)
        np.testing.assert_array_equal(np.rint(moments.count), np.rint(wanted.count))
        np.testing.assert_allclose(moments.energy, wanted.energy, atol=1e-9)
        signals.flags[rng.random(SHAPE) < 0.1] |= MISFIT
        signals.flags[rng.random(SHAPE) < 0.3] &= ~np.uint8(MISFIT)
        partition.labels[:] = rng.permutation(9).astype(np.int32)[partition.labels]
        partition.pixels_changed()


def test_pairs_are_those_of_the_edges_the_gap_and_the_bounds_that_are_asked_for():
    partition = Partition(seeds(4, free=0.0), 8)
    none, some = np.zeros(SHAPE, np.uint8), np.full(SHAPE, 1, np.uint8)
    assert not partition.pairs(none, 3).range_crossed.any()
    assert partition.pairs(some, 3).range_crossed.all()
    partition.labels[:, 6] = 0
    partition.pixels_changed()
    assert len(partition.pairs(none, 3).boundary) > len(partition.pairs(none, 0).boundary)
    partition.within = np.repeat([[1] * 12 + [2] * 12], SHAPE[0], axis=0).astype(np.int32)
    halves = partition.groups()
    assert all(halves[a] == halves[b] for a, b in partition.pairs(none, 3).nodes)
    assert partition.pairs(none, 3) is partition.pairs(none, 3)


@pytest.mark.parametrize("scale", [1.0, 30.0, 1000.0])
def test_what_fits_nowhere_still_joins_the_region_that_predicts_it_best(scale):
    """Three pixels between two regions, hundreds of sigmas from both and nearer to the second."""
    value = np.zeros(SHAPE)
    value[:, 11:] = 150.0 * scale
    labels = np.where(value > 0, 2, 1).astype(np.int32)
    value[5, 10:13], labels[5, 10:13] = 90.0 * scale, 0
    partition = Partition(labels, 2)
    settle(partition, crafted_signals(value[..., None], 1), SegmenterConfig().replace(NO_REFINEMENT))
    assert partition.labels[5, 10:13].tolist() == [2, 2, 2]


@pytest.mark.parametrize("seed", range(5))
def test_the_majority_is_that_of_all_pixels(seed):
    rng = np.random.default_rng(seed)
    a, b = Partition(seeds(seed), 8), Partition(rng.integers(0, 4, SHAPE).astype(np.int32), 3)
    a.labels[a.labels == 3] = 0  # one without any pixel
    table = np.zeros((9, 4), int)
    np.add.at(table, (a.labels, b.labels), 1)
    assert np.array_equal(majority(a, b), table.argmax(axis=1))


def test_thousands_of_regions_need_no_table_of_all_pairs():
    labels = np.arange(1, 6001, dtype=np.int32).reshape(60, 100).repeat(2, 0).repeat(2, 1)
    partition, surfaces = Partition(labels, 6000), Partition(labels.copy(), 6000)
    signals = crafted_signals(np.random.default_rng(0).normal(size=(*labels.shape, 1)), 1)
    moments = partition.moments(signals, 1)
    models = fit_models(moments, np.ones((6001, 2), np.int64), 1)
    pairs = partition.pairs(np.zeros(labels.shape, np.uint8), 3)
    tracemalloc.start()
    try:
        assert np.array_equal(majority(partition, surfaces), np.arange(6001))
        curved, sizes = np.ones(6001, bool), partition.sizes()
        sizes[1::2] *= 9
        continuous_pairs(labels, signals, models, pairs, curved, sizes, 9.0)
        assert tracemalloc.get_traced_memory()[1] < 20e6
    finally:
        tracemalloc.stop()


def test_a_fresh_partition_is_its_own_tree():
    partition = Partition(seeds(0), 8)
    check(partition)
    assert np.array_equal(partition.sizes(), np.bincount(partition.labels.ravel(), minlength=9))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6))
def test_labels_leaves_and_tree_stay_in_step(seed):
    """Random merges, leftovers, dropped regions, absorption and sorting in one row."""
    rng = np.random.default_rng(seed)
    partition = Partition(seeds(seed), 8)
    partition.apply(grouped((1, 2), (1, 5), (7, 3)))
    assert partition.count == 5
    check(partition)
    partition.add_leftovers(np.zeros(SHAPE, np.uint8), 3)
    check(partition)
    partition.apply(grouped((2, 1), height=0.1))
    check(partition)
    partition.drop_small(int(rng.integers(1, 30)))
    check(partition)
    signals = crafted_signals(rng.normal(size=(*SHAPE, 4)))
    moments = accumulate(signals.image, signals.flags, partition.labels, partition.count, 1)
    models = fit_models(moments, np.ones((partition.count + 1, 2), np.int64), 1)
    partition.absorb(signals, models, 50.0)
    check(partition)
    partition.refine(signals, models, 2)
    check(partition)
    partition.sort_by_size()
    check(partition)
    sizes = partition.sizes()[1:]
    assert (np.diff(sizes) <= 0).all()
    assert (sizes > 0).all()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6))
def test_what_was_measured_is_that_of_the_current_labels(seed):
    """Moments, boxes and pairs are carried along merges instead of being measured anew."""
    rng = np.random.default_rng(seed)
    labels = seeds(seed, free=0.1)
    partition, signals = Partition(labels, 8), crafted_signals(rng.normal(size=(*SHAPE, 4)))
    edges = np.where(rng.random(SHAPE) < 0.2, 2, 0).astype(np.uint8)
    partition.pairs(edges, 3)
    partition.boxes()
    first, *_ = partition.pairs(edges, 3).nodes.tolist()
    keep, gone = first
    box = partition.boxes()
    box[keep, :2] = np.minimum(box[keep, :2], box[gone, :2])
    box[keep, 2:] = np.maximum(box[keep, 2:], box[gone, 2:])
    partition.apply(grouped((keep, gone)))
    present = np.bincount(partition.labels.ravel(), minlength=partition.count + 1)[1:] > 0
    direct = region_boxes(partition.labels, partition.count)
    assert np.array_equal(partition.boxes()[1:][present], direct[1:][present])
    fresh = find_pairs(partition.labels, partition.count, edges, 3)
    carried = partition.pairs(edges, 3)
    assert np.array_equal(carried.nodes, fresh.nodes)
    np.testing.assert_array_equal(carried.boundary, fresh.boundary)
    np.testing.assert_array_equal(carried.range_crossed, fresh.range_crossed)
    partition.forget()
    assert partition.moments(signals, 2).count.shape == (partition.count + 1,)


def test_merges_follow_chains():
    partition = Partition(seeds(1, free=0.0), 8)
    before = partition.labels.copy()
    old = partition.apply(grouped((2, 1), (3, 2), (3, 4)))
    assert old.tolist() == [0, 3, 5, 6, 7, 8]
    together = np.isin(before, [1, 2, 3, 4])
    assert len(np.unique(partition.labels[together])) == 1
    assert np.array_equal(partition.labels == 0, before == 0)
    check(partition)


def test_leftovers_are_connected_large_enough_and_keep_within():
    labels = np.zeros(SHAPE, np.int32)
    labels[:, :4] = 1
    start = labels.copy()
    wanted = np.zeros(SHAPE, bool)
    wanted[2:6, 6:12] = True  # 24 px
    wanted[10, 6:9] = True  # 3 px
    flags = np.where(wanted, 0, INVALID).astype(np.uint8)
    partition = Partition(labels, 1)
    assert partition.add_leftovers(flags, 4) == 1
    assert np.array_equal(partition.labels == 2, (np.arange(SHAPE[0])[:, None] < 6) & wanted)
    check(partition)
    within = np.where(np.arange(SHAPE[1]) < 9, 1, 2)[None].repeat(SHAPE[0], 0).astype(np.int32)
    partition = Partition(start, 1, within)
    assert partition.add_leftovers(flags, 1) == 3
    for k in range(2, 5):
        part = partition.labels == k
        assert cv2.connectedComponents(part.astype(np.uint8), connectivity=4)[0] == 2
        assert len(np.unique(within[part])) == 1
    assert partition.groups().tolist()[1:] == [within[partition.labels == k][0] for k in range(1, 5)]


@pytest.mark.parametrize("least", [1, 5, 1000])
def test_small_regions_are_freed(least):
    partition = Partition(seeds(4), 8)
    before, sizes = partition.labels.copy(), partition.sizes()
    partition.drop_small(least)
    check(partition)
    assert np.array_equal(partition.labels > 0, (sizes[before] >= least) & (before > 0))
    assert partition.count == (sizes[1:] >= least).sum()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6))
def test_moments_follow_the_pixels(seed):
    """Whatever moves pixels between two measurements, the sums are those of the labels as they are."""
    rng = np.random.default_rng(seed)
    partition = Partition(seeds(seed, free=0.3), 8)
    signals = crafted_signals(rng.normal(size=(*SHAPE, 4)), flags=rng.random(SHAPE) < 0.1)
    for step in rng.permutation(6):
        if step == 0:
            partition.add_leftovers(np.zeros(SHAPE, np.uint8), 2)
        elif step == 1:
            partition.drop_small(int(rng.integers(1, 20)))
        elif step == 2:
            models = fit_models(
                partition.moments(signals, 2), np.ones((partition.count + 1, 2), np.int64), signals.n_range
            )
            partition.absorb(signals, models, 50.0)
        elif step == 3:
            models = fit_models(
                partition.moments(signals, 1), np.ones((partition.count + 1, 2), np.int64), signals.n_range
            )
            partition.refine(signals, models, 2)
        elif step == 4:
            partition.moments(signals, int(rng.integers(1, 5)))
        elif partition.count > 2:
            moments = partition.moments(signals, 2)
            merges = np.array([[1, 2]])
            add_merged(moments, merges)
            partition.apply(grouped((1, 2)))
    carried = partition.moments(signals, 2)
    degree = carried.cross.shape[2] - 1
    image, labels = signals.image.astype(float), partition.labels
    used = signals.flags == 0
    for k in range(1, partition.count + 1):
        rows, cols = np.nonzero((labels == k) & used)
        x, y = (cols - carried.center[k, 0]) / UNIT_PX, (rows - carried.center[k, 1]) / UNIT_PX
        for a in range(2 * degree + 1):
            for b in range(2 * degree + 1):
                np.testing.assert_allclose(carried.power[k, a, b], (x**a * y**b).sum(), atol=1e-9)
        for c in range(4):
            values = image[rows, cols, c]
            np.testing.assert_allclose(carried.energy[k, c], (values**2).sum(), atol=1e-9)
            for a in range(degree + 1):
                for b in range(degree + 1):
                    wanted = (x**a * y**b * values).sum()
                    np.testing.assert_allclose(carried.cross[k, c, a, b], wanted, atol=1e-9)
