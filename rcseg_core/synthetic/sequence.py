"""A moving camera over a table with boxes, a cylinder and a ball: the demo recording, with truth for every
frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rcseg_core.errors import InputError

from .geometry import UP, Plane, Solid, box
from .layouts import (
    KINECT_SIGMA_INVERSE_M,
    Footprints,
    Layout,
    camera_rotation,
    painted_ball,
    painted_box,
    painted_cylinder,
    random_color,
    standing_plane,
)
from .paint import Paint
from .scene import SyntheticScene, default_camera, observe
from .sensor import SensorOptions

Array = NDArray[np.float64]

TABLE_HALF_M = (0.55, 0.4)
TABLE_HEIGHT_M = 0.72
FAMILY = "tabletop"


def make_tabletop_sequence(
    frames: int,
    seed: int,
    *,
    width: int = 320,
    height: int = 240,
    sweep_rad: float = 0.7,
    options: SensorOptions | None = None,
) -> list[SyntheticScene]:
    """Frames of one scene along an arc round the table.

    `object_labels` are the same object in every frame and `pose` is the camera's pose in the world (z up,
    origin on the floor under the middle of the table); `labels` and `surface_labels` are numbered frame by
    frame.

    Parameters
    ----------
    frames : int
        Their number, at least 1.
    seed : int
    width, height : int, pixels
    sweep_rad : float
        Angle of the arc that the camera travels.
    options : SensorOptions, optional
        By default shaded, with 1 % drop-out and disparity steps of 1/8 px.

    Raises
    ------
    InputError
        Fewer than one frame, or an option out of range.
    """
    if frames < 1:
        raise InputError(f"make_tabletop_sequence: {frames} frames were asked for; at least 1 is needed")
    options = SensorOptions(dropout=0.01, quantization=0.125, shading=True) if options is None else options
    options.check(FAMILY, True)
    rng = np.random.default_rng([seed, *FAMILY.encode()])
    solids = table_scene(rng)
    start, rise = rng.uniform(-0.2, 0.2) - sweep_rad / 2, rng.uniform(-0.1, 0.15)
    radius, height_m = rng.uniform(0.8, 0.95), TABLE_HEIGHT_M + rng.uniform(0.45, 0.55)
    camera = default_camera(width, height)
    scenes = []
    for shot in range(frames):
        share = shot / max(frames - 1, 1)
        rotation, position = _orbit(start + share * sweep_rad, radius, height_m + share * rise)
        layout = Layout(solids, rotation, position, KINECT_SIGMA_INVERSE_M)
        scenes.append(observe(layout, camera, (height, width), options, family=FAMILY, seed=seed, shot=shot))
    return scenes


def _orbit(angle: float, radius: float, height_m: float) -> tuple[Array, Array]:
    """A camera on a circle round the table that looks at a point a little above its middle."""
    position = np.array([-radius * np.sin(angle), -radius * np.cos(angle), height_m])
    pitch = np.arctan2(height_m - (TABLE_HEIGHT_M + 0.05), radius)
    return camera_rotation(angle, float(pitch), 0.0), position


def table_scene(rng: np.random.Generator) -> list[Solid]:
    """Table, floor and wall, then up to three boxes, a cylinder and a ball on the table."""
    top, x, y = np.array([0.0, 0.0, TABLE_HEIGHT_M]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    solids = [
        Solid(Plane(top, x, y, TABLE_HALF_M), (Paint(random_color(rng)),), "table"),
        Solid(Plane(np.zeros(3), x, y), (Paint(random_color(rng)),), "floor"),
        standing_plane(np.array([0.0, 1.3, 0.0]), x, Paint(random_color(rng)), "wall"),
    ]
    half_x, half_y = TABLE_HALF_M
    edge = 0.02

    def on_table(point: Array, radius: float) -> bool:
        return bool(abs(point[0]) + radius + edge < half_x and abs(point[1]) + radius + edge < half_y)

    places = Footprints(rng, on_table)
    for kind in ("box", "box", "box", "cylinder", "ball"):
        size = tuple(rng.uniform([0.1, 0.07, 0.08], [0.24, 0.16, 0.24]))
        reach = float(np.hypot(size[0], size[1]) / 2) if kind == "box" else size[1] / 2
        base = places.drop(reach, (half_x, half_y))
        if base is None:
            continue
        base = base + top
        if kind == "box":
            solids.append(painted_box(rng, box(base, size, rng.uniform(0, np.pi)), size))
        elif kind == "cylinder":
            solids.append(painted_cylinder(rng, base + size[2] / 2 * UP, UP, reach, size[2] / 2))
        else:
            solids.append(painted_ball(rng, base + reach * UP, reach))
    return solids
