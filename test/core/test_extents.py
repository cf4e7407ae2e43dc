"""Boxes and mean colours of regions: against plain sums over their pixels, and of a known rectangle."""

import numpy as np
import pytest

from rcseg_core import BezierPatch, RangeColorFrame, Region, segment
from rcseg_core.result.extents import SAMPLES, region_extents
from rcseg_core.synthetic import make_scene


def region(label, pixels, measured=True):
    control = np.zeros((3, 2, 2))
    patch = BezierPatch("xyz", 1, control, control, np.eye(3), (0, 0, 1, 1))
    centroid = np.zeros(3) if measured else np.full(3, np.nan)
    return Region(label, 1, pixels, (0, 0, 1, 1), centroid, np.zeros(3), (), patch, patch)


@pytest.mark.parametrize("far_m", [0.0, 5e5])
def test_a_known_rectangle(far_m):
    """2 x 1 m turned by 30 degrees, near the sensor and in coordinates of a map; a region without points."""
    angle = np.deg2rad(30)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    middle = np.array([0.3 + far_m, -0.2, 4.0])
    labels = np.ones((60, 80), np.int32)
    labels[:, 40:] = 2
    labels[[20, 20, 39, 39], [15, 24, 15, 24]] = 0  # in all four quarters, so that the axes stay
    rows, cols = np.mgrid[:60, :80]
    flat = np.stack([2 * cols / 39 - 1, rows / 59 - 0.5, np.zeros((60, 80))], -1)
    surface = flat @ turn.T + middle
    surface[[10, 10, 49, 49], [10, 29, 10, 29]] = np.nan  # behind the camera
    color = np.full((60, 80, 3), (10, 20, 30), np.uint8)
    one = region(1, 2396)
    one.centroid[:] = middle + 0.2
    extents = region_extents(color, labels, [one, region(2, 2400, measured=False)], surface)
    exact = 1e-9 * (1 + far_m)
    np.testing.assert_allclose(extents.size[0], (2.0, 1.0, 0.0), atol=exact)
    np.testing.assert_allclose(extents.center[0], middle, atol=exact)
    np.testing.assert_allclose(abs(extents.axes[0].T @ turn), np.eye(3), atol=exact)
    assert np.linalg.det(extents.axes[0]) == pytest.approx(1)
    assert extents.axes[0][2, 2] < 0, "z towards the sensor"
    np.testing.assert_allclose(extents.mean_color, [(10, 20, 30)] * 2)
    assert np.isnan(extents.size[1]).all() and np.isnan(extents.center[1]).all()
    np.testing.assert_array_equal(extents.axes[1], np.eye(3))


@pytest.mark.parametrize("family", ["room", "curved"])
def test_regions_of_a_scene_against_sums_over_their_pixels(family):
    frame = make_scene(family, 3, width=240, height=180).frame
    result = segment(frame)
    surface, _ = result.reconstruct()
    extents = region_extents(frame.color, result.labels, result.regions, surface)
    for i, one in enumerate(result.regions):
        mine = result.labels == one.label
        np.testing.assert_allclose(extents.mean_color[i], frame.color[mine].mean(axis=0))
        points = surface[mine].astype(float)[:: max(1, one.pixel_count // SAMPLES)]
        points = points[np.isfinite(points).all(axis=1)]
        spread = np.cov(points.T, bias=True)
        box = extents.axes[i].T @ spread @ extents.axes[i]
        np.testing.assert_allclose(box - np.diag(np.diag(box)), 0, atol=1e-9 * spread.max())
        assert np.diff(np.diag(box)).max() <= 1e-9, "the largest spread first"
        along = (points - extents.center[i]) @ extents.axes[i]
        np.testing.assert_allclose(along.max(axis=0), extents.size[i] / 2, atol=1e-7)
        np.testing.assert_allclose(along.min(axis=0), -extents.size[i] / 2, atol=1e-7)


def test_no_regions():
    frame = RangeColorFrame(np.ones((4, 5, 3), np.float32), np.zeros((4, 5, 3), np.uint8))
    extents = region_extents(frame.color, np.zeros((4, 5), np.int32), [], frame.points)
    assert extents.mean_color.shape == extents.center.shape == extents.size.shape == (0, 3)
    assert extents.axes.shape == (0, 3, 3)
