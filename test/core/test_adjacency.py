"""The region adjacency graph against loops over pixels."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import naive_graph

from rcseg_core.graph.adjacency import find_pairs, spread
from rcseg_core.graph.components import mark_borders


def random_image(seed, shape=(17, 23), count=5):
    """Irregular labels with free (0) pixels between them, and sparse edges of all kinds."""
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, count + 1, (5, 6)).repeat(4, 0).repeat(4, 1)[: shape[0], : shape[1]]
    labels = np.where(rng.random(shape) < 0.25, 0, labels)
    edges = np.where(rng.random(shape) < 0.2, rng.integers(1, 8, shape), 0)
    return np.ascontiguousarray(labels).astype(np.int32), edges.astype(np.uint8)


def as_dict(pairs):
    rows = zip(pairs.nodes.tolist(), pairs.boundary, pairs.range_crossed, pairs.color_crossed, strict=True)
    return {tuple(nodes): [*map(int, tally)] for nodes, *tally in rows}


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10**6), st.integers(1, 6))
def test_pairs_are_those_of_loops_over_pixels(seed, max_gap):
    labels, edges = random_image(seed)
    pairs = find_pairs(labels, 5, edges, max_gap)
    assert as_dict(pairs) == naive_graph.pairs(labels, edges, max_gap)
    assert pairs.nodes.tolist() == sorted(pairs.nodes.tolist())
    assert (pairs.nodes[:, 0] < pairs.nodes[:, 1]).all()


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (2, 2), (17, 23)])
def test_marked_pixels_have_another_label_beside_them_or_end_a_row(shape):
    labels = random_image(0, shape)[0]
    wider = np.pad(labels, 1, mode="edge")
    beside = (wider[:-2, 1:-1], wider[2:, 1:-1], wider[1:-1, :-2], wider[1:-1, 2:])
    wanted = np.any([labels != other for other in beside], axis=0)
    wanted[:, [0, -1]] = True
    marked = np.zeros(shape, np.bool_)
    for row in range(shape[0]):
        mark_borders(labels, row, marked[row])
    assert np.array_equal(marked, wanted)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10**6), st.integers(0, 4))
def test_spreading_is_breadth_first(seed, rounds):
    labels, edges = random_image(seed)
    cells, met = spread(labels, edges, rounds)
    wanted_cells, wanted_met = naive_graph.spread(labels, edges, rounds)
    assert np.array_equal(cells, wanted_cells)
    assert np.array_equal(met, wanted_met)


@pytest.mark.parametrize("max_gap", [1, 2, 3, 4, 5])
def test_regions_up_to_the_gap_apart_are_adjacent_and_farther_ones_are_not(max_gap):
    """Both sides grow by whole pixels, so an odd gap is rounded up to the next even one."""
    for gap in range(8):
        labels = np.zeros((5, 20), np.int32)
        labels[:, :6] = 1
        labels[:, 6 + gap :] = 2
        found = len(find_pairs(labels, 2, np.zeros((5, 20), np.uint8), max_gap).boundary)
        assert found == (gap <= max_gap + max_gap % 2)


def test_an_edge_between_regions_is_met_even_when_it_lies_on_free_pixels():
    labels = np.zeros((6, 9), np.int32)
    labels[:, :4], labels[:, 5:] = 1, 2
    edges = np.zeros((6, 9), np.uint8)
    edges[:2, 4], edges[2:5, 4] = 2, 4
    pairs = find_pairs(labels, 2, edges, 3)
    assert as_dict(pairs) == {(1, 2): [6, 2, 3]}


def test_only_pairs_of_one_group_are_listed():
    labels = np.repeat(np.arange(1, 5, dtype=np.int32)[None], 4, 0).repeat(3, 1)
    pairs = find_pairs(labels, 4, np.zeros(labels.shape, np.uint8), 1, np.array([0, 7, 7, 9, 9]))
    assert pairs.nodes.tolist() == [[1, 2], [3, 4]]


def test_many_small_regions_fit_the_table():
    labels = np.arange(1, 60 * 60 + 1, dtype=np.int32).reshape(60, 60)
    pairs = find_pairs(labels, 3600, np.zeros(labels.shape, np.uint8), 1)
    assert len(pairs.boundary) == 2 * 60 * 59


def test_no_region_no_pairs():
    pairs = find_pairs(np.zeros((4, 4), np.int32), 0, np.zeros((4, 4), np.uint8), 3)
    assert pairs.nodes.shape == (0, 2)
