"""Fits of planes, spheres and cylinders to measurements with noise along the rays."""

import dataclasses

import numpy as np
import pytest
from oracle.naive_primitives import along, distance, numeric_table
from scipy.stats import ncx2

from rcseg_core.shapes import primitives
from rcseg_core.shapes.cells import Cells
from rcseg_core.shapes.fitting import (
    CYLINDER,
    FREEDOM,
    PLANE,
    SPHERE,
    Shape,
    fit_shape,
    parameters,
    residuals,
    start_cylinder,
    start_plane,
    start_sphere,
)
from rcseg_core.shapes.primitives import assess, fit, noncentral_p, recognise, turn


def unit(*values):
    return np.array(values, float) / np.linalg.norm(values)


SHAPES = {
    "plane": Shape(PLANE, np.array([0.1, 0.2, 1.5]), unit(0.3, -0.2, -1.0), 0.0, np.array([0.1, 0.2, 1.5])),
    "sphere": Shape(SPHERE, np.array([0.1, -0.1, 1.3]), unit(0, 0, 1), 0.15, np.array([0.1, -0.1, 1.2])),
    "cylinder": Shape(
        CYLINDER, np.array([0.0, 0.1, 1.2]), unit(0.3, 1.0, 0.2), 0.08, np.array([0.0, 0.1, 1.1])
    ),
}


def cells_of(points, normals, spread, scatter=1.0):
    m = len(points)
    return Cells(points, normals, spread, np.full(m, 9.0), np.full(m, 9.0), np.zeros(m), 0.0, scatter)


def seen_cells(kind, rng, count=200, sigma=2e-3, noise=True):
    """Cells on the side of a shape that faces the sensor, with noise of `sigma` along the rays."""
    shape = SHAPES[kind]
    if kind == "plane":
        flat = rng.uniform(-0.3, 0.3, (count, 3))
        points = shape.point + flat - (flat @ shape.direction)[:, None] * shape.direction
        normals = np.tile(shape.direction, (count, 1))
    else:
        side = rng.normal(size=(20 * count, 3))
        height = np.zeros(len(side))
        if kind == "cylinder":
            side -= (side @ shape.direction)[:, None] * shape.direction
            height = rng.uniform(-0.15, 0.15, len(side))
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        points = shape.point + shape.radius * side + height[:, None] * shape.direction
        facing = -np.sum(side * points, axis=1) / np.linalg.norm(points, axis=1) > 0.55
        points, normals = points[facing][:count], side[facing][:count]
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    spread = np.zeros((len(points), 3, 3))
    spread[:, :, 0] = sigma * rays
    if noise:
        points = points + sigma * rays * rng.normal(size=(len(points), 1))
    return cells_of(points, normals, spread)


@pytest.mark.parametrize("kind", SHAPES)
def test_distances_go_along_the_noise_to_the_shape(kind):
    rng = np.random.default_rng(1)
    cells = seen_cells(kind, rng, 30, sigma=5e-3)
    shape = SHAPES[kind]
    miss = residuals(shape, cells.points, cells.spread)
    rays = cells.spread[:, :, 0] / 5e-3
    way = np.array([along(kind, shape, p, r) for p, r in zip(cells.points, rays, strict=True)])
    # the gradient's side is outside, the ray's is away from the sensor
    sign = np.sign(np.sum(miss.gradients * rays, axis=1))
    np.testing.assert_allclose(miss.whitened, sign * way / 5e-3, atol=0.02)
    ends = cells.points - way[:, None] * rays
    assert np.abs([distance(kind, shape, end) for end in ends]).max() < 1e-12
    slant = np.abs(np.sum(miss.gradients * rays, axis=1))
    np.testing.assert_allclose(miss.sigma, 5e-3 * slant, rtol=1e-9)


def test_noise_on_all_sides_makes_it_the_shortest_way():
    rng = np.random.default_rng(1)
    cells = seen_cells("sphere", rng, 30, sigma=5e-3)
    miss = residuals(SHAPES["sphere"], cells.points, np.tile(2e-3 * np.eye(3), (30, 1, 1)))
    wanted = np.array([distance("sphere", SHAPES["sphere"], p) for p in cells.points])
    np.testing.assert_allclose(miss.whitened, wanted / 2e-3, atol=1e-9)
    np.testing.assert_allclose(miss.sigma, 2e-3)


@pytest.mark.parametrize("kind", SHAPES)
def test_the_covariance_is_that_of_numeric_derivatives(kind):
    """(J^T J)^-1 with J by differences of distances over steps of the local parameters."""
    cells = seen_cells(kind, np.random.default_rng(2), 120, noise=False)
    shape, covariance = fit_shape(SHAPES[kind], cells.points, cells.spread, np.full(120, 4.0))
    table = (
        numeric_table(kind, shape, cells.points) / residuals(shape, cells.points, cells.spread).sigma[:, None]
    )
    np.testing.assert_allclose(covariance, np.linalg.inv(table.T @ table), rtol=2e-3, atol=1e-12)


@pytest.mark.parametrize("kind", SHAPES)
def test_exact_points_are_found_from_a_rough_start(kind):
    rng = np.random.default_rng(3)
    cells = seen_cells(kind, rng, noise=False)
    weight = np.full(len(cells.points), 1 / len(cells.points))
    start = {
        "plane": lambda: start_plane(cells.points, weight),
        "sphere": lambda: start_sphere(cells.points, weight),
        "cylinder": lambda: start_cylinder(cells.points, cells.normals, weight),
    }[kind]()
    rough = start._replace(point=start.point + 0.02, direction=unit(*(start.direction + 0.1)))
    found, _ = fit_shape(rough, cells.points, cells.spread, np.full(len(weight), 1e9))
    misses = [distance(kind, found, p) for p in cells.points]
    assert np.abs(misses).max() < 1e-7
    if kind != "plane":
        assert found.radius == pytest.approx(SHAPES[kind].radius, abs=1e-6)


@pytest.mark.parametrize("kind", SHAPES)
def test_errors_are_as_large_as_they_say(kind):
    """Over 120 draws the squared error over the covariance is chi-squared of as many degrees of freedom."""
    truth, squares = parameters(SHAPES[kind]), []
    for seed in range(120):
        found, (first, *_) = recognise(seen_cells(kind, np.random.default_rng(seed)))
        assert found.kind == kind
        values = found.parameters
        if kind == "cylinder":  # the truth's point at the height of the fitted one, the axis in its sense
            axis = truth["axis"] * np.sign(truth["axis"] @ values["axis"])
            point = truth["point"] + axis * (axis @ (values["point"] - truth["point"]))
            error = np.concatenate(
                [values["point"] - point, values["axis"] - axis, [values["radius"] - truth["radius"]]]
            )
        else:
            error = np.concatenate([np.ravel(values[name] - truth[name]) for name in truth])
        squares.append(error @ np.linalg.pinv(found.covariance, rcond=1e-8, hermitian=True) @ error)
        assert first.kind == "plane"
    q = FREEDOM[SHAPES[kind].kind]
    # mean of 120 chi-squared: q with a standard error of sqrt(2 q / 120)
    assert np.mean(squares) == pytest.approx(q, abs=4 * np.sqrt(2 * q / 120))


def test_noise_and_misfit_are_told_apart():
    """A plane with waves of 6 mm rms under noise of 2 mm: the misfit is the waves, the rms is both."""
    cells = seen_cells("plane", np.random.default_rng(5), 400)
    wave = 6e-3 * np.sqrt(2) * np.sin(40 * cells.points[:, 0])
    bent = cells_of(cells.points + wave[:, None] * SHAPES["plane"].direction, cells.normals, cells.spread)
    shape, covariance = fit_shape(SHAPES["plane"], bent.points, bent.spread, np.full(400, 1e9))
    plane = assess(shape, covariance, bent)
    assert plane.misfit_m == pytest.approx(6e-3, rel=0.1)
    assert plane.p_value < 1e-6
    # 9 pixels a cell: a pixel's noise is 3 times that of its cell, within the cell 8/9 of its variance
    slant = np.abs(bent.points @ plane.parameters["normal"]) / np.linalg.norm(bent.points, axis=1)
    noise2 = np.mean((6e-3 * slant) ** 2)
    assert plane.rms_m == pytest.approx(np.sqrt(noise2 + 6e-3**2), rel=0.1)


def test_a_crumb_does_not_bend_a_plane():
    cells = seen_cells("plane", np.random.default_rng(6), 300)
    cells.points[:6] -= 0.05 * cells.points[:6]
    plane, _ = recognise(cells)
    assert plane.kind == "plane"
    angle = np.arccos(min(abs(plane.parameters["normal"] @ SHAPES["plane"].direction), 1.0))
    assert angle < 3e-3


@pytest.mark.parametrize("freedom, excess", [(5, 0.0), (40, 3.0), (400, 50.0), (390, 3000.0)])
def test_tails_of_noncentral_chi_squared(freedom, excess):
    for share in (0.7, 1.0, 1.2, 1.4):
        chi2 = share * (freedom + excess)
        wanted = ncx2.sf(chi2, freedom, excess) if excess else ncx2.sf(chi2, freedom, 1e-9)
        assert noncentral_p(chi2, freedom, excess) == pytest.approx(wanted, abs=0.01)


def test_the_turn_of_normals_is_the_angle_of_their_cone():
    angle = np.linspace(-0.5, 0.5, 2001)
    arc = np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=1)
    assert turn(arc) == pytest.approx(0.9, abs=2e-3)
    assert turn(np.concatenate([arc, -arc])) == pytest.approx(np.pi)


def test_a_curved_shape_that_is_farther_off_than_the_plane_is_none(monkeypatch):
    """Its test clips outliers, and may pass where hardly a cell is near to the shape."""
    cells = seen_cells("sphere", np.random.default_rng(8))
    sphere, (plane, *_) = recognise(cells)
    assert sphere.kind == "sphere" and sphere.misfit_m < plane.misfit_m
    far = {"sphere": plane.misfit_m * 1.1, "cylinder": plane.misfit_m * 1.2}

    def farther(start, cells):
        found = fit(start, cells)
        return found and dataclasses.replace(found, misfit_m=far.get(found.kind, found.misfit_m))

    monkeypatch.setattr(primitives, "fit", farther)
    assert recognise(cells)[0].kind == "none"
