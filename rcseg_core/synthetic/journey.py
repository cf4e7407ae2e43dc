"""Long sequences for tracking: a camera that wanders and looks away, things that are moved, go and come back.

The truth names the same thing by the same number in every frame. A truth surface is a connected part of one
face; it keeps the number of the part that most of its own points were on before, whatever hid it meanwhile.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_core.errors import InputError

from .geometry import Plane, Polyhedron, Solid
from .layouts import KINECT_SIGMA_INVERSE_M, Layout, camera_rotation
from .scene import SyntheticScene, default_camera, observe
from .sensor import SensorOptions
from .sequence import TABLE_HEIGHT_M, table_scene

Array = NDArray[np.float64]

FAMILY = "journey"
RATE_HZ = 30
AWAY_M = np.array([0.0, 0.0, 100.0])
"""Where things are that have been taken away."""
CELL_M = 0.03
"""Side of the cells by which the truth knows a place on a thing again."""


@dataclass(frozen=True)
class JourneyFrame:
    """One frame with what is true of it over time.

    Attributes
    ----------
    scene : SyntheticScene; `scene.pose` is exact
    stamp_ns : int
    surface_tracks, region_tracks : (N + 1,) int32, truth label to the number that it has in every frame
    shift : (S + 1, 3) float64, m, how far each object (`scene.object_labels`) is from where it was at first
    """

    scene: SyntheticScene
    stamp_ns: int
    surface_tracks: NDArray[np.int32]
    region_tracks: NDArray[np.int32]
    shift: Array


def make_journey(
    frames: int,
    seed: int,
    *,
    width: int = 320,
    height: int = 240,
    still: bool = False,
    options: SensorOptions | None = None,
) -> Iterator[JourneyFrame]:
    """Frames of a table with things on it, one at a time.

    The camera goes back and forth along an arc round the table, and in the middle turns away so far that part
    of the table leaves the image. Of the things on the table the first is pushed from a quarter of the time
    to the half, the second is taken away after a third and put back after two thirds.

    Parameters
    ----------
    frames : int
        Their number, at least 1.
    seed : int
        0-99 are meant for tuning, 100 and up for reporting.
    width, height : int, pixels
    still : bool
        Neither the camera nor anything else moves: only the noise differs from frame to frame.
    options : SensorOptions, optional
        By default shaded, with 1 % drop-out and disparity steps of 1/8 px.

    Raises
    ------
    InputError
        Fewer than one frame, or an option out of range.
    """
    if frames < 1:
        raise InputError(f"make_journey: {frames} frames were asked for; at least 1 is needed")
    options = SensorOptions(dropout=0.01, quantization=0.125, shading=True) if options is None else options
    options.check(FAMILY, True)
    return _frames(frames, seed, (height, width), still, options)


def _frames(
    frames: int, seed: int, shape: tuple[int, int], still: bool, options: SensorOptions
) -> Iterator[JourneyFrame]:
    rng = np.random.default_rng([seed, *FAMILY.encode()])
    solids = table_scene(rng)
    path = _Path(rng)
    heading = rng.uniform(0, 2 * np.pi)
    push = rng.uniform(0.05, 0.09) * np.array([np.cos(heading), np.sin(heading), 0.0])
    camera = default_camera(shape[1], shape[0])
    names = {"surface": _Names(), "region": _Names()}
    for shot in range(frames):
        share = 0.0 if still else shot / max(frames - 1, 1)
        shift = _shifts(len(solids), share, push)
        now = [_shifted(solid, by) for solid, by in zip(solids, shift[1:], strict=True)]
        layout = Layout(now, *path(share), KINECT_SIGMA_INVERSE_M)
        scene = observe(layout, camera, shape, options, family=FAMILY, seed=seed, shot=shot)
        cells = _cells(scene, shift)
        yield JourneyFrame(
            scene,
            shot * 1_000_000_000 // RATE_HZ,
            names["surface"].of(scene.surface_labels, cells),
            names["region"].of(scene.labels, cells),
            shift,
        )


class _Path:
    """An arc round the table, there and back, with a look aside in the middle."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.start, self.sweep = rng.uniform(-0.4, 0.1), rng.uniform(0.25, 0.45) * rng.choice([-1.0, 1.0])
        self.radius, self.reach = rng.uniform(0.85, 1.0), rng.uniform(-0.1, 0.1)
        self.height_m, self.rise = TABLE_HEIGHT_M + rng.uniform(0.4, 0.55), rng.uniform(-0.1, 0.15)
        self.aside = rng.uniform(0.3, 0.5) * rng.choice([-1.0, 1.0])

    def __call__(self, share: float) -> tuple[Array, Array]:
        """Rotation and position of the camera after a share of the time."""
        swing = np.sin(np.pi * share)
        angle = self.start + self.sweep * swing
        radius, height = self.radius + self.reach * swing, self.height_m + self.rise * share
        position = np.array([-radius * np.sin(angle), -radius * np.cos(angle), height])
        pitch = np.arctan2(height - (TABLE_HEIGHT_M + 0.05), radius)
        look = 0.5 - 0.5 * np.cos(np.pi * np.clip((0.35 - abs(share - 0.5)) / 0.25, 0.0, 1.0))
        return camera_rotation(angle + self.aside * look, float(pitch), 0.0), position


def _shifts(count: int, share: float, push: Array) -> Array:
    """(count + 1, 3) where each solid is; the first three are table, floor and wall."""
    shift = np.zeros((count + 1, 3))
    if count > 3:
        shift[4] = push * np.clip((share - 0.25) / 0.25, 0.0, 1.0)
    if count > 4 and 1 / 3 <= share < 2 / 3:
        shift[5] = AWAY_M
    return shift


def _shifted(solid: Solid, by: Array) -> Solid:
    """The solid elsewhere."""
    if not by.any():
        return solid
    shape: Any = solid.shape
    if isinstance(shape, Plane):
        return replace(solid, shape=replace(shape, point=shape.point + by))
    moved = replace(shape, center=shape.center + by)
    if isinstance(shape, Polyhedron):
        moved = replace(moved, offsets=shape.offsets + shape.normals @ by)
    return replace(solid, shape=moved)


def _cells(scene: SyntheticScene, shift: Array) -> NDArray[np.int64]:
    """(H, W) one number for each small cell of each thing, the same wherever the thing is."""
    world = scene.clean_points @ scene.pose[:3, :3].T + scene.pose[:3, 3]
    own = np.nan_to_num(world - shift[scene.object_labels])
    key = np.floor(own / CELL_M).astype(np.int64) + 2048
    number = scene.object_labels.astype(np.int64)
    for axis in range(3):
        number = number * 4096 + np.clip(key[..., axis], 0, 4095)
    return number


class _Names:
    """Numbers that last, for connected parts of faces."""

    def __init__(self) -> None:
        self._of: dict[int, int] = {}
        self._next = 1

    def of(self, labels: NDArray[np.int32], cells: NDArray[np.int64]) -> NDArray[np.int32]:
        """(N + 1,) number of each label. The largest claim goes first; who comes late gets a new one."""
        count = int(labels.max())
        places = [np.unique(cells[labels == label]) for label in range(1, count + 1)]
        claims = []
        for label, place in enumerate(places, start=1):
            known = [self._of[c] for c in place.tolist() if c in self._of]
            for name, votes in zip(*np.unique(known, return_counts=True), strict=True) if known else ():
                claims.append((-int(votes), int(name), label))
        names, taken = np.zeros(count + 1, np.int32), set()
        for _, name, label in sorted(claims):
            if not names[label] and name not in taken:
                names[label] = name
                taken.add(name)
        for label in range(1, count + 1):
            if not names[label]:
                names[label] = self._next
                self._next += 1
            for cell in places[label - 1].tolist():
                self._of.setdefault(cell, int(names[label]))
        return names
