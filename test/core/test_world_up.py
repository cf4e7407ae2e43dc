"""Up, the floor, and the classes of surfaces with their probabilities."""

import gc
import weakref
from types import SimpleNamespace

import numpy as np
import pytest

from rcseg_core import InputError, PinholeCamera, SegmenterConfig, segment
from rcseg_core.shapes.plane_forms import LocalPlane
from rcseg_core.synthetic import make_scene, make_terrain
from rcseg_core.world import CATEGORIES, Up
from rcseg_core.world.classes import facing, probability_within
from rcseg_core.world.up import tilt_between, told_up, visible_area


def turned(vector, axis, degrees):
    """A vector turned about an axis, by Rodrigues."""
    axis = axis / np.linalg.norm(axis)
    a = np.deg2rad(degrees)
    return vector * np.cos(a) + np.cross(axis, vector) * np.sin(a) + axis * (axis @ vector) * (1 - np.cos(a))


def plane_at(normal, origin=(0.0, 0.5, 2.0), sigma=1e-6):
    normal = np.asarray(normal, float) / np.linalg.norm(normal)
    x = np.cross(normal, [0.3, 0.2, 0.9])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3] = np.stack([x, np.cross(normal, x), normal, np.asarray(origin, float)], axis=1)
    return LocalPlane(pose, sigma**2 * np.eye(3), np.zeros((3, 3)))


@pytest.mark.parametrize("degrees", [0.0, 60.0])
def test_the_visible_area_is_that_of_the_pixels_on_the_plane(degrees):
    """A small patch at the middle of the image, two metres away, through a lens with two focal lengths."""
    scene = SimpleNamespace(camera=PinholeCamera(100.0, 400.0, 31.5, 23.5))
    normal = turned(np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0]), degrees)
    area = visible_area(plane_at(normal, (0.0, 0.0, 2.0)), 50, scene)
    assert area == pytest.approx(50 * (2 / 100) * (2 / 400) / np.cos(np.deg2rad(degrees)))
    assert visible_area(plane_at(normal), 50, SimpleNamespace(camera=None)) == 50


def up_of(vector, sigma=1e-6):
    vector = np.asarray(vector, float) / np.linalg.norm(vector)
    return Up(vector, sigma**2 * (np.eye(3) - np.outer(vector, vector)), "given")


@pytest.fixture(scope="module")
def terrain():
    made = make_terrain(4, width=160, height=120)
    return made, segment(made.scene.frame)


@pytest.fixture(scope="module")
def curved():
    scene = make_scene("curved", 33, width=160, height=120)
    return scene, segment(scene.frame)


def test_the_seen_floor_gives_up(terrain):
    made, result = terrain
    world = result.world()
    assert world.up.source == "floor" and world.tilt is None
    assert np.degrees(np.arccos(world.up.vector @ made.up)) < 1.0
    assert np.mean(made.floor[result.surface_labels == world.floor]) > 0.95
    assert result.surfaces[world.floor - 1].category == "floor"


@pytest.mark.parametrize("degrees", [0.0, 3.0, -8.0])
def test_the_tilt_of_a_told_up_is_named(terrain, degrees):
    made, result = terrain
    told = turned(made.up, np.cross(made.up, [0.0, 0.0, 1.0]), degrees)
    world = result.world(up=5.0 * told, source="tf")
    assert world.up.source == "tf" and np.allclose(world.up.vector, told)
    assert np.degrees(world.tilt.angle_rad) == pytest.approx(abs(degrees), abs=0.7)
    assert world.tilt.expected == (degrees == 0.0)
    assert 0.009 < world.tilt.standard_deviation_rad < 0.03


def test_the_tilts_deviation_is_that_of_both():
    """Monte Carlo: the angle between two directions that vary."""
    rng = np.random.default_rng(3)
    one, other = (
        up_of([0, -1, 0], 0.01),
        up_of(turned(np.array([0, -1.0, 0]), np.array([1.0, 0, 0]), 6), 0.02),
    )
    tilt = tilt_between(one, other, SegmenterConfig().world)
    noise = rng.normal(size=(2, 4000, 3)) * np.array([0.01, 0.02])[:, None, None]
    a, b = one.vector + noise[0], other.vector + noise[1]
    a, b = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (a, b))
    angles = np.arccos(np.sum(a * b, axis=1))
    assert tilt.standard_deviation_rad == pytest.approx(angles.std(), rel=0.1)


@pytest.mark.parametrize("source", ["tf", "imu", "none"])
def test_where_up_is_unknown_planes_have_no_class(terrain, source):
    made, _ = terrain
    result = segment(made.scene.frame, SegmenterConfig().replace({"world.up_from": source}))
    assert result.world().up is None and result.world().ground is None
    plane = next(s for s in result.surfaces if s.plane is not None)
    assert plane.category == "other" and np.isnan(plane.category_probability)
    told = result.world(up=made.up)
    assert told.categories[told.floor - 1].name == "floor"


def test_an_up_from_the_parameters(terrain):
    made, _ = terrain
    keys = dict(zip(("world.up_x", "world.up_y", "world.up_z"), map(float, made.up), strict=True))
    result = segment(made.scene.frame, SegmenterConfig().replace({"world.up_from": "parameter", **keys}))
    assert result.world().up.source == "parameter" and np.allclose(result.world().up.vector, made.up)
    assert result.world().tilt.expected


@pytest.mark.parametrize(
    ("up", "covariance"),
    [
        ((0, 0, 0), None),
        ((0, 1), None),
        ("up", None),
        ((0, np.nan, 1), None),
        (None, np.eye(3)),
        ((0, 1, 0), np.eye(2)),
    ],
)
def test_an_up_that_is_none_is_refused(terrain, up, covariance):
    with pytest.raises(InputError, match="up"):
        terrain[1].world(up=up, up_covariance=covariance)


@pytest.mark.parametrize(
    ("degrees", "name"),
    [
        (0, "horizontal"),
        (8, "horizontal"),
        (30, "inclined"),
        (85, "vertical"),
        (95, "vertical"),
        (176, "ceiling"),
    ],
)
def test_planes_that_are_known_well_are_of_one_class(degrees, name):
    up = up_of([0.1, -1.0, 0.2])
    plane = plane_at(turned(up.vector, np.array([1.0, 0.3, 0.1]), degrees))
    found = facing(plane, up, np.deg2rad(10))
    # the axis is not square to up: what counts is the angle itself
    angle = np.degrees(np.arccos(plane.normal @ up.vector))
    expected = {
        "horizontal": angle < 10, "ceiling": angle > 170, "vertical": abs(angle - 90) < 10,
    }  # fmt: skip
    assert found[max(found, key=found.get)] > 0.999
    if name != "inclined" or not any(expected.values()):
        assert max(found, key=found.get) == next((k for k, v in expected.items() if v), "inclined")


def test_probabilities_are_those_of_drawn_errors():
    """Monte Carlo over both errors, near every limit."""
    rng = np.random.default_rng(1)
    up, limit = up_of([0.0, -1.0, 0.0], 0.04), np.deg2rad(10)
    for degrees in (2, 8, 10, 13, 80, 82, 171):
        plane = plane_at(turned(up.vector, np.array([1.0, 0.0, 0.5]), degrees))
        covariance = np.diag([0.06, 0.01, 0.0]) ** 2
        plane = LocalPlane(plane.pose, covariance, np.zeros((3, 3)))
        tilts = rng.normal(size=(40_000, 2)) * [0.06, 0.01]
        normals = plane.normal - tilts[:, :1] * plane.pose[:3, 1] + tilts[:, 1:] * plane.pose[:3, 0]
        ups = up.vector + 0.04 * rng.normal(size=(40_000, 3)) @ (np.eye(3) - np.outer(up.vector, up.vector))
        cosines = (
            np.sum(normals * ups, axis=1) / np.linalg.norm(normals, axis=1) / np.linalg.norm(ups, axis=1)
        )
        angles = np.arccos(np.clip(cosines, -1, 1))
        drawn = {
            "horizontal": np.mean(angles < limit), "ceiling": np.mean(angles > np.pi - limit),
            "vertical": np.mean(np.abs(angles - np.pi / 2) < limit),
        }  # fmt: skip
        found = facing(plane, up, limit)
        assert sum(found.values()) == pytest.approx(1.0)
        for name, p in drawn.items():
            assert found[name] == pytest.approx(p, abs=0.03), (degrees, name)


def test_the_height_over_the_floor_counts_with_the_floors_own_error():
    """A metre away from the middle of a floor that is known to a degree, a centimetre tells nothing."""
    floor = plane_at([0, -1, 0], (0, 1, 2))
    shelf = plane_at([0, -1, 0], (1.0, 0.97, 2.0))
    assert probability_within(shelf, floor, 0.02) < 0.01
    assert probability_within(plane_at([0, -1, 0], (1.0, 0.985, 2.0)), floor, 0.02) > 0.99
    unsure = LocalPlane(floor.pose, np.diag([0.02, 0.02, 1e-6]) ** 2, np.zeros((3, 3)))
    assert 0.2 < probability_within(shelf, unsure, 0.02) < 0.8


def test_balls_and_cylinders_are_named(curved):
    _, result = curved
    for surface in result.surfaces:
        if surface.primitive.kind in ("sphere", "cylinder"):
            assert surface.category == surface.primitive.kind and surface.category_probability > 0.5
    mask = result.world().class_mask
    assert mask.dtype == np.uint8 and (mask[result.surface_labels == 0] == 0).all()
    for surface in result.surfaces:
        assert (mask[result.surface_labels == surface.label] == CATEGORIES.index(surface.category)).all()


def test_probabilities_sum_to_one(curved, terrain):
    for _, result in (curved, terrain):
        for category in result.world().categories:
            assert sum(category.probabilities.values()) == pytest.approx(1.0)
            assert category.probability == max(category.probabilities.values())


def test_a_result_is_freed_at_once():
    """No cycle through surfaces and world keeps the memory of a frame."""
    result = segment(make_scene("room", 20, width=48, height=40).frame)
    assert result.surfaces[0].category in CATEGORIES and result.objects is not None
    watched = weakref.ref(result)
    gc.collect()
    gc.disable()
    try:
        del result
        assert watched() is None
    finally:
        gc.enable()


@pytest.mark.parametrize("length", [1e300, 1e-300])
def test_up_of_any_length_is_a_direction(length):
    up = told_up((0.0, 0.6 * length, -0.8 * length), None, "test", SegmenterConfig().world)
    np.testing.assert_allclose(up.vector, [0, 0.6, -0.8], atol=1e-15)
