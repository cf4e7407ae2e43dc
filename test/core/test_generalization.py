"""Generalisation: the nested F test against scipy on pixels (eq. 22-23), its level, and what stops it."""

import cv2
import numpy as np
import pytest
from oracle import naive_patch
from scipy.stats import f as f_distribution

from rcseg_core.config import GeneralizationConfig
from rcseg_core.decision.generalization import choose_degrees, f_test, residuals_by_degree
from rcseg_core.models.moments import accumulate, tensor_exponents
from rcseg_core.signal.units import UNIT_PX

SHAPE = (40, 48)
WHITE, UNBENT = (1.0, 1.0), (0.0, 0.0)


def measured(signal, degree=4, seed=0, noise=1.0):
    """Moments of one region that fills the image: three channels, the first is range."""
    image = signal + noise * np.random.default_rng(seed).normal(size=(*SHAPE, 3))
    image = image.astype(np.float32)
    labels = np.ones(SHAPE, np.int32)
    return image, accumulate(image, np.zeros(SHAPE, np.uint8), labels, 1, degree)


def surface(shape_of=lambda x, y: 0.0 * x):
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    x, y = (cols - 23.5) / 24, (rows - 19.5) / 20
    return np.stack([shape_of(x, y), 2 * x + y, 0 * x], -1)


def chosen(moments, correlation=WHITE, systematic2=UNBENT, **changes):
    config = GeneralizationConfig(**changes)
    start = np.ones((2, 2), np.int64)
    degree = choose_degrees(moments, 1, start, np.ones((2, 2)), correlation, systematic2, config)
    assert (start == 1).all(), "the argument was changed"
    return degree[1]


def test_the_table_holds_residual_sums_of_pixels():
    image, moments = measured(surface(lambda x, y: 5 * x * x - 3 * x * y * y))
    table = residuals_by_degree(moments, 1, 4)
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    x, y = (cols.ravel() - 23.5) / UNIT_PX, (rows.ravel() - 19.5) / UNIT_PX
    values = image.reshape(-1, 3).astype(float)
    for degree in range(1, 5):
        wanted = [naive_patch.rss_of_fit(x, y, v, tensor_exponents(degree)) for v in values.T]
        np.testing.assert_allclose(table[1, :, degree - 1], [wanted[0], wanted[1] + wanted[2]], rtol=1e-8)


def test_f_test_is_equations_22_and_23():
    """P = 1 - F cdf of (r - 1)(n - p)/q, computed from pixel residuals with scipy."""
    image, _ = measured(surface(lambda x, y: 0.2 * x * x))
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    x, y = (cols.ravel() - 23.5) / 24, (rows.ravel() - 19.5) / 20
    values, n = image[..., 0].ravel().astype(float), x.size
    low, high = (naive_patch.rss_of_fit(x, y, values, tensor_exponents(k)) for k in (1, 2))
    wanted = 1 - f_distribution.cdf((low - high) / 5 / (high / (n - 9)), 5, n - 9)
    got = f_test(np.array([low]), np.array([high]), np.array([float(n)]), 4, 9, 1)
    assert got[0] == pytest.approx(wanted, rel=1e-6)


def test_f_test_of_pure_noise_is_wrong_as_often_as_it_says():
    """Under the null hypothesis P is uniform on [0, 1]: 400 noise regions, one channel and three."""
    rng = np.random.default_rng(5)
    image = rng.normal(size=(20 * 8, 20 * 50, 4)).astype(np.float32)
    labels = (np.arange(8)[:, None] * 50 + np.arange(50) + 1).repeat(20, 0).repeat(20, 1).astype(np.int32)
    moments = accumulate(image, np.zeros(labels.shape, np.uint8), labels, 400, 2)
    table = residuals_by_degree(moments, 1, 2)
    for modality, channels in ((0, 1), (1, 3)):
        low, high = table[1:, modality, 0], table[1:, modality, 1]
        p = f_test(low, high, moments.count[1:], 4, 9, channels)
        for level in (0.05, 0.1, 0.3, 0.5):
            share = (p < level).mean()
            assert abs(share - level) < 3.5 * np.sqrt(level * (1 - level) / 400), (channels, level, share)


def test_f_test_guards_its_corners():
    some = np.array([1.0])
    assert f_test(some, some, np.array([9.0]), 4, 9, 1)[0] == 1, "no degree of freedom is left"
    assert f_test(some, np.array([0.0]), np.array([50.0]), 4, 9, 1)[0] == 0, "an exact fit of what was not"
    assert f_test(np.array([0.0]), np.array([0.0]), np.array([50.0]), 4, 9, 1)[0] == 1, "exact before"


def test_a_plane_stays_one_and_range_and_colour_choose_apart():
    assert chosen(measured(surface(lambda x, y: 30 * x - 10 * y))[1]).tolist() == [1, 1]
    assert chosen(measured(surface(lambda x, y: 20 * x * x))[1]).tolist() == [2, 1]
    assert chosen(measured(surface(lambda x, y: 20 * x**4 - 15 * x * x))[1]).tolist() == [4, 1]
    assert chosen(measured(surface(lambda x, y: 20 * x**3))[1]).tolist() == [3, 1]
    _, moments = measured(surface()[..., [1, 0, 0]] + surface(lambda x, y: 9 * x * y * y)[..., [2, 0, 0]])
    assert chosen(moments).tolist() == [1, 2]


def test_the_bare_f_test_follows_effects_that_are_too_small_to_matter():
    """At thousands of pixels a seventh of a sigma is significant; a bent sensor makes as much."""
    _, moments = measured(surface(lambda x, y: 0.5 * x * x))
    bent = (0.25**2, 0.0)
    assert chosen(moments, test="f")[0] >= 2
    assert chosen(moments, systematic2=bent, test="f")[0] >= 2
    assert chosen(moments, systematic2=bent, test="guarded")[0] == 1
    assert chosen(moments, systematic2=(0.02**2, 0.0), test="guarded")[0] == 2
    _, strong = measured(surface(lambda x, y: 10.0 * x * x))
    assert chosen(strong, systematic2=bent, test="guarded")[0] == 2


def test_degrees_have_tops_and_need_pixels():
    _, moments = measured(surface(lambda x, y: 40 * x**4))
    assert chosen(moments, max_range_degree=2)[0] == 2
    assert chosen(moments, max_range_degree=1)[0] == 1
    image, _ = measured(surface(lambda x, y: 4000 * x * x))
    labels = np.zeros(SHAPE, np.int32)
    labels[10:18, 10:18] = 1
    few = accumulate(image, np.zeros(SHAPE, np.uint8), labels, 1, 4)
    assert chosen(few)[0] == 1, "64 pixels do not carry nine coefficients"


def test_correlated_pixels_count_for_fewer():
    """What 1920 independent pixels would prove, 1920 pixels worth 77 do not."""
    _, moments = measured(surface(lambda x, y: 0.5 * x * x))
    for changes in ({"test": "f", "alpha": 1e-3}, {"test": "guarded"}):
        assert chosen(moments, **changes)[0] > chosen(moments, (25.0, 25.0), **changes)[0] == 1


def test_each_modality_has_an_error_of_its_own():
    """The same bow in range and in colour: only where the error explains it does the degree stay."""
    _, moments = measured(surface(lambda x, y: 2 * x * x)[..., [0, 0, 2]])
    assert chosen(moments).tolist() == [2, 2]
    assert chosen(moments, systematic2=(1.0, 0.0)).tolist() == [1, 2]
    assert chosen(moments, systematic2=(0.0, 1.0)).tolist() == [2, 1]
    assert chosen(moments, correlation=(400.0, 1.0)).tolist() == [1, 2]
    assert chosen(moments, correlation=(1.0, 400.0)).tolist() == [2, 1]


@pytest.mark.parametrize("blur", [1.0, 1.5])
def test_correlated_error_alone_raises_no_degree(blur):
    """Of 300 regions of noise that is blurred by a Gaussian: 4 pi s^2 pixels make one number."""
    side, down, across = 48, 12, 25
    rng = np.random.default_rng(3)
    image = np.zeros((side * down, side * across, 1))
    image[..., 0] = cv2.GaussianBlur(rng.normal(size=image.shape[:2]), (0, 0), blur)
    image = (image / image.std()).astype(np.float32)
    labels = (np.arange(down)[:, None] * across + np.arange(across) + 1).astype(np.int32)
    labels = np.ascontiguousarray(labels.repeat(side, 0).repeat(side, 1))
    count = down * across
    moments = accumulate(image, np.zeros(labels.shape, np.uint8), labels, count, 4)
    start, variance = np.ones((count + 1, 2), np.int64), np.ones((count + 1, 2))
    m = 4 * np.pi * blur**2
    known = choose_degrees(moments, 1, start, variance, (m, 1.0), UNBENT, GeneralizationConfig())
    taken_for_white = choose_degrees(moments, 1, start, variance, WHITE, UNBENT, GeneralizationConfig())
    assert (known[1:, 0] > 1).mean() <= 0.01
    assert (taken_for_white[1:, 0] > 1).mean() > 0.2
