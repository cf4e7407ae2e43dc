"""Boundaries and polygons: valid whatever the mask, sub-pixel where surfaces meet, as large as they are."""

import numpy as np
import pytest
import shapely
from crafted import crafted_signals
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from rcseg_core import InputError, PinholeCamera, segment
from rcseg_core.config import WorldConfig
from rcseg_core.models.polynomials import Models
from rcseg_core.shapes.plane_forms import LocalPlane
from rcseg_core.shapes.primitives import NONE
from rcseg_core.signal.units import UNIT_PX
from rcseg_core.synthetic import make_scene
from rcseg_core.world import triangles
from rcseg_core.world.outlines import inset, outline
from rcseg_core.world.rings import trace
from rcseg_core.world.scene import Scene


class Flat:
    """A surface that is a plane."""

    def __init__(self, label, mask, plane):
        rows, cols = np.nonzero(mask)
        self.label, self.pixel_count, self.regions = label, int(mask.sum()), (label,)
        self.box = int(rows.min()), int(cols.min()), int(rows.max()), int(cols.max())
        self.primitive, self.candidates, self.local = NONE, (), plane


def plane_of(normal, distance):
    normal = np.asarray(normal, float) / np.linalg.norm(normal)
    x = np.cross(normal, [0.1, 1.0, 0.0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3] = np.stack([x, np.cross(normal, x), normal, distance * normal], axis=1)
    return LocalPlane(pose, np.zeros((3, 3)), np.zeros((3, 3)))


def crafted_scene(labels, planes, **settings):
    """Planes seen by a camera: surface s lies on planes[s - 1]; every model is exact."""
    height, width = labels.shape
    camera = PinholeCamera(50.0, 50.0, (width - 1) / 2, (height - 1) / 2)
    rays = camera.rays(height, width).astype(float)
    center = np.zeros((len(planes) + 1, 2))
    coef = np.zeros((len(planes) + 1, 1, 2, 2))
    inverse = np.ones((height, width))
    for s, plane in enumerate(planes, start=1):
        m = plane.normal / plane.distance
        own = rays @ m
        inverse[labels == s] = own[labels == s]
        coef[s, 0, 0, 0] = own[0, 0]
        coef[s, 0, 1, 0], coef[s, 0, 0, 1] = m[0] / camera.fx * UNIT_PX, m[1] / camera.fy * UNIT_PX
    degree = np.ones((len(planes) + 1, 2), np.int64)
    signals = crafted_signals(inverse[..., None])
    models = Models(center, degree, coef)
    surfaces = [Flat(s, labels == s, p) for s, p in enumerate(planes, start=1)]
    labels = labels.astype(np.int32)
    config = WorldConfig(**{"polygon_least": 1, "polygon_tolerance": 0.0, **settings})
    return Scene(labels, labels, camera, lambda: (signals, models), lambda: surfaces, config)


SLANTED = plane_of([0.3, -0.5, -1.0], -2.0)


def drawn(mask, **settings):
    scene = crafted_scene(mask.astype(np.int32), [SLANTED], **settings)
    return scene, outline(scene, scene.surfaces[0])


def seen_at(scene, plane, rows, cols):
    """x, y on a plane of pixels, by the intersection of their rays."""
    rays = np.stack([(cols - scene.camera.cx) / 50.0, (rows - scene.camera.cy) / 50.0, np.ones(len(rows))], 1)
    points = rays * (plane.distance / (rays @ plane.normal))[:, None]
    return (points - plane.origin) @ plane.pose[:3, :2]


def checkerboard(n):
    return (np.indices((n, n)).sum(axis=0) % 2 == 0).astype(bool)


def rings_in_rings(n):
    away = np.abs(np.indices((n, n)) - n // 2).max(axis=0)
    return away % 2 == 0


def bridges(n):
    mask = np.zeros((n, n), bool)
    mask[2:6, 2:6] = mask[n - 6 : n - 2, n - 6 : n - 2] = True
    mask[4, 2 : n - 2] = mask[4 : n - 2, n - 4] = True  # one pixel wide
    mask[np.arange(6, n - 6), np.arange(6, n - 6)] = True  # pixels that touch at corners only
    return mask


HOSTILE = {
    "checkerboard": checkerboard(14), "rings": rings_in_rings(15), "bridges": bridges(18),
    "everything": np.ones((9, 11), bool), "one pixel": np.eye(5, dtype=bool) & (np.arange(5) == 2),
    "diagonal": np.eye(9, dtype=bool),
}  # fmt: skip


def check(mask):
    """Every part is valid, parts are apart, and they hold the centres of the mask's pixels and of no
    others."""
    scene, boundary = drawn(mask)
    assert boundary.polygons and all(p.is_valid and p.area > 0 for p in boundary.polygons)
    whole = shapely.union_all(boundary.polygons)
    assert whole.area == pytest.approx(sum(p.area for p in boundary.polygons))
    rows, cols = (g.ravel().astype(float) for g in np.indices(mask.shape))
    x, y = seen_at(scene, SLANTED, rows, cols).T
    assert (shapely.contains_xy(whole, x, y) == mask.ravel()).all()


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_masks_have_valid_polygons(name):
    check(HOSTILE[name])


@settings(max_examples=100, deadline=None)
@given(arrays(bool, st.tuples(st.integers(3, 12), st.integers(3, 12))).filter(np.any))
def test_any_mask_has_valid_polygons(mask):
    check(mask)


@settings(max_examples=40, deadline=None)
@given(arrays(bool, (12, 12)).filter(np.any), st.sampled_from([0.01, 0.1, 1.0]))
def test_simplified_polygons_are_valid(mask, tolerance):
    _, exact = drawn(mask)
    _, simple = drawn(mask, polygon_tolerance=tolerance)
    for one, other in zip(simple.polygons, exact.polygons, strict=True):
        assert one.is_valid and not one.is_empty
        assert one.hausdorff_distance(other) <= tolerance + 1e-9 or len(other.exterior.coords) < 6


def test_rings_within_rings_are_holes_and_parts():
    _, boundary = drawn(rings_in_rings(15))
    assert len(boundary.polygons) == 4 and [len(p.interiors) for p in boundary.polygons] == [1, 1, 1, 0]
    holes = [ring.hole for ring in boundary.rings]
    assert holes == [False, True, False, True, False, True, False]


def test_small_holes_and_parts_are_left_out():
    mask = np.ones((20, 20), bool)
    mask[3, 3] = False  # a missing pixel
    mask[8:14, 8:14] = False  # an object
    _, boundary = drawn(mask, polygon_least=5)
    assert len(boundary.polygons) == 1 and len(boundary.polygons[0].interiors) == 1


def test_the_area_is_that_of_the_pixels_on_the_plane():
    """dA = d^2 / (n . ray)^3 a pixel."""
    mask = np.zeros((40, 50), bool)
    mask[5:35, 8:44] = True
    scene, boundary = drawn(mask)
    rays = scene.camera.rays(*mask.shape).astype(float)[mask]
    area = np.sum(SLANTED.distance**2 / np.abs(rays @ SLANTED.normal) ** 3) / 50.0**2
    assert boundary.polygons[0].area == pytest.approx(
        area, rel=2e-3
    )  # corners are cut by an eighth of a pixel


def test_borders_lie_where_two_planes_meet():
    """A crease at a third of a pixel, and along a slant."""
    wall, floor = plane_of([0.02, 0.01, -1.0], -2.0), plane_of([0.0, -1.0, -0.1], -0.55)
    camera_rays = PinholeCamera(50.0, 50.0, 29.5, 19.5).rays(40, 60).astype(float)
    inverse = [camera_rays @ (p.normal / p.distance) for p in (wall, floor)]
    labels = np.where(inverse[0] >= inverse[1], 1, 2)
    assert 0.2 < np.mean(labels == 2) < 0.8
    scene = crafted_scene(labels, [wall, floor])
    difference = wall.normal / wall.distance - floor.normal / floor.distance
    for surface in scene.surfaces:
        pixels = outline(scene, surface).rings[0].pixels
        inner = (pixels > 0.6).all(axis=1) & (pixels < np.array(labels.shape) - 1.6).all(axis=1)
        rays = np.stack(
            [(pixels[:, 1] - 29.5) / 50, (pixels[:, 0] - 19.5) / 50, np.ones(len(pixels))], axis=1
        )
        slope = np.hypot(difference[0], difference[1]) / 50
        off = np.abs(rays[inner] @ difference) / slope
        assert inner.sum() > 30 and off.max() < 0.25 and off.mean() < 0.05


def test_points_lie_on_the_plane():
    _, boundary = drawn(rings_in_rings(15))
    for ring in boundary.rings:
        assert np.abs(ring.points @ SLANTED.normal - SLANTED.distance).max() < 1e-12
        assert ring.points.shape == (len(ring.pixels), 3)


def test_insets_shrink_and_may_vanish():
    polygon = shapely.box(0, 0, 2, 1, ccw=True).difference(shapely.box(0.9, 0.4, 1.1, 0.6))
    smaller = inset(polygon, 0.1)
    assert smaller.area == pytest.approx(1.8 * 0.8 - 0.4 * 0.4) and polygon.contains(smaller)
    assert inset(polygon, 0.45).geom_type == "MultiPolygon" or inset(polygon, 0.45).is_empty
    assert inset(polygon, 0.6).is_empty and inset(polygon, 0.0) is polygon


def test_triangles_leave_holes_open():
    polygon = shapely.box(0, 0, 2, 1).difference(shapely.box(0.5, 0.25, 1.5, 0.75))
    vertices, faces = triangles(polygon)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    areas = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert (areas > 0).all() and areas.sum() == pytest.approx(polygon.area)
    middles = (a + b + c) / 3
    assert shapely.contains_xy(polygon, *middles.T).all() and faces.dtype == np.int32


def test_rings_close_and_turn_the_right_way_round():
    """Outer rings count their pixels as positive, holes as negative, less what the corners lose."""
    scene = crafted_scene(np.where(rings_in_rings(15), 1, 0), [SLANTED])
    rings = trace(scene.surface_labels, scene.labels, scene.models, True)
    side = np.array([13, -11, 9, -7, 5, -3, 1])
    assert sorted(rings.areas) == sorted(np.sign(side) * (side**2 - 0.5))
    assert (np.diff(rings.starts) >= 4).all() and rings.starts[-1] == len(rings.vertices)
    empty = trace(np.zeros((5, 5), np.int32), np.zeros((5, 5), np.int32), scene.models, True)
    assert len(empty.surfaces) == 0 and empty.starts.tolist() == [0]


@pytest.fixture(scope="module")
def room():
    scene = make_scene("room", 23, width=160, height=120, noise=0.2)
    return scene, segment(scene.frame)


def test_surfaces_of_a_room(room):
    _, result = room
    for surface in result.surfaces:
        if surface.plane is None:
            assert surface.polygon is None and surface.polygons == ()
            assert surface.polygon_inset(0.01) is None and len(surface.boundary.rings) >= 1
            continue
        if surface.pixel_count < 300:
            continue
        assert surface.polygon.is_valid
        ring = surface.boundary.rings[0].pixels
        rows, cols = np.nonzero(result.surface_labels == surface.label)
        assert ring[:, 0].min() >= rows.min() - 1 and ring[:, 1].max() <= cols.max() + 1
        assert surface.polygon_inset(0.01).area < surface.polygon.area
        with pytest.raises(InputError, match="distance_m"):
            surface.polygon_inset(-1.0)


def test_curved_surfaces_have_their_boundary_on_the_model(room):
    _, result = room
    ball = next(s for s in result.surfaces if s.sphere is not None)
    points = ball.boundary.rings[0].points
    miss = np.linalg.norm(points - ball.sphere.center, axis=1) - ball.sphere.radius
    assert np.isfinite(points).all() and np.median(np.abs(miss)) < 0.02


def test_grids_without_a_camera_have_polygons():
    scene = make_scene("painting", 5, width=64, height=48)
    result = segment(scene.frame)
    polygons = [s.polygon for s in result.surfaces if s.plane is not None]
    assert polygons and all(p.is_valid for p in polygons)
