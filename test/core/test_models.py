"""Models on pixels: evaluation and the cost of a pixel against direct sums."""

import numpy as np
import pytest
from crafted import crafted_signals
from oracle.naive_growth import predict as direct

from rcseg_core.models import fit_models, pixel_cost, predict
from rcseg_core.moments import UNIT_PX, accumulate
from rcseg_core.signals import COLOR_OUTLIER, INVALID, RANGE_OUTLIER

SHAPE = (30, 36)


def fitted(n_range=1, degrees=((1, 1), (2, 1), (3, 2), (4, 2))):
    rng = np.random.default_rng(0)
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    labels = ((rows > 14) * 2 + (cols > 17) + 1).astype(np.int32)
    labels[:2] = 0
    image = rng.normal(size=(*SHAPE, n_range + 3)) + 0.02 * (cols[..., None] - 15.0) ** 2
    flags = rng.choice([0, 0, 0, 0, 2, 4, 6], SHAPE).astype(np.uint8)
    flags[5:8, 5:8] = INVALID
    signals = crafted_signals(image, n_range, flags=flags, eps=0.8, color_eps=2.0)
    degree = np.array([(0, 0), *degrees])
    moments = accumulate(signals.image, signals.flags, labels, 4, int(degree.max()))
    return signals, labels, degree, fit_models(moments, degree, n_range)


@pytest.mark.parametrize("n_range", [1, 3])
def test_prediction_is_the_sum_of_its_terms(n_range):
    _, labels, degree, models = fitted(n_range)
    for row, col in [(3, 4), (10, 30), (20, 2), (29, 35), (15, 18)]:
        k = labels[row, col]
        for c in range(n_range + 3):
            modality = int(c >= n_range)
            top = degree[k, modality] + 1
            x, y = (col - models.center[k, 0]) / UNIT_PX, (row - models.center[k, 1]) / UNIT_PX
            wanted = direct(models.coef[k, c, :top, :top], x, y)
            assert predict(models, k, row, col, modality, c) == pytest.approx(wanted, rel=1e-9, abs=1e-9)
            assert not models.coef[k, c, top:].any() and not models.coef[k, c, :, top:].any()


@pytest.mark.parametrize("n_range", [1, 3])
def test_cost_of_a_pixel_leaves_out_what_was_not_measured(n_range):
    signals, labels, _, models = fitted(n_range)
    seen = set()
    for row in range(2, SHAPE[0]):
        for col in range(0, SHAPE[1], 3):
            k, flag = labels[row, col], int(signals.flags[row, col])
            rest = [
                (float(signals.image[row, col, c]) - predict(models, k, row, col, int(c >= n_range), c)) ** 2
                for c in range(n_range + 3)
            ]
            wanted = 0.0
            if not flag & (INVALID | RANGE_OUTLIER):
                wanted += sum(rest[:n_range]) / (1.0 + 0.25 * 0.8**2 / n_range)
            if not flag & COLOR_OUTLIER:
                wanted += sum(rest[n_range:]) / (1.0 + 0.25 * 2.0**2 / 3)
            got = pixel_cost(
                models, k, signals.image, signals.flags, row, col, n_range, signals.law, signals.color_eps2
            )
            assert got == pytest.approx(wanted, rel=1e-9)
            seen.add(flag)
    assert seen == {0, 1, 2, 4, 6}


def test_a_region_without_usable_pixels_has_a_flat_model():
    signals, labels, degree, _ = fitted()
    signals.flags[labels == 2] = RANGE_OUTLIER
    moments = accumulate(signals.image, signals.flags, labels, 4, 4)
    models = fit_models(moments, degree, 1)
    assert not models.coef[2].any()
    assert np.isfinite(models.coef).all()
