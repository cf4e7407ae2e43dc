"""The result: levels of the merge tree, reconstruction, and answers that stay the same."""

from itertools import pairwise

import numpy as np
import pytest
from oracle.invariants import check_labels, joins_only

from rcseg_core import SegmenterConfig, segment
from rcseg_core.segmentation import compact
from rcseg_core.synthetic import make_scene

LEVELS = (0.0, 0.2, 0.5, 0.8, 1.0, 1.1, 1.5, 2.0, 2.6, 4.0, 7.0, 12.0, 1e3, 1e12)
CONFIGS = {
    "default": SegmenterConfig(),
    "joint": SegmenterConfig().replace({"grouping.order": "joint"}),
    "range_only": SegmenterConfig().replace({"grouping.order": "range_only"}),
    "chow": SegmenterConfig().replace({"grouping.criterion": "chow"}),
    "tight": SegmenterConfig().replace({"grouping.range_tolerance": 5e-4, "grouping.color_tolerance": 4.0}),
    "literal": SegmenterConfig.literal(),
}


@pytest.mark.parametrize("family", ["room", "curved", "billiard"])
@pytest.mark.parametrize("name", CONFIGS)
def test_each_level_up_only_joins(family, name):
    scene = make_scene(family, 104, width=128, height=96)
    result = segment(scene.frame, CONFIGS[name])
    cuts = [result.labels_at(level) for level in LEVELS]
    for fine, coarse in pairwise(cuts):
        check_labels(fine, result.labels.shape)
        assert joins_only(fine, coarse)
        assert fine.max() >= coarse.max()
    assert np.array_equal(cuts[LEVELS.index(1.0)], result.labels)
    # a second question gets the same answer
    assert np.array_equal(result.labels_at(2.0), cuts[LEVELS.index(2.0)])


@pytest.fixture(scope="module")
def result():
    return segment(make_scene("room", 105, width=128, height=96).frame)


def test_regions_are_found_by_their_node_in_the_tree(result):
    tree = result.hierarchy
    cut = tree.cut(1.0)
    assert len(result.nodes) == len(result.regions) + 1
    assert np.array_equal(cut[result.nodes[1:]], result.nodes[1:]), "a region is joined at level 1"
    below = tree.heights[result.nodes[result.nodes > tree.leaf_count] - tree.leaf_count - 1]
    assert (below <= 1.0).all()


@pytest.mark.parametrize("criterion", ["chow", "bayes"])
def test_a_wide_limit_joins_all_that_touches_unless_edges_forbid_it(criterion):
    """With the gate, a boundary that crosses edges all along has no tolerance to widen.

    The bounded criterion joins less: sides that are flat have no tolerance to widen in a bent model either.
    """
    scene = make_scene("room", 105, width=128, height=96)
    changes = {"grouping.edge_gate": False, "grouping.criterion": criterion}
    assert segment(scene.frame, SegmenterConfig().replace(changes)).labels_at(1e8).max() <= 2


def test_levels_give_copies(result):
    result.labels_at(1.0)[:] = 7
    result.labels_at(2.0)[:] = 7
    assert result.labels.max() == len(result.regions)
    assert result.labels_at(2.0).max() != 7 or len(result.regions) >= 7


@pytest.mark.parametrize("level", [-0.1, float("nan"), -float("inf")])
def test_levels_are_not_negative(result, level):
    with pytest.raises(ValueError, match="expected a multiple of the tolerance"):
        result.labels_at(level)


def test_reconstruction_is_the_same_each_time(result):
    first, second = result.reconstruct(), result.reconstruct()
    assert np.array_equal(first[0], second[0], equal_nan=True)
    assert np.array_equal(first[1], second[1])
    first[0][:] = 0
    assert np.isfinite(result.reconstruct()[0][..., 2]).any()


def test_the_noise_that_was_used_is_told(result):
    assert result.noise.source == "estimated"
    assert (result.noise.color > 0).all()
    depth = 2.0
    sigma_z = float(result.noise.range_sigma(np.array(1 / depth))) * depth**2
    assert sigma_z == pytest.approx(1.425e-3 * depth**2, rel=0.3)


def test_compact_numbers_from_the_most_frequent_down():
    image = np.array([[0, 5, 5, 9], [9, 9, 3, 3], [0, 0, 0, 7]])
    assert compact(image).tolist() == [[0, 3, 3, 1], [1, 1, 2, 2], [0, 0, 0, 4]]
    assert compact(np.zeros((2, 2), int)).tolist() == [[0, 0], [0, 0]]
    assert compact(image).dtype == np.int32
