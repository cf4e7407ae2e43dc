"""The result: levels of the merge tree, reconstruction, and answers that stay the same."""

import gc
import weakref
from itertools import pairwise

import numpy as np
import pytest
from oracle.invariants import check_labels, joins_only

from rcseg_core import SegmenterConfig, segment
from rcseg_core.result.segmentation import compact
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


@pytest.mark.parametrize("family", ["room", "billiard"])
@pytest.mark.parametrize("name", ["default", "joint"])
def test_a_length_is_a_level_and_longer_ones_only_join(family, name):
    result = segment(make_scene(family, 4, width=128, height=96).frame, CONFIGS[name])
    scale = result.scale
    lengths = scale.tolerance_m * np.array([0.0, 0.1, 0.4, 1.0, 2.0, 5.0, 40.0])
    cuts = [result.labels_at(tolerance_m=length) for length in lengths]
    assert all(joins_only(fine, coarse) for fine, coarse in pairwise(cuts))
    assert cuts[0].max() > cuts[-1].max(), "the lengths span something"
    assert np.array_equal(cuts[3], result.labels)
    for length, cut in zip(lengths, cuts, strict=True):
        assert np.array_equal(cut, result.labels_at(length / scale.tolerance_m))
        assert np.array_equal(cut, result.labels_at(sigmas=length / scale.sigma_m))


def test_the_scale_is_that_of_the_frame_and_the_configuration():
    config = SegmenterConfig().replace({"grouping.range_tolerance": 0.006})
    scene = make_scene("room", 4, width=128, height=96)
    scale = segment(scene.frame, config).scale
    depth = np.median(scene.frame.depth_m[scene.frame.valid])
    assert scale.depth_m == pytest.approx(depth, rel=0.03)  # the median of a sixteenth of the pixels
    assert scale.tolerance_m == pytest.approx(0.006 * scale.depth_m, rel=1e-6)
    assert scale.sigma_m == pytest.approx(1.425e-3 * scale.depth_m**2, rel=0.3)
    assert scale.level(tolerance_m=0.012 * scale.depth_m) == pytest.approx(2.0)
    assert scale.level(sigmas=3.0) == pytest.approx(3 * scale.sigma_m / scale.tolerance_m)
    assert scale.length_m(2.0) == pytest.approx(0.012 * scale.depth_m)
    assert scale.sigmas(scale.level(sigmas=3.0)) == pytest.approx(3.0)


def test_the_scale_of_a_scanner_grid_is_one_length():
    scene = make_scene("painting", 4, width=128, height=96)
    scale = segment(scene.frame).scale
    low, high = np.quantile(scene.frame.points[scene.frame.valid], [0.02, 0.98], axis=0)
    assert np.isnan(scale.depth_m)
    assert scale.tolerance_m == pytest.approx(0.004 * np.linalg.norm(high - low), rel=1e-3)


@pytest.mark.parametrize("given, says", [
    ({}, "give one of"),
    ({"level": 1.0, "sigmas": 1.0}, "give one of"),
    ({"tolerance_m": 0.01, "sigmas": 1.0}, "give one of"),
    ({"tolerance_m": -0.01}, "tolerance_m = -0.01: expected 0 or more"),
    ({"sigmas": float("nan")}, "sigmas = nan: expected 0 or more"),
])  # fmt: skip
def test_a_scale_is_given_once_and_is_not_negative(result, given, says):
    with pytest.raises(ValueError, match=says):
        result.labels_at(**given)


def test_without_tolerance_levels_have_no_length():
    config = SegmenterConfig().replace({"grouping.range_tolerance": 0.0})
    result = segment(make_scene("room", 4, width=96, height=72).frame, config)
    with pytest.raises(ValueError, match=r"grouping.range_tolerance is 0"):
        result.labels_at(tolerance_m=0.01)
    assert all(region.persistence >= 1 for region in result.regions)


@pytest.mark.parametrize(
    "family, seed, name", [("room", 5, "default"), ("curved", 4, "joint"), ("billiard", 6, "default")]
)
def test_persistence_is_what_the_levels_show(family, seed, name):
    """A region is one segment by itself from its birth up to its end, and not beyond either."""
    result = segment(make_scene(family, seed, width=128, height=96).frame, CONFIGS[name])
    floor = result.scale.noise_level
    parents, tree = result.hierarchy.parents(), result.hierarchy
    ends, births = set(), set()
    for region in result.regions:
        inside = result.labels == region.label

        def alone(level, inside=inside):
            groups = result.labels_at(level)
            own = np.unique(groups[inside])
            return own.size == 1 and (groups == own[0]).sum() == inside.sum()

        parent = parents[result.nodes[region.label]]
        end = tree.heights[parent - tree.leaf_count - 1] if parent else np.inf
        birth = end / region.persistence if parent else None
        assert region.persistence >= 1
        assert (region.persistence == np.inf) == (parent == 0)
        if parent == 0:
            assert alone(1.0) and alone(1e9)
            continue
        assert floor - 1e-9 <= birth <= 1 + 1e-9
        # one that ends at the limit itself is born there too
        assert alone(max(end * (1 - 1e-9), 1.0)) and not alone(end * (1 + 1e-9))
        assert alone(min(birth * (1 + 1e-9), 1.0))
        if floor + 1e-6 < birth < 1 - 1e-6:
            assert not alone(birth * (1 - 1e-6))
        ends.add(end)
        births.add(round(birth, 6))
    assert len(ends) >= 2, "this tests nothing if no region ends"


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


def test_a_result_leaves_nothing_behind():
    """No cycle of references: the memory of a frame is free as soon as nobody holds the result."""
    frame = make_scene("blocks", 5, width=160, height=120).frame
    for changes in ({}, {"signal.reduction": 2}, {"grouping.order": "joint"}):
        result = segment(frame, SegmenterConfig().replace(changes))
        assert result.regions[0].persistence >= 1
        assert result.surfaces and result.hierarchy.leaf_count
        result.labels_at(2.0)
        result.reconstruct()
        region = result.regions[0]
        gone = weakref.ref(result)
        gc.disable()
        try:
            del result
            assert gone() is None, changes
        finally:
            gc.enable()
        assert region.persistence >= 1  # a region can still tell
