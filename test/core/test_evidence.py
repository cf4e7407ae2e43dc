"""Comparisons of two regions from their moments against the same comparisons from pixels (eq. 16-21)."""

import numpy as np
import pytest
from crafted import crafted_signals
from oracle import naive_graph, naive_patch

from rcseg_core.config import SegmenterConfig
from rcseg_core.decision.evidence import (
    POINTS,
    compare,
    compare_planes,
    earned_tolerance,
    make_work,
    own_residuals,
    trace_inverse,
)
from rcseg_core.models.moments import accumulate, region_boxes, tensor_exponents
from rcseg_core.models.planes import center_planes
from rcseg_core.signal.signals import LEAST_SIGMA, local_scales
from rcseg_core.signal.units import UNIT_PX
from rcseg_core.stages.measures import make_rule

SHAPE = (40, 60)
EPS, COLOR_EPS = 1.5, 3.0
#: Pixels of an independent measurement; systematic part of the error of range and of colour (the default).
CORRELATION, SYSTEMATIC, COLOR_SYSTEMATIC = 1.5, 0.3, SegmenterConfig().grouping.noise_share
#: What the variance of the range noise may be off by is no evidence either.
KNOWN_VARIANCE = 0.03
ERRORS = ((CORRELATION, SYSTEMATIC**2 + KNOWN_VARIANCE), (CORRELATION, COLOR_SYSTEMATIC**2))


def scene(seed=0, bend=0.0, step=0.0, n_range=1):
    """Region 1 (large) and 2 (small) side by side; noise 1, bent by `bend`, parted by `step`."""
    rng = np.random.default_rng(seed)
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    labels = np.zeros(SHAPE, np.int32)
    labels[4:36, 3:33] = 1
    labels[8:30, 33:48] = 2
    smooth = 0.2 * cols - 0.1 * rows + bend * (cols - 30.0) ** 2
    image = smooth[..., None] * np.linspace(1, 0.5, n_range + 3) + rng.normal(size=(*SHAPE, n_range + 3))
    image[labels == 2] += step
    flags = np.where(rng.random(SHAPE) < 0.1, 2, 0)
    changes = {"correlation": CORRELATION, "systematic": SYSTEMATIC}
    return crafted_signals(image, n_range, flags=flags, eps=EPS, color_eps=COLOR_EPS, **changes), labels


def prepared(signals, labels, degrees=(1, 1), planes=False, **changes):
    """Everything that a comparison reads, and the pixels about the centre of region 1."""
    config = SegmenterConfig().replace(changes)
    count = int(labels.max())
    degree = np.full((count + 1, 2), 1, np.int64)
    degree[1:] = degrees
    moments = accumulate(signals.image, signals.flags, labels, count, max(1, int(degree.max())))
    rule = make_rule(signals, degree, config, planes=planes)
    work, own = make_work(moments), np.ones((count + 1, 5))
    for k in range(1, count + 1):
        own_residuals(moments, k, rule, work, own[k])
    rows, cols = np.nonzero((labels > 0) & (signals.flags == 0))
    x = (cols - moments.center[1, 0]) / UNIT_PX
    y = (rows - moments.center[1, 1]) / UNIT_PX
    return moments, rule, work, own, (x, y, signals.image[rows, cols].astype(float), labels[rows, cols])


def compared(signals, labels, degrees=(1, 1), gates=(1.0, 1.0), kind=None, order=(1, 2), **changes):
    moments, rule, work, own, pixels = prepared(signals, labels, degrees, **changes)
    if kind is not None:
        rule = rule._replace(kind=kind)
    boxes = region_boxes(labels, int(labels.max()))
    return compare(moments, *order, rule, own, boxes, *gates, 1.0, work), pixels, rule


def bounded_by_hand(pixels, exponents, rule, gates, whole=False):
    """The inequality of the module's first lines from pixel fits: (ratio, multiple of the tolerance)."""
    x, y, values, label = pixels
    everything, ratio, need = np.ones(label.size, bool), 0.0, 0.0
    n_range = rule.n_range
    for channels, eps2, gate, error in (
        (slice(0, n_range), EPS**2, gates[0], ERRORS[0]),
        (slice(n_range, None), COLOR_EPS**2, gates[1], ERRORS[1]),
    ):
        p = len(exponents) * values[:, channels].shape[1]
        rises, sizes = [], []
        for side in (1, 2):
            rises.append(naive_patch.rise(x, y, values[:, channels], label == side, exponents, everything))
            sizes.append((label == side).sum())
        if whole:
            rises, sizes = [sum(rises)], [sum(sizes)]
        for rise, n in zip(rises, sizes, strict=True):
            allowance, budget = naive_graph.error_gain(*error, n, p), n * eps2 * gate**2
            ratio = max(ratio, rise / (allowance + budget))
            need = max(need, np.sqrt(max(rise - allowance, 0) / budget))
    return ratio, need


@pytest.mark.parametrize("criterion", ["bounded", "chow"])
@pytest.mark.parametrize("gates", [(1.0, 1.0), (0.5, 0.25)])
@pytest.mark.parametrize("step", [0.0, 2.0, 12.0])
@pytest.mark.parametrize("n_range", [1, 3])
def test_bounded_and_chow_are_what_they_say_on_pixels(criterion, gates, step, n_range):
    signals, labels = scene(step=step, n_range=n_range)
    options = {"grouping.criterion": criterion}
    (value, height, allowed), pixels, rule = compared(signals, labels, gates=gates, **options)
    wanted = bounded_by_hand(pixels, tensor_exponents(1).tolist(), rule, gates, criterion == "chow")
    assert (value, height) == pytest.approx(wanted, rel=1e-6, abs=1e-6)
    assert allowed == (value <= 1)
    assert (value <= 1) == (height <= 1), "the limit and its multiple must agree"


@pytest.mark.parametrize("criterion", ["bounded", "chow"])
@pytest.mark.parametrize("step", [0.0, 2.0, 12.0])
def test_planes_are_compared_alike_in_closed_form(criterion, step):
    signals, labels = scene(seed=3, step=step)
    moments, rule, _, _, pixels = prepared(signals, labels, planes=True, **{"grouping.criterion": criterion})
    gates = (0.8, 0.6)
    shape, signal = np.empty(6), np.empty((4, 5))
    value, height, allowed = compare_planes(center_planes(moments), 1, 2, rule, *gates, 1.0, shape, signal)
    wanted = bounded_by_hand(pixels, [(0, 0), (1, 0), (0, 1)], rule, gates, criterion == "chow")
    assert (value, height) == pytest.approx(wanted, rel=1e-6, abs=1e-6)
    assert allowed == (value <= 1)
    x, y, values, label = pixels
    ratio = naive_graph.plane_ratio(
        x, y, values, label == 1, label == 2, 1, ERRORS,
        [(EPS * gates[0]) ** 2, (COLOR_EPS * gates[1]) ** 2], criterion == "chow",
    )  # fmt: skip
    assert value == pytest.approx(ratio, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("criterion", ["bounded", "chow", "bayes"])
def test_a_comparison_does_not_depend_on_the_order_of_its_arguments(criterion):
    signals, labels = scene(step=3.0, bend=0.01)
    options = {"grouping.criterion": criterion, "degrees": [[2, 1], [1, 2]]}
    assert compared(signals, labels, **options)[0] == compared(signals, labels, order=(2, 1), **options)[0]


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_c_ib_is_equation_21_on_pixels(degree):
    signals, labels = scene(step=1.0, bend=0.002)
    beta = 0.7
    options = {"grouping.criterion": "bayes", "grouping.prior_beta": beta}
    (value, height, allowed), pixels, _ = compared(signals, labels, (degree, degree), **options)
    x, y, values, label = pixels
    one, two = label == 1, label == 2
    box = region_boxes(labels, 2)[1]
    half_x, half_y = (box[3] - box[1]) / 2 / UNIT_PX, (box[2] - box[0]) / 2 / UNIT_PX
    c_ib = naive_patch.c_ib(
        x[one], y[one], values[one], x[two], y[two], values[two], 1, degree, beta, half_x, half_y
    )
    assert value == pytest.approx(c_ib / two.sum(), rel=1e-6)
    # sigma_ib alone, eq. (18), decides how far grouping goes (section 8)
    table = naive_patch.monomials(x, y, tensor_exponents(degree))
    coef = np.linalg.lstsq(table[one], values[one], rcond=None)[0]
    mean2 = ((values - table @ coef)[two] ** 2).mean(axis=0)
    limits = np.array([EPS**2 + 1, COLOR_EPS**2 + 3])
    wanted = np.sqrt(np.array([mean2[0], mean2[1:].sum()]) / limits).max()
    assert height == pytest.approx(wanted, rel=1e-6)
    assert allowed == (height <= 1)


def test_the_prior_of_equations_19_and_20_fades_with_beta():
    signals, labels = scene()
    values = [
        compared(signals, labels, **{"grouping.criterion": "bayes", "grouping.prior_beta": beta})[0][0]
        for beta in (0.01, 0.1, 1.0, 1e3)
    ]
    assert values == sorted(values, reverse=True)
    assert (values[0] - values[3]) / (values[1] - values[3]) == pytest.approx(100, rel=1e-2)


@pytest.mark.parametrize("degree", [1, 2, 4])
def test_trace_of_the_inverse_gram_on_the_local_domain(degree):
    signals, labels = scene()
    moments, rule, work, _, (x, y, _, label) = prepared(signals, labels, (degree, degree))
    box = region_boxes(labels, 2)[1]
    half_x, half_y = (box[3] - box[1]) / 2 / UNIT_PX, (box[2] - box[0]) / 2 / UNIT_PX
    table = naive_patch.monomials(x[label == 1] / half_x, y[label == 1] / half_y, rule.terms[degree])
    wanted = np.trace(np.linalg.inv(table.T @ table))
    assert trace_inverse(moments, 1, box, rule.terms[degree], work) == pytest.approx(wanted, rel=1e-8)


def test_trace_of_a_singular_gram_is_infinite():
    signals, _ = scene()
    labels = np.zeros(SHAPE, np.int32)
    labels[5, 5:30] = 1
    moments, rule, work, _, _ = prepared(signals, labels)
    assert trace_inverse(moments, 1, region_boxes(labels, 1)[1], rule.terms[1], work) == np.inf


def test_small_regions_are_absorbed_like_points_only_while_they_are_small():
    signals, labels = scene()
    small = (labels == 2).sum() * 640 * 480 / labels.size
    for limit, wanted in ((small * 1.5, True), (small * 0.5, False)):
        options = {"absorption.small_region": int(limit)}
        (value, height, allowed), _, _ = compared(signals, labels, kind=POINTS, **options)
        assert allowed == wanted
        assert (value == np.inf) == (not wanted) == (height == np.inf)
    parted, _ = scene(step=20.0)
    assert not compared(parted, labels, kind=POINTS, **{"absorption.small_region": int(small * 1.5)})[0][2]


def test_noise_alone_is_joined_and_a_clear_step_is_not():
    """The allowance m (p + 4 sqrt(2p)) is a four-sigma bound: of 60 noise pairs none is refused."""
    for seed in range(60):
        rng = np.random.default_rng(seed)
        signals = crafted_signals(rng.normal(size=(*SHAPE, 4)))
        _, labels = scene()
        assert compared(signals, labels, **{"grouping.noise_share": 0.0})[0][2]
    assert not compared(*scene(step=8.0))[0][2]


def test_tolerance_is_earned_by_relief():
    own = np.array([0.0, 0.0, np.inf, 1.0, 0.0])
    assert earned_tolerance(4.0, 0.01, 100.0, own, 1.0) == 4.0, "first-degree models keep the plain tolerance"
    for relief in (0.0, 0.5, 3.0, 50.0, 5000.0):
        own = np.array([0.0, 0.0, 100 * (1.0 + relief), 1.0, 0.0])
        earned = earned_tolerance(4.0, 0.01, 100.0, own, 1.0)
        assert earned == pytest.approx(min(max(4.0, 0.01 * relief), relief), abs=1e-12)
    own[3] = 3.0
    assert earned_tolerance(4.0, 0.0, 100.0, own, 1.0) == 12.0, "a steep surface is nearer than along the ray"


def test_noise_and_tolerance_depend_on_depth_as_the_law_says():
    law = np.array([1.0, 0.5, 0.25, 2.0, 0.1])
    assert local_scales(law, 2.0) == pytest.approx(((1 + 1 + 1) ** 2, 2.2**2))
    assert local_scales(np.array([0.01, 0, 0, 1.0, 0]), 0.0)[0] == pytest.approx(0.01**2)
    assert local_scales(np.array([-0.01, 0, 0, 1.0, 0]), 0.0)[0] == pytest.approx(LEAST_SIGMA**2)


def corner(fold, seed=0):
    """Two flat sides that meet along a line with a fold of slope, range only."""
    cols = np.mgrid[: SHAPE[0], : SHAPE[1]][1]
    labels = np.where(cols < 30, 1, 2).astype(np.int32)
    value = 0.2 * cols + fold * np.maximum(cols - 29.5, 0.0)
    image = value[..., None] + np.random.default_rng(seed).normal(size=(*SHAPE, 1))
    return crafted_signals(image, 1), labels


@pytest.mark.parametrize("seed", range(5))
def test_two_flat_sides_are_no_bent_surface_even_if_it_is_within_the_noise(seed):
    """The quartic's misfit is within what noise may cost, but twice as many coefficients must be worth it."""
    signals, labels = corner(0.15, seed)
    *_, allowed = compared(signals, labels, degrees=(4, 1))[0]
    assert not allowed
    moments, rule, work, own, _ = prepared(signals, labels, degrees=(4, 1))
    boxes = region_boxes(labels, 2)
    assert compare(moments, 1, 2, rule._replace(earn=False), own, boxes, 1.0, 1.0, 1.0, work)[2]


@pytest.mark.parametrize("seed", range(5))
def test_two_parts_of_a_bowl_are_one_surface(seed):
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    value = 0.02 * (cols - 30.0) ** 2 + 0.015 * (rows - 20.0) ** 2
    image = value[..., None] + np.random.default_rng(seed).normal(size=(*SHAPE, 1))
    signals = crafted_signals(image, 1)
    assert compared(signals, np.where(cols < 30, 1, 2).astype(np.int32), degrees=(2, 1))[0][2]
