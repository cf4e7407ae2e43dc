"""The measured noise is the noise that was put in, whatever else the frame holds (Sigma of eq. 3)."""

import cv2
import numpy as np
import pytest

from rcseg_core import PinholeCamera, RangeColorFrame, SegmenterConfig, segment
from rcseg_core.config import NoiseConfig
from rcseg_core.resampling.reduction import unreduced
from rcseg_core.signal.cleaning import color_median, local_median
from rcseg_core.signal.noise import (
    BLOCK_PX,
    COLOR_FLOOR_LEVELS,
    RELATIVE_FLOOR,
    SENSOR_MODELS,
    WINDOW_PX,
    _near,
    _quantile_of_levels,
    estimate_noise,
    window_residuals,
)
from rcseg_core.signal.signals import build_signals

SHAPE = (240, 320)
CAMERA = PinholeCamera(260.0, 260.0, 159.5, 119.5)
SIGMA = 2e-3  # 1/m


def room(shape=SHAPE):
    """Inverse depth of a floor, a wall and a box in front: steps and creases, 0.25 to 0.6 per metre."""
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    w = np.maximum(0.3 + 2e-4 * cols, 0.25 + 1.5e-3 * (rows - 120))
    w[60:150, 100:190] = 0.55 + 3e-4 * (cols[60:150, 100:190] - 100)
    return w


def estimated(w, valid=None, color=None, **changes):
    w = w.astype(np.float32)[..., None]
    valid = np.ones(w.shape[:2], bool) if valid is None else valid
    w[~valid] = 0
    color = np.full((*w.shape[:2], 3), 128, np.uint8) if color is None else color
    median, median_c = np.empty_like(w), np.empty_like(color)
    local_median(w, valid, median)
    color_median(color, median_c)
    return estimate_noise(w, median, valid, color, median_c, True, NoiseConfig(**changes))


def white(seed=0):
    return SIGMA * np.random.default_rng(seed).normal(size=SHAPE)


def test_window_residuals_are_those_of_a_plane_through_the_pixels():
    rng = np.random.default_rng(0)
    rows, cols = np.mgrid[:41, :61]
    values = (0.5 + 0.01 * cols - 0.02 * rows + 0.1 * rng.normal(size=rows.shape)).astype(np.float32)
    valid = rng.random(rows.shape) > 0.2
    median = np.where(valid, values, 0).astype(np.float32)  # no impulse
    out = np.empty((6, 3))
    window_residuals(values[..., None], median[..., None], valid, 0, np.ones(6), 20, 0, 1, out)
    window_residuals(values[..., None], median[..., None], valid, 0, np.ones(6), 20, 1, 2, out)
    index = 0
    for row0 in (0, 20):
        for col0 in (0, 20, 40):
            part = np.s_[row0 : row0 + WINDOW_PX, col0 : col0 + WINDOW_PX]
            use = valid[part]
            table = np.column_stack([np.ones(use.sum()), rows[part][use], cols[part][use]])
            found = values[part][use].astype(float)
            rest = found - table @ np.linalg.lstsq(table, found, rcond=None)[0]
            assert out[index, 0] == pytest.approx(found.mean(), rel=1e-6)
            assert out[index, 1] == pytest.approx(np.sqrt((rest**2).sum() / (use.sum() - 3)), rel=1e-5)
            image = np.zeros(use.shape)
            image[use] = rest
            squares = []
            for r in range(0, WINDOW_PX - BLOCK_PX + 1, BLOCK_PX):
                for c in range(0, WINDOW_PX - BLOCK_PX + 1, BLOCK_PX):
                    n = use[r : r + BLOCK_PX, c : c + BLOCK_PX].sum()
                    if n >= 12:
                        squares.append(image[r : r + BLOCK_PX, c : c + BLOCK_PX].sum() ** 2 / n)
            assert out[index, 2] == pytest.approx(np.mean(squares), rel=1e-4)
            index += 1


@pytest.mark.parametrize("seed", range(3))
def test_white_noise_is_measured_within_ten_percent(seed):
    noise = estimated(room() + white(seed))
    for w in (0.3, 0.4, 0.55):
        assert noise.range_sigma(np.array(w)) == pytest.approx(SIGMA, rel=0.1)
    assert noise.range_correlation == pytest.approx(1.0, abs=0.3)
    assert noise.source == "estimated"


def test_impulses_in_a_fifth_of_the_pixels_do_not_matter():
    rng = np.random.default_rng(1)
    w = room() + white()
    wild = rng.random(SHAPE) < 0.2
    w[wild] = rng.uniform(0.1, 1.0, wild.sum())
    noise = estimated(w)
    for value in (0.3, 0.4):
        assert noise.range_sigma(np.array(value)) == pytest.approx(SIGMA, rel=0.25)


def test_drop_out_of_a_third_of_the_pixels_does_not_matter():
    noise = estimated(room() + white(), np.random.default_rng(2).random(SHAPE) > 0.3)
    for value in (0.3, 0.4):
        assert noise.range_sigma(np.array(value)) == pytest.approx(SIGMA, rel=0.1)


@pytest.mark.parametrize(("step", "within"), [(2e-3, 0.2), (3e-3, 0.35), (6e-3, 0.6)])
def test_quantised_depth_does_not_give_zero(step, within):
    """Steps far above the noise: second differences are mostly zero, window residuals are step / sqrt(12).

    Plateaus wider than a window (here 30 px at the coarsest step) show less of their steps.
    """
    noise = estimated(np.round((room() + 0.1 * white()) / step) * step)
    assert noise.range_sigma(np.array(0.35)) == pytest.approx(step / np.sqrt(12), rel=within)


def test_a_quantum_above_the_noise_does_not_hide_it():
    """Most pixels equal their median then; what is one quantum away is noise as well, not an impulse."""
    correlated = cv2.GaussianBlur(white(), (0, 0), 1.5)
    correlated *= 0.84 * SIGMA / correlated.std()
    step = 1.87 * SIGMA
    noise = estimated(np.round((room() + correlated) / step) * step)
    assert noise.range_sigma(np.array(0.35)) == pytest.approx(SIGMA, rel=0.12)


def test_an_exact_frame_has_the_floor_and_not_zero():
    noise = estimated(room())
    typical = np.median(room())
    assert (noise.range_sigma(room()) >= 0.5 * RELATIVE_FLOOR * typical).all()
    assert noise.range_sigma(np.array(typical)) < 1e-4
    assert (noise.color == COLOR_FLOOR_LEVELS).all()


def test_correlated_noise_is_detected():
    """Blurred by a Gaussian of 1.5 px, 4 pi 1.5^2 = 28 pixels carry one number; 5x5 blocks tell up to 25."""
    correlated = cv2.GaussianBlur(white(), (0, 0), 1.5)
    correlated *= SIGMA / correlated.std()
    noise = estimated(room() + correlated)
    assert 8 < noise.range_correlation <= 25
    assert noise.range_sigma(np.array(0.35)) == pytest.approx(SIGMA, rel=0.15)
    mild = cv2.GaussianBlur(white(), (0, 0), 0.6)
    mild *= SIGMA / mild.std()
    assert 1.5 < estimated(room() + mild).range_correlation < noise.range_correlation


def test_noise_that_grows_with_depth_is_followed():
    """Constant noise of depth, sigma_w = sigma_z w^2: four times as much at twice the inverse depth."""
    rows, _ = np.mgrid[: SHAPE[0] * 2, : SHAPE[1]]
    w = 0.3 + 0.5 * rows / rows.max()
    w = w + 0.004 * w**2 * np.random.default_rng(0).normal(size=w.shape)
    noise = estimated(w)
    for value in (0.35, 0.5, 0.7):
        assert noise.range_sigma(np.array(value)) == pytest.approx(0.004 * value**2, rel=0.15)


def test_colour_noise_is_measured_by_channel_and_has_a_floor():
    rng = np.random.default_rng(0)
    base = np.full((*SHAPE, 3), 128.0)
    base[:, 150:] = 90
    color = np.clip(base + rng.normal(0, [3.0, 6.0, 0.2], base.shape), 0, 255).round().astype(np.uint8)
    noise = estimated(room() + white(), color=color)
    assert noise.color[0] == pytest.approx(3, rel=0.1)
    assert noise.color[1] == pytest.approx(6, rel=0.1)
    assert noise.color[2] == COLOR_FLOOR_LEVELS
    assert (estimated(room(), color=color, color_sigma=5.5).color == 5.5).all()


def test_constant_noise_is_a_law_of_inverse_depth():
    noise = estimated(room() + white(), range_model="constant", range_sigma=0.003)
    w = np.array([0.25, 0.5, 1.0])
    np.testing.assert_allclose(noise.range_sigma(w), 0.003 * w**2)
    assert noise.source == "constant"


@pytest.mark.parametrize(
    ("model", "sigma_z"),
    [
        ("kinect_v1", lambda z: 0.0012 + 0.0019 * (z - 0.4) ** 2),  # Nguyen, Izadi & Lovell 2012
        ("realsense_d435", lambda z: z**2 * 0.1 / (640 * 0.05)),
    ],
)
def test_sensor_models_are_those_of_their_sources(model, sigma_z):
    noise = estimated(room() + white(), range_model=model)
    z = np.array([0.6, 1.0, 2.0, 4.0])
    np.testing.assert_allclose(noise.range_sigma(1 / z) * z**2, sigma_z(z), rtol=2e-3)
    assert model in SENSOR_MODELS


def kinect(w):
    a, b, c = SENSOR_MODELS["kinect_v1"]
    return a + b * w + c * w * w


def test_without_any_window_the_prior_is_the_law():
    valid = np.zeros(SHAPE, bool)
    valid[::7, ::5] = True
    noise = estimated(room() + white(), valid=valid, range_prior="kinect_v1")
    np.testing.assert_allclose(noise.range_law, [SENSOR_MODELS["kinect_v1"]], rtol=1e-6)
    assert noise.source == "estimated with prior kinect_v1"


def test_a_frame_that_tells_its_noise_hardly_hears_the_prior():
    """Three times the noise of the sensor's law, or noise of another shape: what is measured stays."""
    for sigma in (lambda v: 3 * kinect(v), lambda v: 0.006 * v**2, lambda v: 0.003 + 0 * v):
        w = room() + sigma(room()) * np.random.default_rng(0).normal(size=SHAPE)
        noise = estimated(w, range_prior="kinect_v1")
        for value in (0.3, 0.45, 0.58):
            assert noise.range_sigma(np.array(value)) == pytest.approx(sigma(value), rel=0.12)


def test_the_prior_speaks_where_only_clutter_is():
    """A smooth wall at 0.8 m, and all that is farther is rough: there is no window there to measure.

    The noise that the wall shows is that of the law; carried on as a constant it would be wrong far away.
    """
    rng = np.random.default_rng(0)
    w = np.full(SHAPE, 1.25)
    w[:, 200:] = rng.uniform(0.2, 0.6, (SHAPE[0], 120))
    w += kinect(w) * rng.normal(size=SHAPE)
    valid = np.ones(SHAPE, bool)
    valid[:, 200:] = rng.random((SHAPE[0], 120)) < 0.4  # too few in any window
    far, near = np.array(0.25), np.array(1.25)
    alone, both = estimated(w, valid), estimated(w, valid, range_prior="kinect_v1")
    assert both.range_sigma(near) == pytest.approx(kinect(1.25), rel=0.15)
    assert both.range_sigma(far) == pytest.approx(kinect(0.25), rel=0.15)
    assert alone.range_sigma(far) != pytest.approx(kinect(0.25), rel=0.15)


def test_a_fixed_law_takes_no_prior():
    w = room() + white()
    fixed = estimated(w, range_model="kinect_v1", range_prior="realsense_d435")
    np.testing.assert_array_equal(fixed.range_law, estimated(w, range_model="kinect_v1").range_law)
    assert fixed.source == "kinect_v1"


def test_a_stated_law_is_used_as_it_stands():
    stated = {"range_law_a": 0.003, "range_law_b": 0.002, "range_law_c": 0.001}
    w = room() + white()
    noise = estimated(w, range_model="law", **stated, range_correlation=12.5, range_systematic=0.7)
    assert noise.range_law.tolist() == [[0.003, 0.002, 0.001]] and noise.source == "law"
    assert (noise.range_correlation, noise.range_systematic) == (12.5, 0.7)
    # each part may be stated alone; the others are measured
    measured = estimated(w)
    some = estimated(w, range_correlation=12.5)
    assert some.range_correlation == 12.5 and some.range_systematic == measured.range_systematic
    none = estimated(w, range_systematic=0.0)
    assert none.range_systematic == 0.0 and none.range_correlation == measured.range_correlation
    np.testing.assert_array_equal(none.range_law, measured.range_law)


@pytest.mark.parametrize("stated", [0.0, 0.5])
def test_planes_do_not_change_a_stated_systematic_part(stated):
    """A wall that is bent by most of a sigma: what is stated stands all the same."""
    cols = np.arange(SHAPE[1])
    depth_m = 1 / (0.5 + 0.005 * ((cols - 160) / 160) ** 2 + white())
    frame = RangeColorFrame.from_depth(depth_m.astype(np.float32), np.full((*SHAPE, 3), 90, np.uint8), CAMERA)
    config = SegmenterConfig().replace({"grouping.order": "range_only"})
    assert segment(frame, config).noise.range_systematic > 0.3
    config = config.replace({"noise.range_systematic": stated})
    assert segment(frame, config).noise.range_systematic == stated


def test_a_square_of_pixels_is_worth_its_share_of_a_stated_correlation():
    config = SegmenterConfig().replace({"signal.reduction": 2, "noise.range_correlation": 20.0})
    assert unreduced(config).noise.range_correlation == 5.0
    assert unreduced(config.replace({"noise.range_correlation": 2.0})).noise.range_correlation == 1.0
    assert unreduced(config.replace({"noise.range_correlation": 0.0})).noise.range_correlation == 0.0


@pytest.mark.parametrize("model", ["constant", "law", "kinect_v1", "realsense_d435", "auto"])
def test_scanner_grids_have_one_sigma_a_channel(model):
    rows, cols = np.mgrid[:120, :160]
    rng = np.random.default_rng(0)
    points = np.stack([cols * 0.002, rows * 0.002, np.full(rows.shape, 1.5)], -1)
    points += rng.normal(0, [5e-4, 1e-3, 2e-3], points.shape)
    frame = RangeColorFrame(points.astype(np.float32), np.full((120, 160, 3), 90, np.uint8), None)
    config = SegmenterConfig().replace({"noise.range_model": model, "noise.range_sigma": 0.004})
    noise = build_signals(frame, frame.color, config).noise
    assert noise.range_law.shape == (3, 3)
    assert not noise.range_law[:, 1:].any()
    sigma = noise.range_law[:, 0]
    wanted = {
        "constant": [0.004] * 3,
        "kinect_v1": [0.0012 + 0.0019 * 1.1**2] * 3,
        "realsense_d435": [1.5**2 * 0.1 / 32] * 3,
        "law": [1.5**2 * 0.002] * 3,
        "auto": [6e-4, 1e-3, 2e-3],  # x is held to 0.3 of the noisiest
    }[model]
    np.testing.assert_allclose(sigma, wanted, rtol=0.12 if model == "auto" else 5e-3)


@pytest.mark.parametrize("shape", [(3, 3), (20, 20), (21, 400)])
def test_images_too_small_to_measure_fall_back_to_the_floor(shape):
    w = np.full(shape, 0.5) + 1e-3 * np.random.default_rng(0).normal(size=shape)
    noise = estimated(w)
    assert np.isfinite(noise.range_law).all()
    assert (noise.range_sigma(w) > 0).all()


@pytest.mark.parametrize("share", [0.0, 0.3, 0.7, 1.0])
@pytest.mark.parametrize("top", [1, 3, 40, 256])
def test_quantiles_of_levels_are_those_of_the_numbers(share, top):
    rng = np.random.default_rng(top)
    for count in (1, 2, 7, 1000):
        values = rng.integers(0, top, count)
        found = _quantile_of_levels(np.bincount(values, minlength=256), share)
        assert found == pytest.approx(np.quantile(values, share))
    assert _quantile_of_levels(np.zeros(256, int), share) == 0.0


def test_impulses_are_six_sigmas_from_the_median_in_the_last_channel():
    rng = np.random.default_rng(2)
    signal, median = rng.uniform(0.2, 2, (2, 30, 40, 2)).astype(np.float32)
    valid = rng.random((30, 40)) < 0.8
    law, floor = np.array([0.01, -0.05, 0.04]), 0.02
    near = np.empty(valid.shape, bool)
    _near(signal, median, valid, law, floor, 0, 30, near)
    m = median[..., 1].astype(float)
    sigma = np.maximum(law[0] + law[1] * m + law[2] * m**2, floor)
    np.testing.assert_array_equal(near, valid & (abs(signal[..., 1] - median[..., 1]) <= 6 * sigma))
    assert 0.1 < near.mean() < 0.7
