"""A scanner's grid resampled to a virtual pinhole camera: planes stay planes, steps stay steps."""

import numpy as np
import pytest
from scans import BALL_SURFACE, cast, frame_of, room_scan, spherical_rays

from rcseg_core import PinholeCamera, RangeColorFrame, SegmenterConfig
from rcseg_core.resampling.sampling import _slope, find_back, sample_inverse_depth
from rcseg_core.resampling.views import PinholeView, _back_to_all, pinhole_view
from rcseg_core.synthetic import make_scene

CONFIG = SegmenterConfig()


def view_of(frame):
    view = pinhole_view(frame, frame.color, CONFIG)
    assert view is not None
    return view


def truth_through(view, rays):
    """What the virtual camera would measure, if its axes are those of the middle of the grid."""
    camera, shape = view.frame.camera, view.frame.valid.shape
    corners = rays[[0, 0, -1, -1], [0, -1, 0, -1]].sum(axis=0)
    ahead = corners + rays[rays.shape[0] // 2, rays.shape[1] // 2]
    ahead /= np.linalg.norm(ahead)
    right = rays[:, -1].mean(axis=0) - rays[:, 0].mean(axis=0)
    right -= (right @ ahead) * ahead
    right /= np.linalg.norm(right)
    virtual = camera.rays(*shape).astype(float) @ np.stack([right, np.cross(ahead, right), ahead])
    lengths = np.linalg.norm(virtual, axis=-1, keepdims=True)
    range_m, surface = cast(virtual / lengths)
    return range_m / lengths[..., 0], surface


def test_inverse_depth_of_a_plane_is_linear_in_the_view():
    rays = spherical_rays(np.linspace(20, -30, 70), np.linspace(-40, 30, 90))
    range_m, _ = cast(rays, planes=[((0.3, 0.5, 1.0), 2.0)], boxes=(), ball=None)
    view = view_of(frame_of(rays, range_m))
    valid = view.frame.valid
    rows, cols = np.nonzero(valid)
    assert rows.size > rays[..., 0].size
    inverse = 1.0 / view.frame.depth_m[valid].astype(float)
    design = np.stack([np.ones(rows.size), rows, cols], axis=1)
    residual = inverse - design @ np.linalg.lstsq(design, inverse, rcond=None)[0]
    assert np.abs(residual).max() < 1e-4 * inverse.max()  # the nearest pixel's value would miss by 5e-3


def test_the_view_shows_what_a_camera_would_see():
    straight = spherical_rays(np.linspace(25, -35, 150), np.linspace(-35, 35, 190))
    range_m, _ = cast(straight)
    view = view_of(frame_of(straight, range_m))
    depth, surface = truth_through(view, straight)
    valid = view.frame.valid
    inner = np.ones_like(valid)  # two pixels and more from where surfaces meet
    for i in range(-2, 3):
        for j in range(-2, 3):
            inner &= np.roll(surface, (i, j), (0, 1)) == surface
    error = np.abs(view.frame.depth_m - depth) / depth
    assert valid.mean() > 0.75
    flat = inner & valid & (surface != BALL_SURFACE)
    assert np.quantile(error[flat], 0.999) < 2e-4
    assert np.quantile(error[inner & valid & (surface == BALL_SURFACE)], 0.95) < 2e-3


def test_nothing_floats_between_two_surfaces():
    rays = spherical_rays(np.linspace(20, -20, 60), np.linspace(-25, 25, 80))
    range_m = np.where(np.abs(np.arange(80) - 40) < 11, 1.0, 2.0) * np.ones((60, 1))
    range_m /= rays[..., 2]  # two walls at z = 1 and z = 2
    view = view_of(frame_of(rays, range_m))
    depth = view.frame.depth_m[view.frame.valid]
    assert (np.minimum(np.abs(depth - 1), np.abs(depth - 2)) < 5e-3).all()  # the axis is not quite z
    assert 500 < (depth < 1.5).sum() < depth.size / 2


def test_every_measured_pixel_has_the_virtual_pixel_that_shows_it():
    frame, _ = room_scan(90, 120, sigma=0.001)
    points = np.array(frame.points)
    points[np.random.default_rng(2).random((90, 120)) < 0.3] = np.nan
    frame = RangeColorFrame(points, frame.color)
    view = view_of(frame)
    assert ((view.back >= 0) == frame.valid).all()
    back = view.back[frame.valid]
    assert view.frame.valid.ravel()[back].all()
    depth = view.frame.depth_m.ravel()[back]
    # the virtual axis is (nearly) that of the middle of the grid, 5 degrees down
    ahead = np.array([0, np.sin(np.deg2rad(5)), np.cos(np.deg2rad(5))])
    wanted = points[frame.valid] @ ahead
    near = np.abs(depth - wanted) / wanted
    assert np.quantile(near, 0.95) < 0.02
    rows, cols = np.divmod(back, view.frame.width)
    camera = view.frame.camera
    assert np.bincount(back).max() <= 4
    assert np.ptp(cols / camera.fx) == pytest.approx(2 * np.tan(np.deg2rad(35)), rel=0.1)
    assert rows.max() == view.frame.height - 1 or rows.min() == 0


def test_colours_come_from_the_pixel_that_is_seen():
    rays = spherical_rays(np.linspace(20, -20, 60), np.linspace(-25, 25, 80))
    color = np.zeros((60, 80, 3), np.uint8)
    color[..., 0], color[..., 1] = np.arange(60)[:, None], np.arange(80)[None]
    view = view_of(frame_of(rays, cast(rays)[0], color=color))
    seen = view.frame.color.reshape(-1, 3)[view.back]
    assert (np.abs(seen.astype(int) - color) <= 1).all()
    assert (seen == color).all(axis=-1).mean() > 0.95


@pytest.mark.parametrize("kind", ["auto", "inverse_depth", "xyz"])
def test_only_grids_without_camera_get_a_view(kind):
    config = CONFIG.replace({"signal.kind": kind})
    frame, _ = room_scan(60, 80)
    assert (pinhole_view(frame, frame.color, config) is None) == (kind == "xyz")
    seen = make_scene("room", 41, width=160, height=120).frame
    assert pinhole_view(seen, seen.color, config) is None
    cloud = RangeColorFrame(seen.points, seen.color)
    view = pinhole_view(cloud, cloud.color, config)
    if kind != "xyz":
        assert isinstance(view.frame.camera, PinholeCamera)
        np.testing.assert_array_equal(view.frame.depth_m, seen.depth_m)
        np.testing.assert_array_equal(view.back[seen.valid], np.flatnonzero(seen.valid))


@pytest.mark.parametrize(
    ("elevation", "azimuth"),
    [
        (np.linspace(15, -15, 32), np.linspace(-170, 170, 360)),
        (np.linspace(15, -15, 32), np.linspace(-75, 75, 150)),
        (np.linspace(80, -80, 90), np.linspace(-30, 30, 40)),
    ],
    ids=["all round", "150 degrees", "up and down"],
)
def test_fields_beyond_a_pinhole_camera_get_no_view(elevation, azimuth):
    rays = spherical_rays(elevation, azimuth)
    frame = frame_of(rays, np.full(rays.shape[:2], 2.0))
    assert pinhole_view(frame, frame.color, CONFIG) is None


def test_no_region_gets_lost_between_the_pixels_of_the_grid():
    labels = np.array([[1, 1, 2, 1, 3, 3, 4, 0]], np.int32)
    source = np.array([[0, 1, 1, 2, 3, 4, 4, -1]])
    view = PinholeView(None, np.array([[0, 1, 3, 4, 5, -1]]), source, 0.0)  # 2 and 4 are shown by no pixel
    back = _back_to_all(view, labels)
    assert back.tolist() == [[0, 2, 3, 4, 6, -1]]
    assert view.back.tolist() == [[0, 1, 3, 4, 5, -1]]


def test_the_slope_is_the_monotonised_central_difference():
    assert _slope(1.0, 2.0, 3.0) == 1.0
    assert _slope(1.0, 2.0, 2.5) == 0.75  # the mean, while it is under twice the smaller side
    assert _slope(1.0, 1.1, 9.0) == pytest.approx(0.2)  # beside a step: twice the smaller side
    assert _slope(9.0, 1.1, 1.0) == pytest.approx(-0.2)
    assert _slope(1.0, 2.0, 1.5) == 0.0  # a peak is noise
    assert _slope(0.0, 2.0, 2.5) == 0.5  # one neighbour unknown
    assert _slope(1.5, 2.0, 0.0) == 0.5
    assert _slope(0.0, 2.0, 0.0) == 0.0


def test_samples_are_the_nearest_value_moved_by_its_slope():
    rng = np.random.default_rng(3)
    plane = 1.0 + 0.01 * np.arange(12)[:, None] - 0.02 * np.arange(9)[None]
    plane[4, 5] = 0.0
    rows, cols = rng.uniform(-0.5, 11.49, (20, 30)), rng.uniform(-0.5, 8.49, (20, 30))
    rows[0, 0], cols[1, 1] = np.nan, np.nan
    shown, source = np.empty((20, 30)), np.empty((20, 30), np.int64)
    sample_inverse_depth(plane, rows, cols, shown, source)
    inside = np.isfinite(rows) & np.isfinite(cols)
    assert (source[~inside] == -1).all() and (shown[~inside] == 0).all()
    nearest = np.rint(rows[inside]).astype(int) * 9 + np.rint(cols[inside]).astype(int)
    np.testing.assert_array_equal(source[inside], nearest)
    hole = source == 4 * 9 + 5
    assert hole.any() and (shown[hole] == 0).all()
    wanted = 1.0 + 0.01 * rows - 0.02 * cols
    np.testing.assert_allclose(shown[inside & ~hole], wanted[inside & ~hole], atol=1e-12)


def test_back_is_the_nearest_sample_or_the_most_alike_beside_it():
    inverse = np.array([[1.0, 1.0, 1.0, 2.0, 2.0, 0.0]])
    rows, cols = np.zeros((1, 5)), np.array([[0.1, 0.4, 2.2, 4.0, 5.0]])
    shown, source = np.empty((1, 5)), np.empty((1, 5), np.int64)
    sample_inverse_depth(inverse, rows, cols, shown, source)
    at_x, at_y = np.array([[0.0, 1.0, 2.0, 2.5, 3.0, 4.0]]), np.zeros((1, 6))
    back = np.empty((1, 6), np.int64)
    find_back(inverse, at_x, at_y, rows, cols, shown, source, back)
    # pixel 0 was sampled twice; 1 and 3 never: 1 takes a like pixel beside it, 3 the wall of its own depth
    assert back[0].tolist() == [0, 0, 2, 3, 3, -1]
