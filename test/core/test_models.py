"""Models on pixels: evaluation and the cost of a pixel against direct sums."""

import numpy as np
import pytest
from crafted import crafted_signals
from oracle.naive_growth import predict as direct

from rcseg_core.compute.parallel import LEAST_PRODUCTS
from rcseg_core.decision.generalization import residuals_by_degree
from rcseg_core.models.moments import Moments, accumulate
from rcseg_core.models.polynomials import fit_models, pixel_cost, predict
from rcseg_core.models.triangular import solve_triangular
from rcseg_core.signal.signals import COLOR_OUTLIER, INVALID, RANGE_OUTLIER
from rcseg_core.signal.units import UNIT_PX

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


def test_many_regions_are_fitted_like_each_alone():
    """They are shared out in parts, whose bounds lose no region nor take the sums of another."""
    rng = np.random.default_rng(5)
    labels = np.arange(1, 121, dtype=np.int32).reshape(10, 12).repeat(7, axis=0).repeat(8, axis=1)
    image = rng.normal(size=(*labels.shape, 2)).astype(np.float32)
    flags = np.zeros(labels.shape, np.uint8)
    together = accumulate(image, flags, labels, 120, 4)
    degree = rng.choice([1, 2, 4], (121, 2))
    models, table = fit_models(together, degree, 1), residuals_by_degree(together, 1, 4)
    assert len(together.energy) * 25**2 > 4 * LEAST_PRODUCTS, "too few to be parted"
    for k in (1, 2, 29, 30, 31, 60, 61, 90, 91, 119, 120):
        alone = Moments(*(np.stack([0 * a[0], a[k]]) for a in together))
        np.testing.assert_array_equal(fit_models(alone, degree[[0, k]], 1).coef[1], models.coef[k])
        np.testing.assert_array_equal(residuals_by_degree(alone, 1, 4)[1], table[k])
    assert not models.coef[0].any() and not table[0].any()


@pytest.mark.parametrize("size", [1, 3, 9])
def test_triangles_are_solved_like_the_whole(size):
    rng = np.random.default_rng(size)
    root = np.tril(rng.normal(size=(12, 12))) + 4 * np.eye(12)
    right, out = rng.normal(size=12), np.full(12, np.nan)
    solve_triangular(root, size, right, out)
    whole = root[:size, :size] @ root[:size, :size].T
    np.testing.assert_allclose(out[:size], np.linalg.solve(whole, right[:size]), rtol=1e-9)
    assert np.isnan(out[size:]).all()
