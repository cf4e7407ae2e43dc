"""Depth drawn into another camera's view, beside rays that are cast into the same scene from there."""

import numpy as np
import pytest

from rcseg_core import InputError, PinholeCamera
from rcseg_core.registration import render_depth

SOURCE, SOURCE_SIZE = PinholeCamera(60.0, 61.0, 39.5, 29.5), (60, 80)
TARGETS = {  # camera, (height, width), translation of the source's origin, turn about y in rad
    "beside it": (PinholeCamera(60.0, 61.0, 39.5, 29.5), (60, 80), (0.06, 0.0, 0.0), 0.0),
    "finer": (PinholeCamera(110.0, 112.0, 70.0, 50.0), (100, 140), (-0.05, 0.02, 0.01), 0.05),
    "coarser": (PinholeCamera(35.0, 34.0, 20.5, 14.0), (30, 40), (0.04, -0.05, -0.02), -0.1),
    "on its side": (PinholeCamera(60.0, 61.0, 29.5, 39.5), (80, 60), (0.05, 0.01, 0.0), 0.04),
}


def cast(origin, rays):
    """Distance along each ray (z = 1 in its camera: the depth) and which surface is hit: 0 a slanted wall,
    1 a board before it, 2 a ball, 3 a bar of a pixel or two."""
    with np.errstate(divide="ignore", invalid="ignore"):
        wall = (2.4 - origin @ (0.3, 0.1, 1.0)) / (rays @ np.array((0.3, 0.1, 1.0)))
        board = (1.2 - origin[2]) / rays[..., 2]
        at = origin + board[..., None] * rays
        board[~((np.abs(at[..., 0] + 0.3) < 0.25) & (np.abs(at[..., 1]) < 0.3))] = np.inf
        bar = (1.3 - origin[2]) / rays[..., 2]
        at = origin + bar[..., None] * rays
        bar[~((np.abs(at[..., 0] - 0.1) < 0.016) & (np.abs(at[..., 1]) < 0.5))] = np.inf
        away = origin - np.array((0.3, 0.1, 1.6))
        a, b, c = (rays**2).sum(axis=-1), rays @ away, away @ away - 0.25**2
        ball = np.where(b * b > a * c, (-b - np.sqrt(b * b - a * c)) / a, np.inf)
    hits = np.stack([wall, board, ball, bar])
    hits[~(hits > 0)] = np.inf
    return hits.min(axis=0), hits.argmin(axis=0)


def turned(translation, angle):
    c, s = np.cos(angle), np.sin(angle)
    pose = np.eye(4)
    pose[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    pose[:3, 3] = translation
    return pose


def source_points(pose):
    """The scene as the source sees it, in the target's frame (which is the scene's)."""
    rays = SOURCE.rays(*SOURCE_SIZE) @ pose[:3, :3].T
    depth, _ = cast(pose[:3, 3], rays)
    return pose[:3, 3] + depth[..., None] * rays, depth


def visible_from(pose, points):
    """Whether nothing lies between the source and a point, and the point is in the source's image."""
    rays = points - pose[:3, 3]
    hit, _ = cast(pose[:3, 3], rays)
    seen = rays @ pose[:3, :3]
    col = SOURCE.fx * seen[..., 0] / seen[..., 2] + SOURCE.cx
    row = SOURCE.fy * seen[..., 1] / seen[..., 2] + SOURCE.cy
    height, width = SOURCE_SIZE
    inside = (col >= 0) & (col <= width - 1) & (row >= 0) & (row <= height - 1)
    return inside & (hit > 1 - 1e-6)


def away_from_borders(*images, by):
    """Pixels around which none of the images changes within `by` pixels."""
    calm = np.ones(images[0].shape, bool)
    for image in images:
        for i in range(-by, by + 1):
            for j in range(-by, by + 1):
                calm &= np.roll(image, (i, j), (0, 1)) == image
    calm[:by], calm[-by:], calm[:, :by], calm[:, -by:] = False, False, False, False
    return calm


@pytest.mark.parametrize("name", TARGETS)
def test_it_is_what_rays_from_there_meet(name):
    camera, size, translation, angle = TARGETS[name]
    pose = turned(translation, angle)
    points, _ = source_points(pose)
    drawn = render_depth(points.astype(np.float32), camera, *size)
    rays = camera.rays(*size).astype(float)
    depth, surface = cast(np.zeros(3), rays)
    seen = visible_from(pose, depth[..., None] * rays)
    inner = away_from_borders(np.where(surface == 3, 0, surface), seen, by=3) & (surface != 3)
    assert (inner & seen).mean() > 0.15
    assert np.isfinite(drawn[inner & seen]).all(), "a hole in a surface that both see"
    assert np.isnan(drawn[inner & ~seen]).all(), "depth where the first sensor saw nothing"
    flat = inner & seen & (surface < 2)
    np.testing.assert_allclose(drawn[flat], depth[flat], rtol=1e-3)
    ball = inner & seen & (surface == 2)
    np.testing.assert_allclose(drawn[ball], depth[ball], rtol=2e-2)


@pytest.mark.parametrize("name", TARGETS)
def test_nothing_floats_and_nothing_shines_through(name):
    """Each depth is that of one of the surfaces on the pixel's ray, and of the foremost but for rims."""
    camera, size, translation, angle = TARGETS[name]
    points, _ = source_points(turned(translation, angle))
    drawn = render_depth(points, camera, *size)
    rays = camera.rays(*size).astype(float)
    depth, surface = cast(np.zeros(3), rays)
    wall = 2.4 / (rays @ np.array((0.3, 0.1, 1.0)))
    on_some = np.isnan(drawn) | (surface == 2) | (np.abs(drawn - wall) < 0.03)
    for z in (1.2, 1.3):
        on_some |= np.abs(drawn - z) < 0.05
    assert on_some[away_from_borders(np.where(surface == 2, 2, 0), by=2)].all()
    behind = np.isfinite(drawn) & (drawn > depth * 1.1) & (surface != 3)
    assert not behind[away_from_borders(surface, by=2)].any()


@pytest.mark.parametrize("name", TARGETS)
def test_bars_of_a_pixel_stay_whole(name):
    camera, size, translation, angle = TARGETS[name]
    points, _ = source_points(turned(translation, angle))
    drawn = render_depth(points, camera, *size)
    _, surface = cast(np.zeros(3), camera.rays(*size).astype(float))
    bar = np.abs(drawn - 1.3) < 0.05
    rows = np.flatnonzero((surface == 3).any(axis=1))[3:-3]
    assert rows.size > 8
    assert bar[rows].any(axis=1).all(), "a gap in the bar"


def test_the_own_view_gives_the_own_depth_bit_for_bit_but_rounding():
    points, depth = source_points(np.eye(4))
    holes = np.random.default_rng(1).random(depth.shape) < 0.2
    points[holes] = np.nan
    drawn = render_depth(points, SOURCE, *SOURCE_SIZE)
    np.testing.assert_array_equal(np.isnan(drawn), holes)
    np.testing.assert_allclose(drawn[~holes], depth[~holes], rtol=1e-6)


def test_noise_and_slopes_leave_no_hole_in_a_plane():
    rays = SOURCE.rays(*SOURCE_SIZE).astype(float)
    slanted = 1.0 / (rays @ np.array((0.9, 0.0, 0.6)))
    slanted[~((slanted > 0) & (slanted < 5))] = np.nan
    noisy = slanted + np.random.default_rng(3).normal(0, 1, slanted.shape) * 0.005 * slanted**2
    camera, size = PinholeCamera(100.0, 100.0, 66.0, 49.5), (100, 132)
    drawn = render_depth(noisy[..., None] * rays, camera, *size)
    truth = 1.0 / (camera.rays(*size) @ np.array((0.9, 0.0, 0.6)))
    inside = (truth > 0) & (truth < 3)
    inside[:2], inside[-2:], inside[:, :2], inside[:, -2:] = False, False, False, False
    assert np.isfinite(drawn[inside]).mean() > 0.995
    assert np.nanmedian(np.abs(drawn[inside] - truth[inside]) / truth[inside]) < 0.006


def test_points_that_no_image_holds_are_left_out():
    points = np.full((4, 4, 3), np.nan)
    points[0] = [[0, 0, -1], [0, 0, 0], [np.inf, 0, 1], [0, 0, np.inf]]
    points[2, 2] = [1e30, 0, 1e-20]
    assert np.isnan(render_depth(points, SOURCE, *SOURCE_SIZE)).all()
    points[2, 2] = [0, 0, 1.5]
    drawn = render_depth(points, SOURCE, *SOURCE_SIZE)
    assert 1 <= np.isfinite(drawn).sum() <= 4 and np.nanmax(drawn) == 1.5
    with pytest.raises(InputError, match="grid"):
        render_depth(points.reshape(1, -1, 3), SOURCE, *SOURCE_SIZE)
