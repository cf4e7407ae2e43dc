"""`calibrate` tells noise, correlation and bend apart that were put in, each within stated limits."""

import cv2
import numpy as np
import pytest

from rcseg_core import InputError, PinholeCamera, RangeColorFrame, SegmenterConfig, segment
from rcseg_core.calibration import calibrate

SHAPE = (240, 320)
CAMERA = PinholeCamera(260.0, 260.0, 159.5, 119.5)
SIGMA = 2e-3  # 1/m
GREY = np.full((*SHAPE, 3), 120, np.uint8)
ROWS, COLS = np.mgrid[: SHAPE[0], : SHAPE[1]]


def floor_and_wall():
    """A wall at 2.5 m above a floor that comes near, 0.4 to 1.1 per metre."""
    return np.maximum(0.4 + 2e-4 * COLS, 0.3 + 3.3e-3 * ROWS)


def noise(rng, blur):
    """Unit noise with Gaussian correlation: the mean over an area takes 4 pi blur^2 px for one."""
    values = rng.normal(size=SHAPE)
    if blur:
        wide = rng.normal(size=(SHAPE[0] + 40, SHAPE[1] + 40))
        values = cv2.GaussianBlur(wide, (0, 0), blur)[20:-20, 20:-20]
    return values / values.std()


def frames(count, w, blur=0.0, sigma=SIGMA, seed=0):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        depth_m = 1.0 / (w + sigma * noise(rng, blur))
        yield RangeColorFrame.from_depth(depth_m.astype(np.float32), GREY, CAMERA)


def pixels_of(blur):
    return 4 * np.pi * blur**2 if blur else 1.0


@pytest.mark.parametrize("blur", [0.0, 1.5])
def test_a_static_view_tells_noise_and_its_correlation(blur):
    found = calibrate(frames(12, floor_and_wall(), blur))
    assert (found.frames, found.static_frames, found.views) == (12, 12, 1)
    assert found.sigma(np.array([0.4, 0.7, 1.0])) == pytest.approx(SIGMA, rel=0.07)
    assert found.temporal == pytest.approx(1.0, abs=0.05)  # nothing of it stays from frame to frame
    assert found.correlation == pytest.approx(pixels_of(blur), rel=0.3)
    assert found.temporal_correlation == pytest.approx(pixels_of(blur), rel=0.3)
    assert found.systematic < 0.1 and found.bend < 0.1
    for depth in found.bins:
        assert depth.random == pytest.approx(SIGMA * depth.depth_m**2, rel=0.15)
        assert depth.temporal == pytest.approx(SIGMA * depth.depth_m**2, rel=0.15)


def test_noise_that_grows_with_depth_is_a_law_of_it():
    """Constant along depth, as of time of flight: sigma = 4 mm w^2."""
    w = floor_and_wall()
    found = calibrate(frames(8, w, sigma=0.004 * w**2))
    for value in (0.4, 0.6, 0.9):
        assert found.sigma(np.array(value)) == pytest.approx(0.004 * value**2, rel=0.15)
    assert found.bins[0].depth_m < found.bins[-1].depth_m
    assert [b.random for b in found.bins] == pytest.approx([0.004] * len(found.bins), rel=0.2)


@pytest.mark.parametrize("blur", [0.0, 1.0])
def test_a_fixed_bend_is_told_from_noise(blur):
    """A lens that bends a wall by 0.8 sigma, rms: no number of pixels and no number of frames averages it."""
    x, y = COLS / 160 - 1, ROWS / 120 - 1
    bend = x**2 + 0.5 * y**2 - x * y
    plane = np.stack([np.ones(bend.size), x.ravel(), y.ravel()], 1)
    bend -= (plane @ np.linalg.lstsq(plane, bend.ravel(), rcond=None)[0]).reshape(SHAPE)
    bend *= 0.8 / bend.std()
    found = calibrate(frames(12, 0.5 + 2e-4 * COLS + SIGMA * bend, blur))
    assert found.systematic == pytest.approx(0.8, abs=0.12)
    assert found.bend == pytest.approx(0.8, abs=0.12)
    assert found.temporal == pytest.approx(1.0, abs=0.07)
    assert found.correlation == pytest.approx(pixels_of(blur), rel=0.35)
    assert found.sigma(np.array(0.5)) == pytest.approx(SIGMA, rel=0.08)
    known = np.isfinite(found.pattern)
    assert known.mean() > 0.8 and np.corrcoef(found.pattern[known], bend[known])[0, 1] > 0.9
    assert found.bins[0].systematic == pytest.approx(0.8 * SIGMA * found.bins[0].depth_m ** 2, rel=0.5)


def test_a_fixed_pattern_of_pixels_averages_over_area_but_not_over_time():
    """As the matching of a stereo camera on a still view: of one pixel, white, the same in each frame."""
    pattern = SIGMA * noise(np.random.default_rng(9), 0.0)
    found = calibrate(frames(12, floor_and_wall() + pattern))
    assert found.sigma(np.array(0.6)) == pytest.approx(np.sqrt(2) * SIGMA, rel=0.07)
    assert found.temporal == pytest.approx(np.sqrt(0.5), abs=0.06)
    assert found.systematic < 0.1
    assert found.bins[0].fixed == pytest.approx(SIGMA * found.bins[0].depth_m ** 2, rel=0.2)


def test_a_moving_camera_tells_all_but_what_stays():
    def moving():
        for k in range(6):
            yield from frames(1, floor_and_wall() + 0.03 * k, 1.5, seed=k)

    found = calibrate(moving())
    assert (found.static_frames, found.views) == (0, 6)
    assert "no 5 frames in a row stand still" in found.how
    assert found.sigma(np.array(0.7)) == pytest.approx(SIGMA, rel=0.08)
    assert found.correlation == pytest.approx(pixels_of(1.5), rel=0.3)
    assert np.isnan(found.temporal) and np.isnan(found.bins[0].temporal)


def test_what_was_measured_is_what_a_configuration_states():
    found = calibrate(frames(6, floor_and_wall(), 1.0))
    config = SegmenterConfig().replace(found.settings())
    (frame,) = frames(1, floor_and_wall(), 1.0, seed=5)
    noise_of = segment(frame, config).noise
    w = np.array([0.4, 0.7, 1.0])
    assert noise_of.range_sigma(w) == pytest.approx(found.sigma(w), rel=1e-3)
    assert noise_of.range_correlation == pytest.approx(found.correlation, rel=0.01)
    assert noise_of.range_systematic == pytest.approx(found.systematic, rel=0.01, abs=1e-3)


def test_things_in_front_and_missing_pixels_do_not_matter():
    rng = np.random.default_rng(3)
    w = floor_and_wall()
    w[100:160, 120:200] = 1.3 + 0.1 * np.sin(COLS[100:160, 120:200] / 9)
    w[rng.random(SHAPE) < 0.02] = np.nan
    found = calibrate(frames(8, w))
    assert found.sigma(np.array(0.6)) == pytest.approx(SIGMA, rel=0.1)
    assert found.correlation < 1.6 and found.systematic < 0.15


def test_what_cannot_be_measured_is_said():
    with pytest.raises(InputError, match="no frame"):
        calibrate([])
    points = np.random.default_rng(0).normal(1.0, 0.1, (48, 64, 3)).astype(np.float32)
    with pytest.raises(InputError, match="no camera"):
        calibrate([RangeColorFrame(points, np.zeros((48, 64, 3), np.uint8), None)])
    depth_m = np.random.default_rng(0).uniform(0.5, 5.0, (48, 64)).astype(np.float32)
    small = RangeColorFrame.from_depth(depth_m, np.zeros((48, 64, 3), np.uint8), CAMERA)
    with pytest.raises(InputError, match="another size"):
        calibrate([next(frames(1, floor_and_wall())), small])
