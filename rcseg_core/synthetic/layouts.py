"""Random layouts of the five families: which solids stand where, in which colours, seen from where.

Each draw is meant to be plausible for a robot or for the paper's scanner, not easy: boxes turn by any
angle, colours of different objects may coincide (depth tells them apart), while regions painted on one
surface differ clearly, since nothing but colour separates them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .geometry import UP, Cylinder, Plane, Polyhedron, Solid, Sphere, box, prism, random_rotation, wedge
from .paint import Paint, PaintedRegion, distinct_colors, ellipse, rectangle
from .scanner import billiard, painting

Array = NDArray[np.float64]

KINECT_SIGMA_INVERSE_M = 1.425e-3
"""Khoshelham & Elberink 2012: sigma_z = 1.425e-3 z^2, so that 1/z has this constant sigma in 1/m."""


@dataclass(frozen=True)
class Layout:
    """Solids in world coordinates (z up) and the pose they are seen from.

    `rotation` (3, 3): rows are the camera's right, down and forward in the world; `position` (3,), metres.
    `sigma`: range noise; in 1/m (inverse depth) for cameras, in metres for scanner grids.
    `image_height_m`: for scanner grids the height of the image in metres, else None.
    """

    solids: list[Solid]
    rotation: Array
    position: Array
    sigma: float
    image_height_m: float | None = None


def camera_rotation(yaw: float, pitch: float, roll: float) -> Array:
    """Rows right, down, forward of a camera that looks along world +y, turned right by yaw, down by pitch
    (rad)."""
    forward = np.array([np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), -np.sin(pitch)])
    right = np.array([np.cos(yaw), -np.sin(yaw), 0.0])
    down = np.cross(forward, right)
    turn = np.array([[np.cos(roll), np.sin(roll), 0.0], [-np.sin(roll), np.cos(roll), 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(turn @ np.stack([right, down, forward]))


def aimed_pose(
    rng: np.random.Generator, heights: tuple[float, float], distances: tuple[float, float]
) -> tuple[Array, Array]:
    """Rotation and position of a camera over the origin that looks at a point ahead of it, a hand above the
    floor."""
    height, distance = rng.uniform(*heights), rng.uniform(*distances)
    pitch = np.arctan((height - rng.uniform(0.1, 0.5)) / distance)
    rotation = camera_rotation(rng.uniform(-0.2, 0.2), pitch, rng.uniform(-0.05, 0.05))
    return rotation, np.array([0.0, 0.0, height])


def random_color(rng: np.random.Generator) -> Array:
    return rng.uniform(40, 230, 3)


class Footprints:
    """Places objects on the floor so that their footprints (circles) neither overlap nor leave the free
    area."""

    def __init__(self, rng: np.random.Generator, free: Callable[[Array, float], bool]) -> None:
        self.rng, self.free = rng, free
        self.taken: list[tuple[Array, float]] = []

    def place(self, radius: float, near: float, far: float, spread: float) -> Array | None:
        """A free base point (3,) at a distance near..far ahead, sideways up to spread * distance; None if
        full."""
        return self._try(radius, lambda: self._ahead(near, far, spread))

    def drop(self, radius: float, half: tuple[float, float]) -> Array | None:
        """A free base point (3,) within a rectangle round the origin; None if full."""
        return self._try(radius, lambda: np.append(self.rng.uniform(-1, 1, 2) * half, 0.0))

    def _ahead(self, near: float, far: float, spread: float) -> Array:
        ahead = self.rng.uniform(near, far)
        return np.array([self.rng.uniform(-spread, spread) * ahead, ahead, 0.0])

    def _try(self, radius: float, draw: Callable[[], Array]) -> Array | None:
        for _ in range(60):
            point = draw()
            clear = all(np.linalg.norm(point - other) > radius + r + 0.02 for other, r in self.taken)
            if clear and self.free(point, radius):
                self.taken.append((point, radius))
                return point
        return None


def painted_box(rng: np.random.Generator, body: Polyhedron, size: tuple[float, float, float]) -> Solid:
    """A box with one colour, or one for each face, now and then with a printed label on its faces."""
    many = rng.random() < 0.35
    color = random_color(rng)
    paints = []
    for _ in range(len(body.normals)):
        base = random_color(rng) if many else color
        regions: tuple[PaintedRegion, ...] = ()
        if rng.random() < 0.2:
            half = 0.5 * min(size) * rng.uniform(0.35, 0.7, 2)
            regions = ((rectangle((0.0, 0.0), (half[0], half[1])), distinct_colors(rng, 1, avoid=base)[0]),)
        paints.append(Paint(base, regions))
    return Solid(body, tuple(paints), "box")


def painted_ball(rng: np.random.Generator, center: Array, radius: float) -> Solid:
    """A ball of one colour, or of two halves."""
    base = random_color(rng)
    regions: tuple[PaintedRegion, ...] = ()
    if rng.random() < 0.3:
        regions = ((lambda coords: coords[:, 2] > 0, distinct_colors(rng, 1, avoid=base)[0]),)
    return Solid(Sphere(center, radius, random_rotation(rng)), (Paint(base, regions),), "ball")


def painted_cylinder(
    rng: np.random.Generator, center: Array, axis: Array, radius: float, half: float
) -> Solid:
    """A cylinder of one colour, or with a label round its middle; the caps have the base colour."""
    base = random_color(rng)
    side = Paint(base)
    if rng.random() < 0.3:
        low, high = half * rng.uniform(-0.6, -0.2), half * rng.uniform(0.2, 0.6)
        color = distinct_colors(rng, 1, avoid=base)[0]
        side = Paint(base, ((lambda coords: (coords[:, 1] > low) & (coords[:, 1] < high), color),))
    return Solid(Cylinder(center, axis, radius, half), (side, Paint(base), Paint(base)), "cylinder")


def standing_plane(point: Array, along: Array, paint: Paint, name: str) -> Solid:
    """A wall through `point`; `along` is its horizontal direction, with the free side at along x up."""
    return Solid(Plane(point, along, UP), (paint,), name)


def _walls(
    rng: np.random.Generator, back: float, sides: tuple[float, float]
) -> tuple[list[Solid], Array, Array]:
    yaw = rng.uniform(-0.45, 0.45)
    along = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    away = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    color = random_color(rng)
    colors = [color if rng.random() < 0.4 else random_color(rng) for _ in range(3)]
    poster: tuple[PaintedRegion, ...] = ()
    if rng.random() < 0.5:
        half = (rng.uniform(0.2, 0.5), rng.uniform(0.15, 0.4))
        middle = (rng.uniform(-0.8, 0.8), rng.uniform(0.5, 1.4))
        poster = ((rectangle(middle, half), distinct_colors(rng, 1, avoid=colors[0])[0]),)
    walls = [
        standing_plane(back * away, along, Paint(colors[0], poster), "wall"),
        standing_plane(-sides[0] * along, away, Paint(colors[1]), "wall"),
        standing_plane(sides[1] * along, -away, Paint(colors[2]), "wall"),
    ]
    return walls, along, away


def _floor(rng: np.random.Generator, rug_ahead: tuple[float, float]) -> Solid:
    base = random_color(rng)
    rug: tuple[PaintedRegion, ...] = ()
    if rng.random() < 0.4:
        middle, half = (rng.uniform(-0.6, 0.6), rng.uniform(*rug_ahead)), tuple(rng.uniform(0.25, 0.7, 2))
        shape = (
            rectangle(middle, half, rng.uniform(0, np.pi)) if rng.random() < 0.6 else ellipse(middle, half)
        )
        rug = ((shape, distinct_colors(rng, 1, avoid=base)[0]),)
    plane = Plane(np.zeros(3), np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]))
    return Solid(plane, (Paint(base, rug),), "floor")


def room(rng: np.random.Generator) -> Layout:
    """Floor, three walls, boxes (one may carry another), a standing cylinder and a ball, as a robot sees
    them."""
    back, sides = rng.uniform(2.2, 3.5), (rng.uniform(0.9, 2.0), rng.uniform(0.9, 2.0))
    walls, along, away = _walls(rng, back, sides)

    def inside(point: Array, radius: float) -> bool:
        across, ahead = point @ along, point @ away
        return bool(ahead + radius < back and -sides[0] < across - radius and across + radius < sides[1])

    places = Footprints(rng, inside)
    solids = [_floor(rng, (1.0, 2.2)), *walls]
    for _ in range(rng.integers(2, 4)):
        size = (rng.uniform(0.2, 0.6), rng.uniform(0.15, 0.5), rng.uniform(0.15, 0.6))
        base = places.place(float(np.hypot(size[0], size[1]) / 2), 1.2, back, 0.5)
        if base is None:
            continue
        yaw = rng.uniform(0, np.pi)
        solids.append(painted_box(rng, box(base, size, yaw), size))
        if rng.random() < 0.3 and size[2] < 0.4:
            upper = (size[0] * rng.uniform(0.4, 0.7), size[1] * rng.uniform(0.4, 0.7), rng.uniform(0.1, 0.3))
            top = base + size[2] * UP
            solids.append(painted_box(rng, box(top, upper, yaw + rng.uniform(-0.3, 0.3)), upper))
    radius, half = rng.uniform(0.06, 0.18), rng.uniform(0.12, 0.4)
    if (base := places.place(radius, 1.1, back, 0.5)) is not None:
        solids.append(painted_cylinder(rng, base + half * UP, UP, radius, half))
    radius = rng.uniform(0.08, 0.22)
    if (base := places.place(radius, 1.0, back, 0.5)) is not None:
        solids.append(painted_ball(rng, base + radius * UP, radius))
    return Layout(solids, *aimed_pose(rng, (0.5, 1.4), (1.4, 2.6)), KINECT_SIGMA_INVERSE_M)


def blocks(rng: np.random.Generator) -> Layout:
    """Boxes, prisms, frusta and wedges on a floor before a wall, all of one grey: only geometry tells them
    apart."""
    grey = Paint(np.full(3, rng.uniform(110, 190)))
    back = rng.uniform(1.5, 2.4)
    places = Footprints(rng, lambda point, radius: bool(point[1] + radius + 0.3 * abs(point[0]) < back))
    floor = Plane(np.zeros(3), np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]))
    yaw = rng.uniform(-0.3, 0.3)
    wall = standing_plane(np.array([0.0, back, 0.0]), np.array([np.cos(yaw), np.sin(yaw), 0.0]), grey, "wall")
    solids = [Solid(floor, (grey,), "floor"), wall]
    for _ in range(rng.integers(2, 5)):
        size = tuple(rng.uniform([0.14, 0.12, 0.1], [0.38, 0.3, 0.35]))
        radius = float(np.hypot(size[0], size[1]) / 2)
        base = places.place(radius, 0.75, back, 0.5)
        if base is None:
            continue
        kind, turn = rng.choice(["box", "prism", "frustum", "wedge"]), rng.uniform(0, 2 * np.pi)
        if kind == "box":
            shape = box(base, size, turn)
        elif kind == "wedge":
            slope = rng.uniform(0.4, 0.85)
            shape = wedge(base, size, turn, min(slope, float(np.arctan(0.9 * size[2] / size[0]))))
        else:
            taper = 0.0 if kind == "prism" else rng.uniform(0.2, 0.5)
            shape = prism(
                base,
                radius,
                min(size[2], 0.5 * radius / max(np.tan(taper), 1e-3)),
                int(rng.integers(3, 7)),
                turn,
                taper,
            )
        solids.append(Solid(shape, (grey,), str(kind)))
    return Layout(solids, *aimed_pose(rng, (0.55, 1.1), (0.9, 1.4)), KINECT_SIGMA_INVERSE_M)


def curved(rng: np.random.Generator) -> Layout:
    """Balls and cylinders, standing, lying or leaning, before a wall, with a floor in two of three scenes."""
    back = rng.uniform(1.5, 2.6)
    yaw = rng.uniform(-0.4, 0.4)
    along = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    solids = [standing_plane(np.array([0.0, back, 0.0]), along, Paint(random_color(rng)), "wall")]
    with_floor = rng.random() < 0.67
    if with_floor:
        solids.append(_floor(rng, (0.8, 1.6)))
    places = Footprints(rng, lambda point, radius: bool(point[1] + radius + 0.45 * abs(point[0]) < back))
    for kind in rng.permutation(["ball"] * rng.integers(2, 5) + ["cylinder"] * rng.integers(2, 4)):
        if kind == "ball":
            radius = reach = rng.uniform(0.07, 0.22)
        else:
            radius, half = rng.uniform(0.05, 0.14), rng.uniform(0.12, 0.32)
            pose = rng.choice(["standing", "lying", "leaning"], p=[0.5, 0.3, 0.2])
            reach = radius if pose == "standing" else float(np.hypot(radius, half))
        base = places.place(reach, 0.9, back, 0.5)
        if base is None:
            continue
        lift = UP * (0.0 if with_floor else rng.uniform(0.0, 0.5))
        if kind == "ball":
            solids.append(painted_ball(rng, base + lift + radius * UP, radius))
            continue
        tilt = {"standing": 0.0, "lying": np.pi / 2, "leaning": rng.uniform(0.3, 1.0)}[str(pose)]
        heading = rng.uniform(0, 2 * np.pi)
        axis = np.array([np.sin(tilt) * np.cos(heading), np.sin(tilt) * np.sin(heading), np.cos(tilt)])
        height = half * np.cos(tilt) + radius * np.sin(tilt)
        solids.append(painted_cylinder(rng, base + lift + height * UP, axis, radius, half))
    return Layout(solids, *aimed_pose(rng, (0.45, 0.9), (1.0, 1.6)), KINECT_SIGMA_INVERSE_M)


def scanner_layout(solids: list[Solid], image_height_m: float, sigma_m: float) -> Layout:
    """A layout in the scanner's own axes: x right, y down, z away from it."""
    return Layout(solids, np.eye(3), np.zeros(3), sigma_m, image_height_m)


BUILDERS: dict[str, Callable[[np.random.Generator], Layout]] = {
    "billiard": lambda rng: scanner_layout(*billiard(rng)),
    "painting": lambda rng: scanner_layout(*painting(rng)),
    "room": room,
    "blocks": blocks,
    "curved": curved,
}
