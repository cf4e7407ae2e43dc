"""Label image, leaf image and merge tree stay in step whatever is done to the partition."""

import cv2
import numpy as np
import pytest
from crafted import crafted_signals
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle.invariants import check_tree

from rcseg_core.adjacency import find_pairs
from rcseg_core.grouping import Grouped, add_merged
from rcseg_core.models import fit_models
from rcseg_core.moments import UNIT_PX, accumulate, region_boxes
from rcseg_core.partition import Partition
from rcseg_core.signals import INVALID

SHAPE = (18, 24)


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
