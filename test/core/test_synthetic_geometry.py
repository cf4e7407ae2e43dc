"""Ray casting against sphere tracing, an independent road to the same hits."""

import numpy as np
import pytest
from oracle import naive_raycast

from rcseg_core.synthetic import geometry as g
from rcseg_core.synthetic.paint import Paint

GREY = (Paint(np.full(3, 128.0)),)
FAR = 20.0


def random_rays(rng, count):
    """Rays from points around the origin to points near it, of various lengths."""
    start = 2.5 * np.array([v / np.linalg.norm(v) for v in rng.normal(size=(count, 3))])
    direction = (rng.uniform(-0.5, 0.5, (count, 3)) - start) * rng.uniform(0.3, 2.0, (count, 1))
    return start, direction


def shapes(rng):
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    middle = rng.uniform(-0.2, 0.2, 3)
    base = rng.uniform(-0.2, 0.2, 3)
    ball = g.Sphere(middle, 0.6, np.eye(3))
    can = g.Cylinder(middle, axis, 0.4, 0.5)
    bodies = [
        g.box(base, (0.8, 0.5, 0.6), 0.7),
        g.prism(base, 0.5, 0.6, 5, 0.3, 0.0),
        g.prism(base, 0.5, 0.4, 3, 0.3, 0.4),
        g.wedge(base, (0.8, 0.5, 0.6), 0.2, 0.5),
    ]
    yield ball, lambda p: naive_raycast.sphere(p, ball.center, ball.radius)
    yield can, lambda p: naive_raycast.cylinder(p, can.center, can.axis, can.radius, can.half_length)
    for body in bodies:
        yield body, lambda p, b=body: naive_raycast.half_spaces(p, b.normals, b.offsets)


@pytest.mark.parametrize("number", range(6))
def test_first_hits_are_those_of_sphere_tracing(number):
    rng = np.random.default_rng(number)
    shape, distance = list(shapes(rng))[number]
    start, direction = random_rays(rng, 120)
    t, face = shape.intersect(start, direction)
    wanted = np.array(
        [naive_raycast.trace(distance, o, d, FAR) for o, d in zip(start, direction, strict=True)]
    )
    grazing = np.isfinite(t) != np.isfinite(wanted)
    assert grazing.mean() < 0.02
    hit = np.isfinite(t) & ~grazing
    assert 20 < hit.sum() < 120
    assert t[hit] == pytest.approx(wanted[hit], abs=1e-6)
    assert g.may_hit(shape, start, direction)[np.isfinite(t)].all()
    for i in np.flatnonzero(hit)[:30]:
        point = start[i] + t[i] * direction[i]
        normal = shape.describe(point[None], int(face[i]))[0][0]
        assert np.linalg.norm(normal) == pytest.approx(1)
        assert normal @ direction[i] < 0
        outside, inside = distance(point + 1e-4 * normal), distance(point - 1e-4 * normal)
        assert outside == pytest.approx(1e-4, rel=0.05)
        assert inside < 0


def test_a_plane_is_met_where_its_equation_says():
    rng = np.random.default_rng(0)
    start, direction = random_rays(rng, 200)
    first, second = g.tangents(np.array([0.6, 0.0, 0.8]))
    plane = g.Plane(np.array([0.1, 0.2, 0.3]), first, second)
    assert plane.normal == pytest.approx([0.6, 0.0, 0.8])
    t, _ = plane.intersect(start, direction)
    hit = np.isfinite(t)
    assert 0 < hit.sum() < 200
    points = start[hit] + t[hit, None] * direction[hit]
    assert (points - plane.point) @ plane.normal == pytest.approx(np.zeros(hit.sum()), abs=1e-12)
    _, coords = plane.describe(points, 0)
    again = plane.point + coords[:, :1] * first + coords[:, 1:] * second
    assert again == pytest.approx(points, abs=1e-12)
    bounded = g.Plane(plane.point, first, second, (0.4, 0.2))
    inside = np.abs(coords) <= (0.4, 0.2)
    assert (np.isfinite(bounded.intersect(start, direction)[0])[hit] == inside.all(axis=1)).all()


def test_the_nearest_solid_wins_whatever_the_order():
    near = g.Solid(g.Sphere(np.array([0.0, 0.0, 2.0]), 0.5, np.eye(3)), GREY)
    far = g.Solid(g.Sphere(np.array([0.0, 0.0, 4.0]), 1.5, np.eye(3)), GREY)
    directions = np.array([[0.0, 0.0, 1.0], [0.3, 0.0, 1.0], [1.0, 0.0, 1.0]])
    for solids, numbers in (([near, far], [0, 1, -1]), ([far, near], [1, 0, -1])):
        hits = g.cast(solids, np.zeros(3), directions)
        assert hits.solid.tolist() == numbers
        assert hits.t[0] == pytest.approx(1.5)
        assert hits.t[2] == np.inf


def test_occluded_points_are_those_behind_something():
    ball = g.Solid(g.Sphere(np.array([0.0, 0.0, 2.0]), 0.5, np.eye(3)), GREY)
    wall = g.Solid(g.Plane(np.array([0.0, 0.0, 4.0]), np.array([1.0, 0, 0]), np.array([0, -1.0, 0])), GREY)
    points = np.array([[0.0, 0.0, 4.0], [3.0, 0.0, 4.0], [0.0, 0.0, 1.5]])
    assert g.occluded([ball, wall], points, np.zeros(3)).tolist() == [True, False, False]
    assert g.occluded([ball, wall], points, np.array([-3.0, 0.0, 0.0])).tolist() == [False, True, False]


def test_random_rotations_are_rotations():
    rng = np.random.default_rng(0)
    for _ in range(20):
        rotation = g.random_rotation(rng)
        assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)
