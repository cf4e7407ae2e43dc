"""Absorption of single pixels against a plain priority queue; refinement only ever helps (step 3)."""

import cv2
import numpy as np
import pytest
from crafted import crafted_signals
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import naive_growth

from rcseg_core.models.moments import accumulate
from rcseg_core.models.polynomials import Models, fit_models, pixel_cost
from rcseg_core.pixels.absorption import BUCKETS, IMPULSE_SHARE, SMOOTHNESS, absorb, refine
from rcseg_core.signal.signals import COLOR_OUTLIER, INVALID, RANGE_OUTLIER

SHAPE = (22, 26)


def scene(seed, share=0.4):
    """Three planes, some of their pixels labelled, impulses, invalid pixels, and two values of `within`."""
    rng = np.random.default_rng(seed)
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    truth = 1 + (cols > 9) + ((cols > 9) & (rows > 11))
    image = (5.0 * truth + 0.05 * cols)[..., None] + rng.normal(size=(*SHAPE, 4))
    flags = rng.choice([0, 0, 0, 0, 0, 0, INVALID, RANGE_OUTLIER, COLOR_OUTLIER], SHAPE).astype(np.uint8)
    blocks = rng.random((6, 7)).repeat(4, 0).repeat(4, 1)[: SHAPE[0], : SHAPE[1]] < share
    labels = np.where(blocks & (flags & INVALID == 0), truth, 0).astype(np.int32)
    labels[2, 2], labels[2, 20], labels[18, 20] = 1, 2, 3
    flags[[2, 2, 18], [2, 20, 20]] = 0
    within = np.where(rows + cols < 30, 1, 2).astype(np.int32)
    signals = crafted_signals(image, 1, flags=flags, eps=0.5, color_eps=1.0)
    moments = accumulate(signals.image, signals.flags, labels, 3, 1)
    models = fit_models(moments, np.ones((4, 2), np.int64), 1)
    return signals, labels, within, models


def price(signals, models, max_cost):
    def cost(k, row, col):
        value = pixel_cost(
            models, k, signals.image, signals.flags, row, col, 1, signals.law, signals.color_eps2
        )
        impulse = signals.flags[row, col] & (RANGE_OUTLIER | COLOR_OUTLIER)
        return value + (IMPULSE_SHARE * max_cost if impulse else 0.0)

    return cost


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10**6), st.sampled_from([4.0, 16.0, 1e4]))
def test_growth_is_that_of_a_priority_queue(seed, max_cost):
    signals, labels, within, models = scene(seed)
    wanted = naive_growth.grow(
        labels,
        lambda row, col: not signals.flags[row, col] & INVALID,
        within,
        price(signals, models, max_cost),
        max_cost,
        BUCKETS,
    )
    before, leaves = labels.copy(), labels * 10
    absorb(signals, labels, leaves, models, max_cost, within)
    assert np.array_equal(labels, wanted)
    assert np.array_equal(leaves, labels * 10), "a pixel does not carry the leaf of the region it joined"
    assert np.array_equal(labels[before > 0], before[before > 0]), "a labelled pixel changed"


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10**6))
def test_growth_never_takes_invalid_pixels_nor_crosses_within(seed):
    signals, labels, within, models = scene(seed, share=0.0)
    labels[:] = 0
    labels[2, 2] = 1  # one start only
    absorb(signals, labels, labels.copy(), models, 1e12, within)
    assert not labels[signals.flags & INVALID != 0].any()
    assert not labels[within != within[2, 2]].any()
    absorb(signals, labels, labels.copy(), models, 1e12)
    reached = labels > 0
    free = (signals.flags & INVALID == 0) | (labels == labels[2, 2])
    parts = cv2.connectedComponents(free.astype(np.uint8), connectivity=4)[1]
    assert np.array_equal(reached, parts == parts[2, 2]), "without bounds all that hangs together is reached"


def test_nothing_is_absorbed_that_costs_more_than_the_limit():
    signals, labels, _, models = scene(1)
    cost = price(signals, models, 9.0)
    before = labels.copy()
    absorb(signals, labels, labels.copy(), models, 9.0)
    new = np.argwhere((labels > 0) & (before == 0))
    assert len(new) > 20
    assert all(cost(labels[row, col], row, col) < 9.0 for row, col in new)


def energy(signals, labels, models):
    """What refinement lowers: costs of the pixels plus disagreeing neighbours, counted from both sides."""
    total = 0.0
    for row in range(SHAPE[0]):
        for col in range(SHAPE[1]):
            k = labels[row, col]
            if k == 0:
                continue
            total += pixel_cost(
                models, k, signals.image, signals.flags, row, col, 1, signals.law, signals.color_eps2
            )
            for r in range(max(row - 1, 0), min(row + 2, SHAPE[0])):
                for c in range(max(col - 1, 0), min(col + 2, SHAPE[1])):
                    if labels[r, c] > 0 and labels[r, c] != k:
                        total += SMOOTHNESS / 2
    return total


@pytest.mark.parametrize("seed", range(6))
def test_refinement_lowers_its_energy_and_moves_border_pixels_only(seed):
    signals, labels, _, models = scene(seed)
    absorb(signals, labels, labels.copy(), models, 1e12)
    rng = np.random.default_rng(seed)
    wrong = (labels > 0) & (rng.random(SHAPE) < 0.1)
    labels[wrong] = rng.integers(1, 4, wrong.sum())
    leaves = labels * 10
    before, free = labels.copy(), labels == 0
    worth = [energy(signals, labels, models)]
    for _ in range(3):
        refine(signals, labels, leaves, models, 1)
        worth.append(energy(signals, labels, models))
        assert worth[-1] <= worth[-2] + 1e-9
    assert worth[-1] < worth[0]
    assert np.array_equal(labels == 0, free)
    assert np.array_equal(leaves, labels * 10)
    assert (labels != before).any()


def test_refinement_of_a_settled_image_changes_nothing():
    signals, labels, _, models = scene(3)
    absorb(signals, labels, labels.copy(), models, 1e12)
    refine(signals, labels, labels.copy(), models, 20)
    settled = labels.copy()
    refine(signals, labels, labels.copy(), models, 5)
    assert np.array_equal(labels, settled)


@pytest.mark.parametrize("seed", range(6))
def test_what_refinement_passes_over_would_not_change(seed):
    """Several passes, which skip what nothing changed beside, are as many passes that look at everything."""
    signals, labels, _, models = scene(seed)
    absorb(signals, labels, labels.copy(), models, 1e12)
    rng = np.random.default_rng(seed)
    labels[:] = np.where(labels > 0, rng.integers(1, 4, SHAPE), 0)
    once, leaves = labels.copy(), labels * 10
    moved = refine(signals, once, once * 10, models, 4)
    one_by_one = [refine(signals, labels, leaves, models, 1) for _ in range(4)]
    assert one_by_one[1] > 0
    assert moved == sum(one_by_one)
    assert np.array_equal(once, labels)


def test_an_image_without_regions_stays_empty():
    signals, labels, _, _ = scene(0)
    labels[:] = 0
    empty = Models(np.zeros((1, 2)), np.zeros((1, 2), np.int64), np.zeros((1, 4, 2, 2)))
    absorb(signals, labels, labels.copy(), empty, 16.0)
    assert not labels.any()
