"""Whitening: every residual counts in sigmas, can be turned back, and impulses are flagged, not moved."""

import numpy as np
import pytest

from rcseg_core import ConfigError, PinholeCamera, RangeColorFrame, SegmenterConfig
from rcseg_core.signal.signals import (
    COLOR_OUTLIER,
    INVALID,
    RANGE_OUTLIER,
    build_signals,
    local_scales,
    scales,
)
from rcseg_core.signal.units import UNIT_PX

SHAPE = (60, 80)
CAMERA = PinholeCamera(70.0, 70.0, 39.5, 29.5)


def frame(kind="camera", seed=0, sigma=2e-3, holes=0.0, impulses=0.0):
    rng = np.random.default_rng(seed)
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    w = 0.5 + 1e-3 * cols + 5e-4 * rows + sigma * rng.normal(size=SHAPE)
    color = np.clip(100 + 0.5 * cols[..., None] + rng.normal(0, 4, (*SHAPE, 3)), 0, 255)
    wild, wild_color = rng.random((2, *SHAPE)) < impulses
    w[wild] *= rng.choice([0.4, 2.5], wild.sum())
    color[wild_color] += 90
    depth = np.where(rng.random(SHAPE) < holes, np.nan, 1 / w)
    made = RangeColorFrame.from_depth(depth, color.astype(np.uint8), CAMERA)
    if kind == "scanner":
        made = RangeColorFrame(made.points, made.color, None)
    return made, wild, wild_color


def built(made, **changes):
    return build_signals(made, made.color, SegmenterConfig().replace(changes))


@pytest.mark.parametrize("kind", ["camera", "scanner"])
def test_the_image_turns_back_into_the_sensor_signals(kind):
    made, _, _ = frame(kind, holes=0.1)
    signals = built(made)
    raw = signals.image * signals.scale + signals.offset
    wanted = 1 / made.points[..., 2:] if kind == "camera" else made.points
    valid = made.valid
    np.testing.assert_allclose(raw[valid][:, : signals.n_range], wanted[valid], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(raw[..., signals.n_range :], made.color, atol=1e-3)
    assert np.array_equal(signals.flags & INVALID != 0, ~valid)
    assert not signals.image[~valid][:, : signals.n_range].any()
    assert np.isfinite(signals.image).all() and np.isfinite(signals.cleaned).all()


def test_noise_has_unit_variance_after_whitening():
    made, _, _ = frame()
    signals = built(made)
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    table = np.stack([np.ones(rows.size), rows.ravel(), cols.ravel()], 1)
    for c in range(4):
        values = signals.image[..., c].ravel().astype(float)
        rest = values - table @ np.linalg.lstsq(table, values, rcond=None)[0]
        assert rest.std() == pytest.approx(1.0, abs=0.12)


def test_law_and_tolerances_are_in_sigmas_of_the_local_depth():
    made, _, _ = frame()
    tolerance, levels = 0.01, 12.0
    signals = built(
        made,
        **{
            "noise.range_model": "constant", "noise.range_sigma": 0.005, "noise.color_sigma": 4.0,
            "grouping.range_tolerance": tolerance, "grouping.color_tolerance": levels,
        },
    )  # fmt: skip
    for w in (0.5, 0.55, 0.6):
        var, eps2 = local_scales(signals.law, (w - signals.offset[0]) / signals.scale[0])
        # sigma_w = sigma_z w^2; a share t of depth is a share t of inverse depth
        assert np.sqrt(var) * signals.scale[0] == pytest.approx(0.005 * w**2, rel=1e-6)
        assert np.sqrt(eps2) * signals.scale[0] == pytest.approx(tolerance * w, rel=1e-6)
    assert signals.color_eps2 == pytest.approx((levels / 4.0) ** 2)
    slope = (
        signals.slope[0] + signals.slope[1] * (0.5 - signals.offset[0]) / signals.scale[0]
    ) * signals.scale[0]
    assert slope == pytest.approx(0.5 * UNIT_PX / 70.0)


@pytest.mark.parametrize("model", ["auto", "constant"])
@pytest.mark.parametrize("far_m", [2.0, 3.0, 4.0, 8.0])
def test_constant_depth_noise_holds_far_behind_a_near_board(model, far_m):
    """Most of the frame shows a board at 0.8 m: the wall has the noise of its own depth all the same."""
    sigma_m = 0.004
    depth = np.full((240, 320), far_m)
    depth[:, :200] = 0.8
    depth += np.random.default_rng(1).normal(0.0, sigma_m, depth.shape)
    color = np.random.default_rng(2).normal(120, 3, (240, 320, 3)).astype(np.uint8)
    made = RangeColorFrame.from_depth(depth, color, PinholeCamera(280.0, 280.0, 159.5, 119.5))
    signals = built(made, **{"noise.range_model": model, "noise.range_sigma": sigma_m})
    for z in (0.8, far_m):
        value = (1 / z - signals.offset[0]) / signals.scale[0]
        assumed = np.sqrt(local_scales(signals.law, value)[0]) * signals.scale[0]
        assert assumed == pytest.approx(sigma_m / z**2, rel=0.2)
        variance, _ = scales(signals.law, np.array([value]))
        assert variance[0] == local_scales(signals.law, value)[0]
    # what was measured of the wall, in the sigmas that it is judged by
    wall = signals.image[20:-20, 220:-20, 0].astype(float)
    variance = local_scales(signals.law, wall.mean())[0]
    assert wall.var() / variance == pytest.approx(1.0, rel=0.4)


@pytest.mark.parametrize("model", ["constant", "kinect_v1", "realsense_d435"])
def test_no_law_gives_a_variance_of_zero_or_less_anywhere(model):
    made, _, _ = frame()
    signals = built(made, **{"noise.range_model": model, "noise.range_sigma": 0.005})
    values = (np.linspace(-5.0, 5.0, 1001) - signals.offset[0]) / signals.scale[0]
    variance, tolerance2 = scales(signals.law, values)
    assert (variance > 0).all() and (tolerance2 >= 0).all()


def test_impulses_are_flagged_in_their_own_signal_and_replaced_for_the_filters_only():
    made, wild, wild_color = frame(impulses=0.08)
    signals = built(made)
    found, found_color = signals.flags & RANGE_OUTLIER != 0, signals.flags & COLOR_OUTLIER != 0
    assert found[wild].mean() > 0.98
    assert found[~wild].mean() < 0.01
    assert found_color[wild_color].mean() > 0.9
    assert found_color[~wild_color].mean() < 0.02
    assert (np.abs(signals.image[..., 0] - signals.cleaned[..., 0])[wild & found] > 6).all()
    same = ~found & (signals.flags & INVALID == 0)
    assert np.array_equal(signals.image[same][:, 0], signals.cleaned[same][:, 0])
    unflagged = built(made, **{"edges.outlier_threshold": 0.0})
    assert not (unflagged.flags & ~np.uint8(INVALID)).any()


def test_the_rim_of_a_steep_plane_is_no_impulse():
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    w = 0.5 + 2e-3 * cols + 4e-3 * rows + 1e-4 * np.random.default_rng(0).normal(size=SHAPE)
    made = RangeColorFrame.from_depth(1 / w, np.full((*SHAPE, 3), 90, np.uint8), CAMERA)
    assert not (built(made).flags & RANGE_OUTLIER).any()


def test_parts_of_the_signals_keep_their_own_flags():
    made, _, _ = frame(impulses=0.05, holes=0.05)
    signals = built(made)
    only_range, only_color = signals.range_only(), signals.color_only()
    assert np.array_equal(only_range.image, signals.image[..., :1])
    assert np.array_equal(only_color.image, signals.image[..., 1:])
    assert not (only_range.flags & COLOR_OUTLIER).any() and not (only_color.flags & RANGE_OUTLIER).any()
    assert np.array_equal(only_color.flags & INVALID, signals.flags & INVALID)
    assert only_range.scale.shape == (1,) and only_color.scale.shape == (3,)
    assert only_color.n_range == 0


def test_inverse_depth_needs_a_camera_and_xyz_can_be_asked_for():
    made, _, _ = frame("scanner")
    with pytest.raises(ConfigError, match=r"signal\.kind = inverse_depth needs a camera"):
        built(made, **{"signal.kind": "inverse_depth"})
    assert built(made).n_range == 3
    with_camera, _, _ = frame("camera")
    assert built(with_camera).n_range == 1
    assert built(with_camera, **{"signal.kind": "xyz"}).n_range == 3
