"""Two surfaces that meet along a line are told from one that is curved, by pixels, not by detected edges."""

from dataclasses import replace

import numpy as np
import pytest
from crafted import crafted_signals

from rcseg_core.adjacency import find_pairs
from rcseg_core.chamfers import dissolve_chamfers
from rcseg_core.creases import bases, bent_miss2, divide, find_crease, split_creases
from rcseg_core.edges import ORIENTATION
from rcseg_core.models import fit_models
from rcseg_core.moments import accumulate
from rcseg_core.partition import Partition

SHAPE = (60, 80)
ROWS, COLS = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
#: A roof whose ridge runs askew, 4 sigma high.
FIRST, SECOND = 0.20 * COLS + 0.03 * ROWS, 14.0 - 0.15 * COLS + 0.05 * ROWS
ROOF, ON_SECOND = np.minimum(FIRST, SECOND), FIRST > SECOND
BALL = 12.0 * np.sqrt(np.maximum(1.0 - ((COLS - 40) / 52) ** 2 - ((ROWS - 30) / 52) ** 2, 0.0))
TUBE = 10.0 * np.sqrt(np.maximum(1.0 - ((COLS - 40) / 41) ** 2, 0.0)) + 0.05 * ROWS


def signals_of(value, seed=0, eps=1.0, **changes):
    """Unit noise; a surface tilted by 45 degrees rises 3 sigma in UNIT_PX."""
    noisy = value + np.random.default_rng(seed).normal(size=value.shape)
    return replace(crafted_signals(noisy[..., None], 1, eps=eps, **changes), slope=(3.0, 0.0))


def found(value, mask=None, **changes):
    rows, cols = np.nonzero(np.ones(SHAPE, bool) if mask is None else mask)
    return find_crease(rows, cols, signals_of(value, **changes)), rows, cols


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["convex", "concave"])
def test_a_roof_is_divided_along_its_ridge(sign):
    division, rows, cols = found(sign * ROOF)
    assert division is not None
    second = division.on_second(rows, cols)
    right = np.mean(second == ON_SECOND[rows, cols])
    assert max(right, 1 - right) > 0.97


def test_outliers_do_not_move_the_ridge():
    value = ROOF.copy()
    value[np.random.default_rng(3).random(SHAPE) < 0.05] += 30.0
    division, rows, cols = found(value)
    assert division is not None
    right = np.mean(division.on_second(rows, cols) == ON_SECOND[rows, cols])
    assert max(right, 1 - right) > 0.97


def test_the_lid_of_a_can_is_parted_from_its_side():
    lid = ROWS < 22
    value = np.where(lid, TUBE[22] + 0.9 * (ROWS - 22), TUBE)
    division, rows, cols = found(value)
    assert division is not None
    right = np.mean(division.on_second(rows, cols) == lid[rows, cols])
    assert max(right, 1 - right) > 0.9


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "value", [FIRST, 0.006 * (COLS - 40) ** 2, BALL, TUBE], ids=["plane", "bowl", "ball", "tube"]
)
def test_one_surface_is_not_divided(value, seed):
    assert found(value, seed=seed)[0] is None


def test_a_crease_within_the_tolerance_is_none():
    assert found(ROOF, eps=1.0)[0] is not None
    assert found(ROOF, eps=20.0)[0] is None


def test_correlated_noise_asks_for_more_evidence():
    small = (ROWS > 20) & (ROWS < 32) & (np.abs(COLS - 42) < 8)
    assert found(1.5 * ROOF, small, eps=0.3, correlation=1.0)[0] is not None
    assert found(1.5 * ROOF, small, eps=0.3, correlation=60.0)[0] is None


def test_divide_of_exact_planes_misses_nothing():
    xy = np.stack([COLS.ravel() - 40, ROWS.ravel() - 30], axis=1) / 80
    kinds = np.array([[3, 3]])
    coefs, sides = np.empty((1, 2, 1, 6)), np.empty(1)
    miss = divide(bases(xy), ROOF.reshape(-1, 1), 1e6, kinds, coefs, sides)
    assert miss[0] < 1e-6
    lower = np.minimum(*(bases(xy) @ coefs[0, s, 0] for s in range(2)))
    np.testing.assert_allclose(lower, ROOF.ravel(), atol=1e-3)


@pytest.mark.parametrize("degree", [1, 2, 4])
def test_the_bent_account_is_least_squares(degree):
    rng = np.random.default_rng(1)
    xy, values = rng.uniform(-1, 1, (300, 2)), rng.normal(size=(300, 1))
    terms = [(a, b) for a in range(degree + 1) for b in range(degree + 1)]
    design = np.stack([xy[:, 0] ** a * xy[:, 1] ** b for a, b in terms], axis=1)
    expected = np.linalg.lstsq(design, values, rcond=None)[1][0] / 300
    assert bent_miss2(xy, values, degree, 1e9) == pytest.approx(expected, rel=1e-4)


def test_a_region_is_split_and_its_tree_stays_whole():
    signals = signals_of(ROOF)
    partition = Partition(np.ones(SHAPE, np.int32), 1)
    edges = np.zeros(SHAPE, np.uint8)
    assert split_creases(partition, signals, edges, 50) == 1
    assert partition.count == 2
    right = np.mean((partition.labels == 2) == ON_SECOND)
    assert max(right, 1 - right) > 0.97
    assert (partition.labels > 0).all()
    # each region has leaves of its own, and the crease is an orientation edge
    assert not set(partition.leaves[partition.labels == 1]) & set(partition.leaves[partition.labels == 2])
    assert set(np.unique(edges)) == {0, ORIENTATION}
    crease = (partition.labels[:, 1:] != partition.labels[:, :-1]).any(axis=1)
    assert ((edges != 0).any(axis=1) >= crease).all()


def chamfer_case(value):
    """A roof of regions 1 and 2 and a strip, region 3, along the ridge."""
    labels = np.where(ON_SECOND, 2, 1).astype(np.int32)
    labels[np.abs(FIRST - SECOND) < 1.2] = 3
    signals = signals_of(value, eps=0.5)
    partition = Partition(labels, 3)
    moments = accumulate(signals.image, signals.flags, labels, 3, 1)
    models = fit_models(moments, np.ones((4, 2), np.int64), 1)
    return partition, signals, models, find_pairs(labels, 3, np.zeros(SHAPE, np.uint8), 3)


def test_a_strip_that_both_sides_explain_dissolves():
    partition, *rest = chamfer_case(ROOF)
    assert dissolve_chamfers(partition, *rest, 1000) == 1
    assert partition.count == 2
    assert (partition.labels[np.abs(FIRST - SECOND) < 1.2] == 0).all()


def test_a_strip_that_stands_out_stays():
    partition, *rest = chamfer_case(ROOF + 3.0 * (np.abs(FIRST - SECOND) < 1.2))
    assert dissolve_chamfers(partition, *rest, 1000) == 0
    assert partition.count == 3


def test_large_regions_are_not_looked_at():
    partition, *rest = chamfer_case(ROOF)
    size = int((partition.labels == 3).sum())
    assert dissolve_chamfers(partition, *rest, size) == 0
