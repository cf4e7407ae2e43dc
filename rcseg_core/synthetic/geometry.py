"""Analytic ray casting: planes, convex polyhedra, spheres and cylinders, all in vectorised numpy.

A scene is a list of solids; every pixel is one ray; the nearest hit wins. Because each surface is a
formula, the truth (depth, normal, surface identity) is exact to rounding, so whatever error an evaluation
reports is the algorithm's own. With a pinhole ray direction (x, y, 1) the ray parameter t is the depth
along the optical axis itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .paint import Paint

Array = NDArray[np.float64]

UP = np.array([0.0, 0.0, 1.0])
NEAR_M = 1e-4
"""Hits closer than this along the ray are the origin itself."""


class Shape(Protocol):
    """A closed surface made of numbered faces."""

    @property
    def bounding_sphere(self) -> tuple[Array, float] | None:
        """Centre and radius of a sphere round the shape; None if it is unbounded."""

    def intersect(self, origin: Array, direction: Array) -> tuple[Array, NDArray[np.int16]]:
        """First hit of rays (N, 3): parameter t (N,), inf for a miss, and the number of the face (N,)."""

    def describe(self, points: Array, face: int) -> tuple[Array, Array]:
        """Outward unit normals (N, 3) and paint coordinates (N, 2 or 3) at points (N, 3) of one face."""


@dataclass(frozen=True)
class Solid:
    """A shape with one paint for each of its faces (a single paint serves all faces)."""

    shape: Shape
    paints: tuple[Paint, ...]
    name: str = ""

    def paint(self, face: int) -> Paint:
        return self.paints[face if len(self.paints) > 1 else 0]


@dataclass(frozen=True)
class Hits:
    """What every ray met: t (N,), inf where nothing; solid and face (N,), -1 where nothing."""

    t: Array
    solid: NDArray[np.int16]
    face: NDArray[np.int16]


def tangents(normal: Array) -> tuple[Array, Array]:
    """Two unit vectors that complete `normal` (3,) to an orthonormal frame."""
    helper = np.array([1.0, 0.0, 0.0]) if abs(normal[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first)
    return first, np.cross(normal, first)


def random_rotation(rng: np.random.Generator) -> Array:
    """A rotation matrix, uniform over all orientations (QR of a Gaussian matrix)."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


@dataclass(frozen=True)
class Plane:
    """A plane through `point`; paint coordinates are metres along `first` and `second`. `half_size` bounds
    it."""

    point: Array
    first: Array
    second: Array
    half_size: tuple[float, float] | None = None

    @property
    def normal(self) -> Array:
        return np.cross(self.first, self.second)

    @property
    def bounding_sphere(self) -> tuple[Array, float] | None:
        return None if self.half_size is None else (self.point, float(np.hypot(*self.half_size)))

    def intersect(self, origin: Array, direction: Array) -> tuple[Array, NDArray[np.int16]]:
        with np.errstate(divide="ignore", invalid="ignore"):
            t = ((self.point - origin) @ self.normal) / (direction @ self.normal)
        hit = np.isfinite(t) & (t > NEAR_M)
        if self.half_size is not None:
            local = origin + np.where(hit, t, 0.0)[:, None] * direction - self.point
            hit &= (np.abs(local @ self.first) <= self.half_size[0]) & (
                np.abs(local @ self.second) <= self.half_size[1]
            )
        return np.where(hit, t, np.inf), np.zeros(len(t), np.int16)

    def describe(self, points: Array, face: int) -> tuple[Array, Array]:
        local = points - self.point
        normals = np.broadcast_to(self.normal, points.shape)
        return normals, np.stack([local @ self.first, local @ self.second], axis=1)


@dataclass(frozen=True)
class Polyhedron:
    """The convex body {x: normals @ x <= offsets}; face i lies on plane i. `center` and `radius` bound it."""

    normals: Array
    offsets: Array
    center: Array
    radius: float

    @property
    def bounding_sphere(self) -> tuple[Array, float] | None:
        return self.center, self.radius

    def intersect(self, origin: Array, direction: Array) -> tuple[Array, NDArray[np.int16]]:
        n = len(direction)
        enter, leave = np.full(n, -np.inf), np.full(n, np.inf)
        face = np.zeros(n, np.int16)
        for i, (normal, offset) in enumerate(zip(self.normals, self.offsets, strict=True)):
            slope, gap = direction @ normal, offset - origin @ normal
            with np.errstate(divide="ignore", invalid="ignore"):
                t = gap / slope
            inward = (slope < 0) & (t > enter)
            enter[inward], face[inward] = t[inward], i
            leave = np.where(slope > 0, np.minimum(leave, t), leave)
            leave = np.where((slope == 0) & (gap < 0), -np.inf, leave)
        return np.where((enter <= leave) & (enter > NEAR_M), enter, np.inf), face

    def describe(self, points: Array, face: int) -> tuple[Array, Array]:
        normal = self.normals[face]
        first, second = tangents(normal)
        local = points - (self.center + (self.offsets[face] - self.center @ normal) * normal)
        return np.broadcast_to(normal, points.shape), np.stack([local @ first, local @ second], axis=1)


@dataclass(frozen=True)
class Sphere:
    """A ball; paint coordinates are the unit vector from the centre in the ball's own frame `rotation` (3,
    3)."""

    center: Array
    radius: float
    rotation: Array

    @property
    def bounding_sphere(self) -> tuple[Array, float] | None:
        return self.center, self.radius

    def intersect(self, origin: Array, direction: Array) -> tuple[Array, NDArray[np.int16]]:
        offset = origin - self.center
        a = np.einsum("ij,ij->i", direction, direction)
        b = np.einsum("ij,ij->i", direction, np.broadcast_to(offset, direction.shape))
        c = np.sum(offset * offset, axis=-1) - self.radius**2
        discriminant = b * b - a * c
        t = (-b - np.sqrt(np.maximum(discriminant, 0.0))) / a
        return np.where((discriminant >= 0) & (t > NEAR_M), t, np.inf), np.zeros(len(t), np.int16)

    def describe(self, points: Array, face: int) -> tuple[Array, Array]:
        normals = (points - self.center) / self.radius
        return normals, normals @ self.rotation.T


@dataclass(frozen=True)
class Cylinder:
    """A closed cylinder. Faces: 0 side (coordinates: arc length and height), 1 and 2 the caps at +axis and
    -axis."""

    center: Array
    axis: Array
    radius: float
    half_length: float

    @property
    def bounding_sphere(self) -> tuple[Array, float] | None:
        return self.center, float(np.hypot(self.radius, self.half_length))

    def intersect(self, origin: Array, direction: Array) -> tuple[Array, NDArray[np.int16]]:
        offset = np.broadcast_to(origin - self.center, direction.shape)
        along, height = direction @ self.axis, offset @ self.axis
        across = direction - along[:, None] * self.axis
        radial = offset - height[:, None] * self.axis
        a = np.einsum("ij,ij->i", across, across)
        b = np.einsum("ij,ij->i", across, radial)
        c = np.einsum("ij,ij->i", radial, radial) - self.radius**2
        discriminant = b * b - a * c
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (-b - np.sqrt(np.maximum(discriminant, 0.0))) / a
            side = (discriminant >= 0) & (t > NEAR_M) & (np.abs(height + t * along) <= self.half_length)
            best, face = np.where(side, t, np.inf), np.zeros(len(t), np.int16)
            for number, sign in ((1, 1.0), (2, -1.0)):
                t = (sign * self.half_length - height) / along
                cap = (a * t * t + 2 * b * t + c <= 0) & (t > NEAR_M) & (t < best)
                best, face = np.where(cap, t, best), np.where(cap, np.int16(number), face)
        return best, face

    def describe(self, points: Array, face: int) -> tuple[Array, Array]:
        first, second = tangents(self.axis)
        local = points - self.center
        if face:
            normals = np.broadcast_to(self.axis if face == 1 else -self.axis, points.shape)
            return normals, np.stack([local @ first, local @ second], axis=1)
        height = local @ self.axis
        normals = (local - height[:, None] * self.axis) / self.radius
        arc = self.radius * np.arctan2(normals @ second, normals @ first)
        return normals, np.stack([arc, height], axis=1)


def may_hit(shape: Shape, origin: Array, direction: Array) -> NDArray[np.bool_]:
    """Rays that pass the bounding sphere: (N,) bool. A cheap test that spares most rays the exact one."""
    bound = shape.bounding_sphere
    if bound is None:
        return np.ones(len(direction), bool)
    to_center = np.broadcast_to(bound[0] - origin, direction.shape)
    along = np.einsum("ij,ij->i", to_center, direction)
    squared = np.einsum("ij,ij->i", direction, direction)
    distance2 = np.einsum("ij,ij->i", to_center, to_center) - along * along / squared
    return np.asarray(distance2 <= (1.001 * bound[1]) ** 2)


def cast(solids: list[Solid], origin: Array, direction: Array) -> Hits:
    """Nearest hit of every ray.

    Parameters
    ----------
    solids : list of Solid
    origin : (3,) or (N, 3) float64, metres
    direction : (N, 3) float64; t counts in its length
    """
    n = len(direction)
    hits = Hits(np.full(n, np.inf), np.full(n, -1, np.int16), np.full(n, -1, np.int16))
    for number, solid in enumerate(solids):
        rays = np.flatnonzero(may_hit(solid.shape, origin, direction))
        if not len(rays):
            continue
        start = origin if origin.ndim == 1 else origin[rays]
        t, face = solid.shape.intersect(start, direction[rays])
        nearer = t < hits.t[rays]
        rays = rays[nearer]
        hits.t[rays], hits.solid[rays], hits.face[rays] = t[nearer], number, face[nearer]
    return hits


def occluded(solids: list[Solid], points: Array, eye: Array) -> NDArray[np.bool_]:
    """Points (N, 3) that `eye` (3,) cannot see because a solid lies between: (N,) bool."""
    direction = points - eye
    blocked = np.zeros(len(points), bool)
    for solid in solids:
        rays = np.flatnonzero(~blocked & may_hit(solid.shape, eye, direction))
        if len(rays):
            t, _ = solid.shape.intersect(eye, direction[rays])
            blocked[rays] = t < 1.0 - 2e-3
    return blocked


def box(base_center: Array, size: tuple[float, float, float], yaw: float) -> Polyhedron:
    """A box of `size` (length, width, height) that stands on `base_center`, turned by `yaw` about the
    vertical z."""
    axes = np.array([[np.cos(yaw), np.sin(yaw), 0.0], [-np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    center = np.asarray(base_center, float) + size[2] / 2 * UP
    normals = np.concatenate([axes, -axes])
    half = np.tile(np.asarray(size) / 2, 2)
    return Polyhedron(normals, normals @ center + half, center, float(np.linalg.norm(size) / 2))


def prism(
    base_center: Array, radius: float, height: float, sides: int, yaw: float, taper: float
) -> Polyhedron:
    """A regular prism (taper 0) or a frustum whose sides lean inward by the angle `taper` (rad); z is up."""
    center = np.asarray(base_center, float) + height / 2 * UP
    angle = yaw + 2 * np.pi * np.arange(sides) / sides
    side = np.stack(
        [np.cos(angle) * np.cos(taper), np.sin(angle) * np.cos(taper), np.full(sides, np.sin(taper))], 1
    )
    apothem = radius * np.cos(np.pi / sides)
    foot = np.asarray(base_center, float) + apothem * np.stack(
        [np.cos(angle), np.sin(angle), np.zeros(sides)], 1
    )
    normals = np.concatenate([side, [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
    offsets = np.concatenate([np.sum(side * foot, 1), [base_center[2] + height, -base_center[2]]])
    return Polyhedron(normals, offsets, center, float(np.hypot(radius, height / 2)))


def wedge(base_center: Array, size: tuple[float, float, float], yaw: float, slope: float) -> Polyhedron:
    """A box whose top falls away along its length by the angle `slope` (rad), from full height at the high
    end."""
    body = box(base_center, size, yaw)
    forward = body.normals[0]
    normal = np.sin(slope) * forward + np.cos(slope) * np.array([0.0, 0.0, 1.0])
    high_edge = np.asarray(base_center, float) - forward * size[0] / 2 + [0.0, 0.0, size[2]]
    normals, offsets = body.normals.copy(), body.offsets.copy()
    normals[2], offsets[2] = normal, normal @ high_edge
    return Polyhedron(normals, offsets, body.center, body.radius)
