"""Parts of a surface are joined where they continue each other; across creases, steps and edges never."""

import numpy as np
import pytest
from crafted import crafted_signals
from oracle.naive_growth import predict as direct

from rcseg_core.graph.adjacency import find_pairs
from rcseg_core.graph.continuity import _place, continuous_pairs, tangent
from rcseg_core.models.moments import accumulate
from rcseg_core.models.polynomials import fit_models
from rcseg_core.signal.units import UNIT_PX

SHAPE = (48, 64)
ROWS, COLS = np.mgrid[: SHAPE[0], : SHAPE[1]]
CURVED = np.array([False, True, True])


def joined(value, curved=CURVED, degree=2, edges=None, split=44, sliver_px=0.0, eps=1.0):
    """Region 1 left of `split`, region 2 right of it; range only, in sigmas. Returns the merges."""
    labels = np.where(split > COLS, 1, 2).astype(np.int32)
    signals = crafted_signals(value[..., None], 1, eps=eps)
    moments = accumulate(signals.image, signals.flags, labels, 2, degree)
    models = fit_models(moments, np.full((3, 2), degree), 1)
    edges = np.zeros(SHAPE, np.uint8) if edges is None else edges
    pairs = find_pairs(labels, 2, edges, 3)
    return continuous_pairs(
        labels, signals, models, pairs, curved, np.bincount(labels.ravel(), minlength=3), sliver_px
    ).merges.tolist()


def test_tangent_is_the_polynomial_and_its_derivatives():
    rng = np.random.default_rng(0)
    labels = np.ones(SHAPE, np.int32)
    moments = accumulate(
        rng.normal(size=(*SHAPE, 2)).astype(np.float32), labels.astype(np.uint8) * 0, labels, 1, 3
    )
    models = fit_models(moments, np.full((2, 2), 3), 2)
    for row, col in ((3.0, 4.0), (20.5, 60.0)):
        value, by_x, by_y = tangent(models, 1, row, col, 1)
        x, y = (col - models.center[1, 0]) / UNIT_PX, (row - models.center[1, 1]) / UNIT_PX
        h = 1e-5
        coef = models.coef[1, 1]
        assert value == pytest.approx(direct(coef, x, y), rel=1e-9)
        assert by_x == pytest.approx((direct(coef, x + h, y) - direct(coef, x - h, y)) / (2 * h), rel=1e-5)
        assert by_y == pytest.approx((direct(coef, x, y + h) - direct(coef, x, y - h)) / (2 * h), rel=1e-5)


def bowl():
    return 0.01 * (COLS - 30.0) ** 2 + 0.005 * (ROWS - 24.0) ** 2


def test_the_smaller_part_of_a_curved_surface_is_taken_in():
    assert joined(bowl()) == [[1, 2]]


FLAT = np.zeros(3, bool)


def bend(degrees):
    """A plane that turns by an angle at the border; 10 units per UNIT_PX are 45 degrees."""
    return np.maximum(COLS - 43.5, 0) * np.tan(np.deg2rad(degrees)) * 10.0 / UNIT_PX


def test_flat_parts_are_left_to_the_criterion_of_grouping():
    """It knows how much a sensor bends planes; curved ones continue each other where they turn a little."""
    assert joined(bend(12.0), curved=FLAT, degree=1) == []
    assert joined(bend(24.0), degree=1) == [[1, 2]]


def test_an_edge_along_the_border_parts_flat_parts():
    edges = np.zeros(SHAPE, np.uint8)
    edges[:10, 43:45] = 2
    assert joined(bend(12.0), curved=FLAT, degree=1, edges=edges) == []
    assert joined(bend(12.0), degree=1, edges=edges) == [[1, 2]]


def test_flat_slivers_have_no_liberties():
    assert joined(bend(40.0), curved=FLAT, degree=1, split=61, sliver_px=500) == []


def test_a_step_parts_them():
    assert joined(bowl() + 6.0 * (COLS >= 44)) == []


def test_a_crease_parts_them():
    """10 units per UNIT_PX are 45 degrees in `crafted_signals`: here it turns from 42 to -60 degrees."""
    kink = np.maximum(COLS - 43.5, 0) * -27.0 / UNIT_PX
    assert joined(bowl() + kink) == []
    assert joined(bowl() + 0.1 * kink) == [[1, 2]]


def test_parts_of_about_equal_size_stay_apart():
    assert joined(bowl(), split=36) == []


def test_slivers_may_turn_further_unless_an_edge_lies_between():
    """At column 61 the bowl rises by 63 degrees; behind the kink by 26, or falls by 68."""
    kink = np.maximum(COLS - 60.5, 0) * -15.0 / UNIT_PX
    assert joined(bowl() + kink, split=61) == []
    assert joined(bowl() + kink, split=61, sliver_px=1000) == [[1, 2]]
    assert joined(bowl() + 3.0 * kink, split=61, sliver_px=1000) == []
    edges = np.zeros(SHAPE, np.uint8)
    edges[:, 61] = 2
    assert joined(bowl() + kink, split=61, sliver_px=1000, edges=edges) == []


def test_the_cap_of_a_cylinder_is_too_wide_for_a_sliver():
    kink = np.maximum(COLS - 57.5, 0) * -15.0 / UNIT_PX
    assert joined(bowl() + kink, split=58, sliver_px=1000) == []


def test_the_place_of_a_key_is_found_or_there_is_none():
    keys = np.array([2, 5, 9])
    assert [_place(keys, key) for key in (2, 5, 9)] == [0, 1, 2]
    assert [_place(keys, key) for key in (1, 3, 7, 10)] == [-1] * 4
    assert _place(keys[:0], 2) == -1
