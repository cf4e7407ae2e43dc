"""Coarse to fine: squares average one side of a depth edge; the result holds at full size throughout."""

import cv2
import numpy as np
import pytest

from rcseg_core import PinholeCamera, RangeColorFrame, SegmenterConfig, segment
from rcseg_core.compute import parallel
from rcseg_core.resampling import reduction
from rcseg_core.resampling.reduction import reduced
from rcseg_core.signal.signals import local_scales, measured_again
from rcseg_core.synthetic import make_scene

CAMERA = PinholeCamera(250.0, 240.0, 79.5, 59.5)


def frame_of(depth_m, color=None, camera=CAMERA):
    color = np.full((*depth_m.shape, 3), 100, np.uint8) if color is None else color
    return RangeColorFrame.from_depth(depth_m, color, camera)


@pytest.mark.parametrize("step", [2, 3, 4])
def test_the_mean_of_a_plane_is_the_plane_at_the_middle_of_the_square(step):
    """Inverse depth of a plane is linear in the pixel, and so is its mean; the small camera sees the same."""
    rows, cols = np.mgrid[:120, :160]
    inverse = 0.5 + 1e-3 * (cols - 80) - 5e-4 * (rows - 60)
    small = reduced(frame := frame_of(1.0 / inverse), frame.color, step)
    assert small.points.shape[:2] == (-(-120 // step), -(-160 // step))
    whole = small.points[: 120 // step, : 160 // step]
    middle = (step - 1) / 2.0
    i, j = np.mgrid[: whole.shape[0], : whole.shape[1]]
    wanted = 0.5 + 1e-3 * (j * step + middle - 80) - 5e-4 * (i * step + middle - 60)
    np.testing.assert_allclose(1.0 / whole[..., 2], wanted, rtol=1e-6)
    np.testing.assert_allclose(whole[..., 0] / whole[..., 2], (j * step + middle - 79.5) / 250.0, atol=1e-6)
    np.testing.assert_allclose(whole[..., 1] / whole[..., 2], (i * step + middle - 59.5) / 240.0, atol=1e-6)


def test_a_camera_that_changes_all_the_time_leaves_nothing_behind():
    """A live calibration may jitter in its last digit."""
    depth_m = np.full((40, 40), 1.0)
    for i in range(20):
        frame = frame_of(depth_m, camera=PinholeCamera(250.0 + 1e-9 * i, 240.0, 19.5, 19.5))
        reduced(frame, frame.color, 2)
        reduction.unreduced(SegmenterConfig().replace({"grouping.noise_share": 0.5 + 1e-9 * i}))
    assert reduction._rays.cache_info().currsize <= 4
    assert reduction.unreduced.cache_info().currsize <= 16


def test_a_square_takes_the_side_that_more_of_it_lies_on_and_its_colour():
    depth_m, color = np.full((40, 40), 1.0), np.full((40, 40, 3), 50, np.uint8)
    depth_m[:, 11:], color[:, 11:] = 2.0, 200  # of columns 9 to 11 two are near
    small = reduced(frame_of(depth_m, color), color, 3)
    np.testing.assert_allclose(small.points[:-1, 3, 2], 1.0, rtol=1e-6)
    assert (small.color[:-1, 3] == 50).all()
    np.testing.assert_allclose(small.points[:-1, 4, 2], 2.0, rtol=1e-6)
    depth_m[0:3, 0:3] = np.nan
    depth_m[1, 1] = 1.5
    small = reduced(frame_of(depth_m, color), color, 3)
    assert small.points[0, 0, 2] == pytest.approx(1.5)
    depth_m[0:3, 0:3] = np.nan
    small = reduced(frame_of(depth_m, color), color, 3)
    assert np.isnan(small.points[0, 0]).all() and (small.color[0, 0] == 50).all()


def test_points_without_a_camera_are_averaged_as_they_are():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(32, 36, 3)) + np.array([0, 0, 500])
    small = reduced(
        RangeColorFrame(points, np.zeros(points.shape, np.uint8)), np.zeros(points.shape, np.uint8), 4
    )
    wanted = points.reshape(8, 4, 9, 4, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(small.points, wanted, rtol=1e-5, atol=1e-5)


def board(sigma, levels, blur, seed=0):
    """A tilted board with inverse depth noise, blurred over some pixels, and white colour noise."""
    rng = np.random.default_rng(seed)
    noise = (
        cv2.GaussianBlur(rng.normal(size=(240, 320)), (0, 0), blur) if blur else rng.normal(size=(240, 320))
    )
    cols = np.arange(320)
    color = np.clip(np.rint(rng.normal(120, levels, (240, 320, 3))), 0, 255).astype(np.uint8)
    return frame_of(1 / (0.5 + 5e-4 * cols + sigma * noise / noise.std()), color)


@pytest.mark.parametrize(("step", "blur"), [(2, 0.0), (2, 0.8), (2, 1.2), (3, 0.0)])
@pytest.mark.parametrize("stated", [False, True])
def test_a_pixel_has_its_own_noise_of_range_and_of_colour(monkeypatch, step, blur, stated):
    """Range noise hangs together over pixels and hardly averages away; that of the colour does."""
    seen = []

    def spied(*arguments):
        seen.append(measured_again(*arguments))
        return seen[-1]

    monkeypatch.setattr(reduction, "measured_again", spied)
    sigma_m, levels = 0.02, 8.0
    frame = board(4e-3, levels, blur)
    changes = {"signal.reduction": step}
    if stated:
        changes |= {
            "noise.range_model": "constant", "noise.range_sigma": sigma_m, "noise.color_sigma": levels
        }  # fmt: skip
    segment(frame, SegmenterConfig().replace(changes))
    signals = seen[0]
    assert signals.scale[1:] == pytest.approx(levels, rel=0.01 if stated else 0.15)
    w = signals.offset[0]
    assert signals.scale[0] == pytest.approx(sigma_m * w * w if stated else 4e-3, rel=0.01 if stated else 0.2)
    assert local_scales(signals.law, 0.0)[0] == pytest.approx(1.0)


@pytest.fixture(scope="module", params=[2, 3])
def case(request):
    scene = make_scene("room", 41, width=333, height=250, dropout=0.05)
    config = SegmenterConfig().replace({"signal.reduction": request.param})
    return scene, config, segment(scene.frame, config)


def test_labels_come_back_at_full_size_on_measured_pixels(case):
    scene, _, result = case
    assert result.labels.shape == result.surface_labels.shape == result.edges.shape == (250, 333)
    assert not result.labels[~scene.frame.valid].any()
    assert (result.labels[scene.frame.valid] > 0).mean() > 0.99
    sizes = np.bincount(result.labels.ravel())[1:]
    assert (sizes > 0).all() and (np.diff(sizes) <= 0).all()
    for label in range(1, result.labels.max() + 1):
        assert len(np.unique(result.surface_labels[result.labels == label])) == 1


def test_borders_follow_the_full_image(case):
    """Nearest-neighbour labels of the small image would be off by up to half a square."""
    scene, _, result = case
    agree = 0
    for label in range(1, int(result.labels.max()) + 1):
        agree += np.bincount(scene.labels[result.labels == label]).max()
    assert agree / np.count_nonzero(result.labels) > 0.98


def test_regions_and_reconstruction_are_those_of_the_full_image(case):
    scene, _, result = case
    assert [r.label for r in result.regions] == list(range(1, int(result.labels.max()) + 1))
    for region in result.regions:
        rows, cols = np.nonzero(result.labels == region.label)
        assert region.pixel_count == rows.size
        assert region.box == (rows.min(), cols.min(), rows.max(), cols.max())
        assert region.surface == result.surface_labels[rows[0], cols[0]]
    points, _ = result.reconstruct()
    error = np.abs(points[..., 2] - scene.frame.depth_m)[result.labels > 0]
    direct = segment(scene.frame).reconstruct()[0]
    usual = np.abs(direct[..., 2] - scene.frame.depth_m)[result.labels > 0]
    assert np.nanmedian(error) < 1.1 * np.nanmedian(usual)


def test_coarser_and_finer_levels_are_nested(case):
    _, _, result = case
    before = result.labels_at(0.5)
    for level in (1.0, 2.0, 8.0):
        labels = result.labels_at(level)
        for label in range(1, int(before.max()) + 1):
            assert len(np.unique(labels[before == label])) == 1
        before = labels


def test_results_repeat_on_any_number_of_threads(case):
    scene, config, result = case
    try:
        for number in (1, 3):
            parallel.set_threads(number)
            again = segment(scene.frame, config)
            assert np.array_equal(again.labels, result.labels)
            assert np.array_equal(again.leaves, result.leaves)
    finally:
        parallel.set_threads(0)


def test_small_images_are_segmented_as_they_are():
    scene = make_scene("blocks", 3, width=40, height=30)
    fast = segment(scene.frame, SegmenterConfig().replace({"signal.reduction": 4}))
    assert np.array_equal(fast.labels, segment(scene.frame).labels)
