"""Planes, spheres and cylinders as a fit sees them: distances, their derivatives, steps, first guesses.

A shape is a kind and a vector. Unit vectors among its parameters are moved by two tilts, so that a fit has no
constraint to keep and a covariance no direction that does not exist.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.models.triangular import solve_triangular
from rcseg_core.shapes.distances import CYLINDER, FREEDOM, PLANE, SPHERE, _complete, _equations, _miss
from rcseg_core.shapes.spread import spread_of

Array = NDArray[np.float64]

#: Names of `PLANE`, `SPHERE`, `CYLINDER`.
KINDS = ("plane", "sphere", "cylinder")
STEPS = 15


class Shape(NamedTuple):
    """One primitive.

    kind : PLANE (normal . (x - point) = 0), SPHERE (|x - point| = radius) or CYLINDER (distance radius from
        the axis through point)
    point : (3,) m; on the plane, the centre, or on the axis at the height of `middle`
    direction : (3,) unit normal or axis; any unit vector for a sphere
    radius : m; 0 for a plane
    middle : (3,) m, of the surface, from which `point` is chosen
    """

    kind: int
    point: Array
    direction: Array
    radius: float
    middle: Array


class Residuals(NamedTuple):
    """Of m cells: distance along the way of the noise over its noise, the noise as a distance from the shape
    in m, gradients of the distance (m, 3)."""

    whitened: Array
    sigma: Array
    gradients: Array


@bare
def _step(kind, vector, frame, step, out):  # type: ignore[no-untyped-def]
    """The shape after a step: see `fit_shape`."""
    for i in range(10):
        out[i] = vector[i]
    if kind == SPHERE:
        for i in range(3):
            out[i] += step[i]
        out[6] += step[3]
        return
    tilt = 0 if kind == PLANE else 2
    length = 0.0
    for i in range(3):
        if kind == PLANE:
            out[i] += step[2] * vector[3 + i]
        else:
            out[i] += step[0] * frame[0, i] + step[1] * frame[1, i]
        out[3 + i] += step[tilt] * frame[0, i] + step[tilt + 1] * frame[1, i]
        length += out[3 + i] ** 2
    slide = 0.0
    for i in range(3):
        out[3 + i] /= np.sqrt(length)
    if kind == CYLINDER:
        out[6] += step[4]
        for i in range(3):
            slide += out[3 + i] * (out[7 + i] - out[i])
        for i in range(3):
            out[i] += slide * out[3 + i]


@bare
def _factor(gram, q, damping, root):  # type: ignore[no-untyped-def]
    """Cholesky root of the damped lower triangle; False where it is singular to rounding."""
    for a in range(q):
        for b in range(a + 1):
            total = gram[a, b] * (1.0 + damping if a == b else 1.0)
            for c in range(b):
                total -= root[a, c] * root[b, c]
            if a == b:
                if not total > 1e-13 * gram[a, a]:
                    return False
                root[a, a] = np.sqrt(total)
            else:
                root[a, b] = total / root[b, b]
    return True


@bare
def _fit(kind, vector, points, spread, limit, trial, frame, table, rows, covariance):  # type: ignore[no-untyped-def]
    """Levenberg-Marquardt from `vector`, in place; False where no minimum with a curvature was found.

    trial (10,), frame (2, 3), table (3, 5, 5), rows (5, 5) : scratch; covariance (q, q) : out
    """
    q = FREEDOM[kind]
    gram, other, root = table[0], table[1], table[2]
    right, right_other, row, step, gradient = rows[0], rows[1], rows[2], rows[3], rows[4]
    _complete(vector[3:6], frame)
    cost = _equations(kind, vector, frame, points, spread, limit, gram, right, row, gradient)
    damping = 1e-4
    for _ in range(STEPS):
        if not _factor(gram, q, damping, root):
            damping = max(30.0 * damping, 1e-4)
            if damping > 1e4:
                break
            continue
        solve_triangular(root, q, right, step)
        for a in range(q):
            step[a] = -step[a]
        _step(kind, vector, frame, step, trial)
        _complete(trial[3:6], frame)
        after = _equations(kind, trial, frame, points, spread, limit, other, right_other, row, gradient)
        if after < cost:
            done = cost - after < 1e-5 * cost
            cost = after
            for a in range(10):
                vector[a] = trial[a]
            for a in range(q):
                right[a] = right_other[a]
                for b in range(a + 1):
                    gram[a, b] = other[a, b]
            damping *= 0.03
            if done:
                break
        else:
            _complete(vector[3:6], frame)
            if not after > cost * (1.0 + 1e-9) or damping > 1e4:
                break
            damping *= 30.0
    if not _factor(gram, q, 0.0, root):  # gram is that of the best step
        return False
    for a in range(q):
        for b in range(q):
            right[b] = 1.0 if a == b else 0.0
        solve_triangular(root, q, right, step)
        for b in range(q):
            covariance[a, b] = step[b]
    return True


@bare
def _residuals(kind, vector, frame, points, spread, row, whitened, sigma, gradients):  # type: ignore[no-untyped-def]
    for i in range(points.shape[0]):
        whitened[i], sigma[i] = _miss(kind, vector, frame, points[i], spread[i], row, gradients[i])


def shape_vector(shape: Shape) -> Array:
    return np.concatenate([shape.point, shape.direction, [shape.radius], shape.middle])


def residuals(shape: Shape, points: Array, spread: Array) -> Residuals:
    """How measurements miss a shape.

    Parameters
    ----------
    points : (m, 3) float64, m
    spread : (m, 3, k) float64, the error of a point is ``spread @ e`` with e (k,) white and unit; k = 1 for
        noise along a ray, 3 otherwise
    """
    m = len(points)
    out = Residuals(np.empty(m), np.empty(m), np.empty((m, 3)))
    frame = np.empty((2, 3))
    _complete(shape.direction, frame)
    _residuals(shape.kind, shape_vector(shape), frame, points, spread, np.empty(5), *out)
    return out


def fit_shape(shape: Shape, points: Array, spread: Array, limit: Array) -> tuple[Shape, Array] | None:
    """The least-squares shape next to `shape`, by Levenberg-Marquardt.

    Parameters
    ----------
    points, spread : see `residuals`
    limit : (m,) whitened distance beyond which a point pulls no harder

    Returns
    -------
    The shape and the (q, q) covariance of its local parameters from the noise alone; None where the points do
    not determine it. The local parameters are: plane, two tilts about its point and a shift; sphere, centre
    and radius; cylinder, two shifts and two tilts of the axis, and the radius.
    """
    vector, q = shape_vector(shape), FREEDOM[shape.kind]
    covariance = np.empty((q, q))
    scratch = np.empty(10), np.empty((2, 3)), np.empty((3, 5, 5)), np.empty((5, 5))
    if not _fit(shape.kind, vector, points, spread, limit, *scratch, covariance):
        return None
    found = shape._replace(point=vector[:3], direction=vector[3:6], radius=float(vector[6]))
    return (found, covariance) if np.isfinite(vector).all() else None


def across(direction: Array) -> Array:
    """(2, 3) the directions of the tilts of a unit vector."""
    frame = np.empty((2, 3))
    _complete(direction, frame)
    return frame


def parameters(shape: Shape) -> dict[str, Array]:
    """What users read, by name: see `primitives.Primitive`."""
    if shape.kind == PLANE:
        return {"normal": shape.direction, "distance": np.asarray(shape.direction @ shape.point)}
    if shape.kind == SPHERE:
        return {"center": shape.point, "radius": np.asarray(shape.radius)}
    return {"point": shape.point, "axis": shape.direction, "radius": np.asarray(shape.radius)}


def transfer(shape: Shape) -> Array:
    """Derivatives of all `parameters`, in order, by the local ones: (4, 3), (4, 4) or (7, 5)."""
    if shape.kind == SPHERE:
        return np.eye(4)
    frame = across(shape.direction)
    if shape.kind == PLANE:
        out = np.zeros((4, 3))
        out[:3, :2] = frame.T
        out[3, :2] = frame @ shape.point
        out[3, 2] = 1.0
        return out
    out = np.zeros((7, 5))
    out[:3, :2] = frame.T
    out[3:6, 2:4] = frame.T
    out[6, 4] = 1.0
    return out


def start_plane(points: Array, weight: Array) -> Shape:
    """Plane of the points' least spread, its normal towards the sensor; weight (m,) sums to 1."""
    middle, spread = spread_of(points, weight)
    normal = np.linalg.eigh(spread)[1][:, 0]
    return Shape(PLANE, middle, -normal if normal @ middle > 0 else normal, 0.0, middle)


def start_sphere(points: Array, weight: Array) -> Shape | None:
    """Sphere by linear least squares; None where the points lie on a plane."""
    middle = weight @ points
    ball = _round(points - middle, weight)
    if ball is None:
        return None
    return Shape(SPHERE, middle + ball[0], np.array([0.0, 0.0, 1.0]), ball[1], middle)


def start_cylinder(points: Array, normals: Array, weight: Array) -> Shape | None:
    """The better of two axes, with a circle across it; None where that is a line.

    One is where no normal points, which is right for any arc, the other where a quadric over the best plane
    bends least, which the noise of single normals does not disturb.
    """
    middle = weight @ points
    local = points - middle
    axes = [np.linalg.eigh(normals.T @ (normals * weight[:, None]))[1][:, 0], _straightest(local, weight)]
    best, least = None, np.inf
    for axis in axes:
        frame = across(axis)
        flat = local @ frame.T
        circle = _round(flat, weight)
        if circle is None:
            continue
        cost = float(weight @ (np.sqrt(np.sum((flat - circle[0]) ** 2, axis=1)) - circle[1]) ** 2)
        if cost < least:
            best, least = Shape(CYLINDER, middle + circle[0] @ frame, axis, circle[1], middle), cost
    return best


def _straightest(local: Array, weight: Array) -> Array:
    """Direction (3,) in which points about their mean bend least out of their best plane."""
    basis = np.linalg.eigh(local.T @ (local * weight[:, None]))[1]
    height, s, t = (local @ basis).T
    table = np.stack([np.ones_like(s), s, t, 0.5 * s * s, s * t, 0.5 * t * t], axis=1)
    gram = table.T @ (table * weight[:, None])
    gram += np.diag(1e-12 * np.diag(gram) + 1e-300)
    bend = np.linalg.solve(gram, table.T @ (height * weight))[3:]
    curvatures, directions = np.linalg.eigh(np.array([[bend[0], bend[1]], [bend[1], bend[2]]]))
    return np.asarray(basis[:, 1:] @ directions[:, int(np.argmin(np.abs(curvatures)))])


def _round(points: Array, weight: Array) -> tuple[Array, float] | None:
    """Centre and radius of |x|^2 = 2 c.x + (r^2 - |c|^2) by linear least squares, in any dimension."""
    table = np.concatenate([2.0 * points, np.ones((len(points), 1))], axis=1)
    square = np.einsum("mi,mi->m", points, points)
    gram, right = table.T @ (table * weight[:, None]), table.T @ (square * weight)
    size = np.sqrt(np.diag(gram))
    if not (size > 0).all():
        return None
    gram = gram / np.outer(size, size)
    if np.linalg.eigvalsh(gram)[0] < 1e-10:
        return None
    answer = np.linalg.solve(gram, right / size) / size
    radius2 = answer[-1] + answer[:-1] @ answer[:-1]
    return (answer[:-1], float(np.sqrt(radius2))) if radius2 > 0 else None
