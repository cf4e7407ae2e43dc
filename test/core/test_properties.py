"""Symmetries of segment(): what may not change the result, and how little raster order does."""

import numpy as np
import pytest

from rcseg_core import PinholeCamera, RangeColorFrame, SegmenterConfig, segment
from rcseg_core.evaluation.agreement import covering, rand_indices
from rcseg_core.evaluation.hoover import contingency
from rcseg_core.synthetic import make_scene

SIZE = {"width": 160, "height": 120}
FAMILIES = ("room", "blocks", "curved", "painting")


@pytest.fixture(scope="module", params=FAMILIES)
def scene(request):
    return make_scene(request.param, 102, **SIZE)


@pytest.fixture(scope="module")
def labels(scene):
    return segment(scene.frame).labels


def rand(one, other):
    """Share of pixel pairs that both partitions treat alike."""
    return rand_indices(contingency(one, other).counts)[0]


def segmented(points, color, camera, **changes):
    frame = RangeColorFrame(np.ascontiguousarray(points), np.ascontiguousarray(color), camera)
    return segment(frame, SegmenterConfig().replace(changes)).labels


def test_a_mirrored_image_gives_the_mirrored_partition(scene, labels):
    """Windows are placed in raster order, which a mirror turns round: seeds differ, regions hardly do.

    The honest claim is a Rand index of .98 (measured on four families: .99 and more), not equality.
    """
    frame = scene.frame
    points, camera = frame.points[:, ::-1].copy(), frame.camera
    points[..., 0] *= -1
    if camera is not None:
        camera = PinholeCamera(camera.fx, camera.fy, frame.width - 1 - camera.cx, camera.cy)
    mirrored = segmented(points, frame.color[:, ::-1], camera)[:, ::-1]
    assert rand(labels, mirrored) > 0.98


def test_an_upside_down_image_gives_the_upside_down_partition(scene, labels):
    frame = scene.frame
    points, camera = frame.points[::-1].copy(), frame.camera
    points[..., 1] *= -1
    if camera is not None:
        camera = PinholeCamera(camera.fx, camera.fy, camera.cx, frame.height - 1 - camera.cy)
    assert rand(labels, segmented(points, frame.color[::-1], camera)[::-1]) > 0.98


@pytest.mark.parametrize("order", [(2, 1, 0), (1, 2, 0)])
def test_the_order_of_colour_channels_does_not_matter(scene, labels, order):
    """Sums over channels are rounded in another order, nothing else."""
    frame = scene.frame
    assert rand(labels, segmented(frame.points, frame.color[..., order], frame.camera)) > 0.9999


@pytest.mark.parametrize("factor", [0.5, 2.0, 16.0])
def test_the_unit_of_length_does_not_matter(scene, labels, factor):
    """Tolerances are shares of depth or of the extent, noise is measured: powers of two change no bit."""
    frame = scene.frame
    assert rand(labels, segmented(frame.points * np.float32(factor), frame.color, frame.camera)) > 0.9999


def test_inverting_the_colours_hardly_matters(scene, labels):
    frame = scene.frame
    assert rand(labels, segmented(frame.points, 255 - frame.color, frame.camera)) > 0.98


def test_moving_a_scanner_grid_in_space_does_not_matter():
    """x, y and z are three channels alike: a shift of the origin is a shift of the offset."""
    scene = make_scene("painting", 102, **SIZE)
    config = {"noise.range_model": "constant", "noise.range_sigma": 3e-4}
    before = segmented(scene.frame.points, scene.frame.color, None, **config)
    moved = scene.frame.points + np.array([0.25, -0.5, 0.125], np.float32)
    assert rand(before, segmented(moved, scene.frame.color, None, **config)) > 0.99


def test_noise_of_another_seed_gives_about_the_same_regions():
    one, other = (make_scene("room", 102, **SIZE, noise=noise) for noise in (1.0, 0.7))
    assert covering(contingency(one.labels, segment(other.frame).labels)) > 0.75
    assert rand(segment(one.frame).labels, segment(other.frame).labels) > 0.95


@pytest.mark.parametrize("levels", [0.0, 1.0, 255.0])
def test_surfaces_do_not_depend_on_the_tolerance_of_colours(scene, levels):
    config = SegmenterConfig().replace({"grouping.order": "range_only"})
    wanted = segment(scene.frame, config).labels
    assert np.array_equal(
        segment(scene.frame, config.replace({"grouping.color_tolerance": levels})).labels, wanted
    )
