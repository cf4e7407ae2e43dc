"""Rooms to drive in: a floor with a ramp, a low and a high step, a table above it, seen by a tilted camera.

The truth is what a robot that takes steps of `STEP_M` and inclines of `SLOPE_RAD` could stand on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .geometry import UP, Plane, Polyhedron, Solid, box, wedge
from .layouts import KINECT_SIGMA_INVERSE_M, Layout, camera_rotation, random_color, standing_plane
from .paint import Paint
from .scene import SyntheticScene, default_camera, observe
from .sensor import SensorOptions

Array = NDArray[np.float64]

FAMILY = "terrain"
STEP_M, SLOPE_RAD = 0.05, np.deg2rad(15.0)
LOW_STEP_M, HIGH_STEP_M = 0.03, 0.15
EITHER, GROUND, OBSTACLE = 0, 1, 2


@dataclass(frozen=True)
class Terrain:
    """A scene and where one may stand in it.

    Attributes
    ----------
    scene : SyntheticScene
    ground : (H, W) uint8: 1 ground, 2 obstacle, 0 either (no surface there, or an obstacle's foot, which is
        within a step of the ground)
    floor : (H, W) bool, the floor itself
    up : (3,) float64, up in the camera's frame
    """

    scene: SyntheticScene
    ground: NDArray[np.uint8]
    floor: NDArray[np.bool_]
    up: Array


def make_terrain(
    seed: int, *, width: int = 640, height: int = 480, options: SensorOptions | None = None
) -> Terrain:
    """Draw and render one room.

    Parameters
    ----------
    seed : int
    width, height : int, pixels
    options : SensorOptions, optional, how it is seen

    Raises
    ------
    InputError
        For an option out of range.
    """
    options = SensorOptions() if options is None else options
    options.check(FAMILY, True)
    rng = np.random.default_rng([seed, *FAMILY.encode()])
    solids = _solids(rng)
    position = np.array([0.0, 0.0, rng.uniform(0.6, 1.5)])
    pitch = np.arctan2(position[2] - rng.uniform(0.0, 0.3), rng.uniform(1.4, 2.2))
    rotation = camera_rotation(rng.uniform(-0.2, 0.2), float(pitch), rng.uniform(-0.2, 0.2))
    layout = Layout(solids, rotation, position, KINECT_SIGMA_INVERSE_M)
    scene = observe(layout, default_camera(width, height), (height, width), options, family=FAMILY, seed=seed)
    return Terrain(scene, _truth(scene, solids), _is_one_of(scene, solids, ("floor",)), rotation @ UP)


def _solids(rng: np.random.Generator) -> list[Solid]:
    x = np.array([1.0, 0.0, 0.0])
    solids = [_painted(rng, Plane(np.zeros(3), x, np.array([0.0, 1.0, 0.0])), "floor")]
    solids.append(standing_plane(np.array([0.0, rng.uniform(3.4, 4.2), 0.0]), x, _paint(rng), "wall"))
    places = rng.permutation([-0.95, 0.0, 0.95])
    ahead = rng.uniform(1.5, 2.0, 3)
    sizes = rng.uniform([0.35, 0.35], [0.6, 0.5], (2, 2))
    for place, y, size, rise, name in zip(
        places[:2], ahead, sizes, (LOW_STEP_M, HIGH_STEP_M), ("low step", "high step"), strict=False
    ):
        base, yaw = np.array([place, y, 0.0]), rng.uniform(-0.4, 0.4)
        solids.append(_painted(rng, box(base, (float(size[0]), float(size[1]), rise), yaw), name))
    solids += _ramp(rng, np.array([places[2], ahead[2], 0.0]))
    return solids + _table(rng, np.array([rng.uniform(-0.6, 0.6), 2.8, 0.0]))


def _ramp(rng: np.random.Generator, base: Array) -> list[Solid]:
    """A ramp that rises away from the camera, to a platform in half of the rooms."""
    length, breadth, slope = rng.uniform(0.7, 1.0), rng.uniform(0.45, 0.6), np.deg2rad(rng.uniform(6.0, 11.0))
    rise = float(length * np.tan(slope)) + 0.002
    solids = [_painted(rng, wedge(base, (length, breadth, rise), -np.pi / 2, float(slope)), "ramp")]
    if rng.random() < 0.5:
        behind = base + np.array([0.0, length / 2 + 0.2, 0.0])
        solids.append(_painted(rng, box(behind, (breadth, 0.4, rise), 0.0), "platform"))
    return solids


def _table(rng: np.random.Generator, base: Array) -> list[Solid]:
    half, rise = rng.uniform([0.35, 0.25], [0.5, 0.35]), float(rng.uniform(0.45, 0.7))
    solids = [_painted(rng, box(base + (rise - 0.03) * UP, (2 * half[0], 2 * half[1], 0.03), 0.0), "table")]
    for sx in (-1, 1):
        for sy in (-1, 1):
            foot = base + np.array([sx * (half[0] - 0.03), sy * (half[1] - 0.03), 0.0])
            solids.append(_painted(rng, box(foot, (0.05, 0.05, rise - 0.03), 0.0), "leg"))
    return solids


def _painted(rng: np.random.Generator, shape: Plane | Polyhedron, name: str) -> Solid:
    return Solid(shape, (_paint(rng),), name)


def _paint(rng: np.random.Generator) -> Paint:
    return Paint(random_color(rng))


def _is_one_of(scene: SyntheticScene, solids: list[Solid], names: tuple[str, ...]) -> NDArray[np.bool_]:
    numbers = [i + 1 for i, solid in enumerate(solids) if solid.name in names]
    return np.isin(scene.object_labels, numbers)


def _truth(scene: SyntheticScene, solids: list[Solid]) -> NDArray[np.uint8]:
    rotation, position = scene.pose[:3, :3], scene.pose[:3, 3]
    height_m = scene.clean_points @ rotation[2] + position[2]
    flat = scene.normals @ rotation[2] >= np.cos(SLOPE_RAD)
    ground = _is_one_of(scene, solids, ("floor", "low step"))
    ground |= _is_one_of(scene, solids, ("ramp", "platform")) & flat
    obstacle = ~ground & (height_m > STEP_M)  # False where there is no surface
    return np.where(ground, GROUND, np.where(obstacle, OBSTACLE, EITHER)).astype(np.uint8)
