"""The merge tree: cuts are nested, heights monotone, leaves may come late."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle.invariants import check_tree, joins_only

from rcseg_core.graph.hierarchy import Hierarchy, TreeBuilder, join_heights


def random_tree(seed, leaves=12, merges=8, late=3):
    """A builder with random merges of current regions, some leaves added half way; and the regions' nodes."""
    rng = np.random.default_rng(seed)
    builder, nodes = TreeBuilder(leaves), np.arange(leaves + 1)
    alive = list(range(1, leaves + 1))
    for step in range(merges):
        if step == merges // 2 and late:
            inner = nodes > builder.leaf_count
            new = np.arange(builder.leaf_count + 1, builder.leaf_count + late + 1)
            builder.add_leaves(late)
            nodes[inner] += late
            nodes = np.concatenate([nodes, new])
            alive += list(range(len(nodes) - late, len(nodes)))
        keep, gone = rng.choice(alive, 2, replace=False)
        builder.merge(np.array([[keep, gone]]), np.array([rng.random()]), nodes)
        alive.remove(gone)
    return builder, nodes, alive


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6))
def test_trees_are_forests_with_monotone_heights(seed):
    builder, nodes, alive = random_tree(seed)
    tree = builder.build()
    check_tree(tree)
    assert tree.node_count == tree.leaf_count + len(tree.children) == 15 + 8
    parents = tree.parents()
    roots = {int(nodes[k]) for k in alive}
    assert roots == {node for node in range(1, tree.node_count + 1) if parents[node] == 0}


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.floats(0, 1), st.floats(0, 1))
def test_a_higher_cut_only_joins(seed, low, high):
    low, high = sorted((low, high))
    tree = random_tree(seed)[0].build()
    leaves = slice(1, tree.leaf_count + 1)
    fine, coarse = tree.cut(low)[leaves], tree.cut(high)[leaves]
    assert joins_only(fine, coarse)
    assert np.array_equal(tree.cut(-1.0)[leaves], np.arange(1, tree.leaf_count + 1))
    parents = tree.parents()
    assert (parents[tree.cut(2.0)[leaves]] == 0).all()


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.floats(0, 1))
def test_a_cut_is_the_highest_ancestor_within_the_level(seed, level):
    tree = random_tree(seed)[0].build()
    parents, cut = tree.parents(), tree.cut(level)
    for leaf in range(1, tree.leaf_count + 1):
        node = leaf
        while parents[node] and tree.heights[parents[node] - tree.leaf_count - 1] <= level:
            node = parents[node]
        assert cut[leaf] == node


def test_heights_never_fall_towards_the_root():
    builder, nodes = TreeBuilder(3), np.arange(4)
    builder.merge(np.array([[1, 2], [1, 3]]), np.array([0.9, 0.2]), nodes)
    tree = builder.build()
    assert tree.heights.tolist() == [0.9, 0.9]
    assert tree.children.tolist() == [[1, 2], [4, 3]]
    assert nodes[1] == 5


def test_an_empty_tree_cuts_to_nothing():
    tree = Hierarchy(0, np.empty((0, 2), np.int64), np.empty(0))
    assert tree.cut(1.0).tolist() == [0]
    assert tree.node_count == 0


def test_a_finished_tree_can_be_gone_on_with():
    builder, nodes, alive = random_tree(5)
    tree = builder.build()
    again = TreeBuilder.resume(tree)
    again.merge(np.array([alive[:2]]), np.array([7.0]), nodes.copy())
    grown = again.build()
    assert grown.node_count == tree.node_count + 1
    assert len(tree.children) == 8, "the finished tree was changed"
    assert np.array_equal(grown.children[:-1], tree.children)
    assert grown.heights[-1] == 7.0


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_nodes_of_the_tree_can_be_cut_as_well_as_leaves(level):
    tree = random_tree(9)[0].build()
    cut = tree.cut(level)
    assert cut.shape == (tree.node_count + 1,)
    assert (cut >= np.arange(tree.node_count + 1)).all()


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6))
def test_labels_hang_together_from_their_join_height_on(seed):
    """Against cuts: below the height the pixels of a label are in several parts, from it on in one."""
    tree = random_tree(seed)[0].build()
    rng = np.random.default_rng(seed + 1)
    leaves = rng.integers(0 if seed % 3 == 0 else 1, tree.leaf_count + 1, (6, 7)).astype(np.int32)
    labels = np.where(rng.random((6, 7)) < 0.2, 0, leaves % 4).astype(np.int32)
    heights = join_heights(tree, labels, leaves, 4)
    assert heights[4] == np.inf, "no pixel, no height"
    for label in range(1, 4):
        members = leaves[labels == label]
        for level in (0.0, *tree.heights):
            together = len(np.unique(tree.cut(level)[members])) == 1 if members.size else False
            assert together == (heights[label] <= level), (label, level)
