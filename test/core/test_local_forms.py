"""Recognised shapes in minimal local form: axes, errors against draws of noise, and the systematic part."""

from types import SimpleNamespace

import numpy as np
import pytest

from rcseg_core import segment
from rcseg_core.shapes.cells import Cells
from rcseg_core.shapes.fitting import start_cylinder, start_plane, start_sphere
from rcseg_core.shapes.local_forms import depth_bias, local_cylinder, local_plane, local_sphere
from rcseg_core.shapes.primitives import fit
from rcseg_core.synthetic import make_scene

SIGMA = 2e-3


def cells_of(points, normals, rng):
    """Cells of noise along the rays at exact points (m, 3)."""
    spread = SIGMA * (points / np.linalg.norm(points, axis=1, keepdims=True))[:, :, None]
    noisy = points + spread[:, :, 0] * rng.normal(size=(len(points), 1))
    ones = np.ones(len(points))
    return Cells(noisy, normals, spread, ones, ones, 0.0 * ones, 0.0, 1.0)


def flat(rng):
    """(m, 3) points of a slanted plane 1.2 m x 0.4 m, its normal, and its long axis."""
    z = np.array([0.3, -0.5, -0.8]) / np.linalg.norm([0.3, -0.5, -0.8])
    x = np.array([0.7, 0.6, 0.0]) - np.array([0.7, 0.6, 0.0]) @ z * z
    x /= np.linalg.norm(x)
    flat = rng.uniform(-1, 1, (300, 2)) * (0.6, 0.2)
    return np.array([0.2, 0.3, 2.0]) + flat @ np.stack([x, np.cross(z, x)]), z, x


def test_a_plane_has_its_axes_where_its_points_are():
    rng = np.random.default_rng(1)
    points, z, x = flat(rng)
    cells = cells_of(points, np.tile(z, (300, 1)), rng)
    found = fit(start_plane(cells.points, np.full(300, 1 / 300)), cells)
    plane = local_plane(found, cells.points, cells.pixels)
    np.testing.assert_allclose(plane.pose[:3, :3].T @ plane.pose[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(plane.pose) == pytest.approx(1)
    assert plane.normal @ z > 0.999 and plane.normal @ plane.origin < 0, "towards the sensor"
    assert abs(plane.pose[:3, 0] @ x) > 0.99
    np.testing.assert_allclose(plane.origin, points.mean(axis=0), atol=3e-3)
    assert plane.distance == pytest.approx(float(found.parameters["distance"]))
    assert not plane.systematic.any()
    root = np.sqrt(np.diag(plane.covariance))
    assert root[0] > 2 * root[1], "a turn about the long axis is known less"
    hessian = plane.to_hessian()[1]
    change = np.diag([1.0, 1.0, 1.0, -1.0])  # the primitive tells the distance, this form minus that
    np.testing.assert_allclose(
        change @ hessian @ change, found.covariance, atol=1e-9 * found.covariance.max()
    )


def nees(errors, covariance):
    return float(errors @ np.linalg.solve(covariance, errors))


def draws(make, kinds=60):
    return np.mean([make(np.random.default_rng(seed)) for seed in range(kinds)])


def test_errors_of_planes_are_as_large_as_they_say():
    points, z, _ = flat(np.random.default_rng(1))

    def draw(rng):
        cells = cells_of(points, np.tile(z, (300, 1)), rng)
        found = fit(start_plane(cells.points, np.full(300, 1 / 300)), cells)
        plane = local_plane(found, cells.points, cells.pixels)
        local = plane.pose[:3, :3].T @ z
        offset = float(z @ (points.mean(axis=0) - plane.origin)) / local[2]
        return nees(np.array([-local[1], local[0], offset]), plane.covariance) / 3

    assert 0.75 < draws(draw) < 1.3


def cap(rng, radius=0.2, m=400):
    """(m, 3) points and normals of the side of a ball that is seen from the origin."""
    center = np.array([0.3, -0.2, 1.5])
    normals = rng.normal(size=(20 * m, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    towards = -center / np.linalg.norm(center)
    normals = normals[normals @ towards > 0.55][:m]
    return center + radius * normals, normals, center


def test_errors_of_spheres_are_as_large_as_they_say():
    points, normals, center = cap(np.random.default_rng(2))

    def draw(rng):
        cells = cells_of(points, normals, rng)
        found = fit(start_sphere(cells.points, np.full(len(points), 1 / len(points))), cells)
        ball = local_sphere(found, cells.points, cells.pixels)
        error = np.append(center - ball.center, 0.2 - ball.radius)
        return nees(error, ball.covariance) / 4

    assert 0.75 < draws(draw) < 1.3


def strip(rng, m=500):
    """(m, 3) points and normals of the seen side of a cylinder; its axis and a point of it."""
    axis = np.array([0.2, 0.9, 0.3]) / np.linalg.norm([0.2, 0.9, 0.3])
    point = np.array([-0.2, 0.1, 1.4])
    x = -point + (point @ axis) * axis
    x /= np.linalg.norm(x)
    angle, height = rng.uniform(-1, 1, m), rng.uniform(-0.25, 0.25, m)
    normals = np.cos(angle)[:, None] * x + np.sin(angle)[:, None] * np.cross(axis, x)
    return point + height[:, None] * axis + 0.1 * normals, normals, axis, point


def test_errors_of_cylinders_are_as_large_as_they_say():
    points, normals, axis, point = strip(np.random.default_rng(3))

    def draw(rng):
        cells = cells_of(points, normals, rng)
        weight = np.full(len(points), 1 / len(points))
        tube = local_cylinder(
            fit(start_cylinder(cells.points, cells.normals, weight), cells), cells.points, cells.pixels
        )
        x, y, z, origin = tube.pose[:3].T
        assert x @ origin < 0 and abs(x @ z) < 1e-12 and np.cross(x, y) @ z > 0.999
        true = axis if axis @ z > 0 else -axis
        off = point + (origin - point) @ true / (true @ true) * true - origin
        error = np.array([-true @ y, true @ x, off @ x, off @ y, 0.1 - tube.radius])
        return nees(error, tube.covariance) / 5

    assert 0.75 < draws(draw) < 1.3


def planes_at(points, z, bias=0.0):
    """The minimal form of a plane fitted to points with noise, the same at each call."""
    cells = cells_of(points, np.tile(z, (len(points), 1)), np.random.default_rng(7))
    found = fit(start_plane(cells.points, np.full(len(points), 1 / len(points))), cells)
    return local_plane(found, cells.points, cells.pixels, bias)


def test_a_bias_of_depth_moves_planes_along_the_ray_and_tilts_them_over_their_extent():
    points, z, _ = flat(np.random.default_rng(4))
    plane = planes_at(points, z, 0.004)
    ray = plane.origin / np.linalg.norm(plane.origin)
    shift = 0.004 / ray[2] * abs(ray @ plane.normal)
    root = np.sqrt(np.diag(plane.systematic))
    assert root[2] == pytest.approx(shift)
    assert root[0] == pytest.approx(shift / 0.2, rel=0.1) and root[1] == pytest.approx(shift / 0.6, rel=0.1)
    np.testing.assert_array_equal(plane.systematic, np.diag(root**2))
    # all depths longer by one sigma: the offset is one sigma, and nothing else changes to speak of
    longer = planes_at(points * (1 + 0.004 / points[:, 2:]), z)
    assert abs(plane.normal @ (longer.origin - plane.origin)) == pytest.approx(shift, rel=0.03)
    assert np.arccos(min(1.0, longer.normal @ plane.normal)) < 0.2 * root[0]


def test_curved_shapes_have_a_systematic_part_that_grows_with_the_bias():
    rng = np.random.default_rng(5)
    points, normals, _ = cap(rng)
    cells = cells_of(points, normals, rng)
    weight = np.full(len(points), 1 / len(points))
    ball = fit(start_sphere(cells.points, weight), cells)
    one, two = (local_sphere(ball, cells.points, cells.pixels, s).systematic for s in (1e-3, 2e-3))
    np.testing.assert_allclose(two, 4 * one)
    assert np.linalg.eigvalsh(one)[0] > 0 and np.sqrt(one[3, 3]) > 1e-3
    points, normals, *_ = strip(rng)
    cells = cells_of(points, normals, rng)
    weight = np.full(len(points), 1 / len(points))
    tube = fit(start_cylinder(cells.points, cells.normals, weight), cells)
    one, two = (local_cylinder(tube, cells.points, cells.pixels, s).systematic for s in (1e-3, 2e-3))
    np.testing.assert_allclose(two, 4 * one)
    assert np.sqrt(one[4, 4]) > 1e-3 and np.linalg.eigvalsh(one)[0] >= -1e-18


def test_the_bias_of_depth_is_a_law_of_the_signal():
    point = np.array([0.1, 0.2, 2.0])
    law = np.array([[1e-3, 2e-3, 4e-3]])
    assert depth_bias(SimpleNamespace(systematic_law=law), point) == pytest.approx((1e-3 + 1e-3 + 1e-3) * 4)
    grid = np.array([[9.0, 0, 0], [9.0, 0, 0], [2e-3, 0, 0]])
    assert depth_bias(SimpleNamespace(systematic_law=grid), point) == pytest.approx(2e-3)


def test_surfaces_hold_the_form_of_their_kind_and_no_other():
    seen = set()
    for family in ("room", "curved"):
        result = segment(make_scene(family, 1, width=320, height=240).frame)
        for surface in result.surfaces:
            kind = surface.primitive.kind
            forms = {"plane": surface.plane, "sphere": surface.sphere, "cylinder": surface.cylinder}
            assert [name for name, form in forms.items() if form is not None] == [kind] * (kind != "none")
            seen.add(kind)
            if kind != "plane":
                continue
            points = result.reconstruct()[0][result.surface_labels == surface.label]
            np.testing.assert_allclose(surface.plane.origin, np.nanmean(points, axis=0), atol=0.08)
            np.testing.assert_allclose(surface.plane.normal, surface.primitive.parameters["normal"])
            assert np.linalg.eigvalsh(surface.plane.covariance)[0] > 0
    assert seen >= {"plane", "sphere", "cylinder"}
