"""Up: told from outside, or the normal of the floor that is seen; and how far the two are apart."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_core.config import WorldConfig
from rcseg_core.errors import InputError
from rcseg_core.shapes.plane_forms import LocalPlane
from rcseg_core.world.scene import Scene
from rcseg_core.world.values import Tilt, Up

Array = NDArray[np.float64]

#: Without an up the floor's normal is looked for round the image's own: no robot looks with its head down.
IMAGE_UP = np.array([0.0, -1.0, 0.0])
MOST_TILTED = np.deg2rad(70.0)
#: A told up may be wrong by this much and the floor is still found, to name the fault.
MOST_WRONG = np.deg2rad(20.0)
#: Share of the points that may lie below the floor: reflections, outliers, a step down.
LEAST_BELOW = 0.05
#: A floor holds at least this share of the measured pixels.
LEAST_SHARE = 0.01
#: Points count as below where they are by this much more than the floor's tolerance, as a share of depth.
BELOW_SHARE = 0.03


def told_up(up: object, covariance: object, source: str, config: WorldConfig) -> Up | None:
    """The up that is told for a frame, else that of the configuration; None where neither knows.

    Raises
    ------
    InputError
        Unless up is three finite numbers with a length, and the covariance None or (3, 3).
    """
    if up is None:
        if covariance is not None:
            raise InputError("up_covariance: given without an up that it belongs to")
        if config.up_from != "parameter":
            return None
        up, source = (config.up_x, config.up_y, config.up_z), "parameter"
    vector = _numbers(up, (3,), "up: expected 3 finite numbers in the sensor's frame")
    largest = float(np.abs(vector).max())
    if not largest > 0:
        raise InputError("up: is (0, 0, 0), which points nowhere")
    vector = vector / largest  # whose squares neither overflow nor vanish
    vector = vector / np.linalg.norm(vector)
    across = np.eye(3) - np.outer(vector, vector)
    if covariance is None:
        return Up(vector, config.up_sigma**2 * across, source)
    table = _numbers(covariance, (3, 3), "up_covariance: expected (3, 3) finite numbers, rad^2")
    return Up(vector, across @ table @ across, source)


def _numbers(value: Any, shape: tuple[int, ...], wanted: str) -> Array:
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{wanted}, got {value!r}") from None
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(f"{wanted}, got {value!r}")
    return array


def find_floor(scene: Scene, told: Up | None) -> int:
    """Label of the largest low plane; 0 where none fits.

    It faces up (within `MOST_WRONG` of what was told, else within `MOST_TILTED` of the image's up), and
    nearly nothing lies below it.
    """
    up, most = (IMAGE_UP, MOST_TILTED) if told is None else (told.vector, MOST_WRONG)
    least_px = LEAST_SHARE * float(np.count_nonzero(scene.measured))
    best, area = 0, 0.0
    for surface, plane in zip(scene.surfaces, scene.planes, strict=True):
        if plane is None or surface.pixel_count < least_px or plane.normal @ up < np.cos(most):
            continue
        size = visible_area(plane, surface.pixel_count, scene)
        if size > area and share_below(plane, scene) <= LEAST_BELOW:
            best, area = surface.label, size
    return best


def visible_area(plane: LocalPlane, pixel_count: int, scene: Scene) -> float:
    """About how large the visible part of a plane is, m^2 (of grids without a camera: pixels)."""
    if scene.camera is None:
        return float(pixel_count)
    depth, distance = float(plane.origin[2]), float(np.linalg.norm(plane.origin))
    cosine = max(abs(plane.distance) / distance, 0.05)
    return pixel_count * depth**2 / (scene.camera.fx * scene.camera.fy) * (depth / distance) / cosine


def share_below(plane: LocalPlane, scene: Scene) -> float:
    """Share of the measured points that lie on the far side of a plane by more than errors explain."""
    points, away = scene.sample
    if not len(points):
        return 0.0
    behind = plane.distance - points @ plane.normal
    return float(np.mean(behind > scene.config.floor_tolerance + BELOW_SHARE * away))


def floor_up(scene: Scene, floor: int) -> Up:
    """The normal of a floor as up, with its covariance."""
    plane = scene.planes[floor - 1]
    assert plane is not None
    return Up(plane.normal, normal_covariance(plane), "floor")


def normal_covariance(plane: LocalPlane) -> Array:
    """(3, 3) of the components of a plane's normal, rad^2, random and systematic part together."""
    turns = np.stack([-plane.pose[:3, 1], plane.pose[:3, 0]], axis=1)
    return np.asarray(turns @ plane.covariance_of("total")[:2, :2] @ turns.T)


def tilt_between(told: Up, seen: Up, config: WorldConfig) -> Tilt:
    """The angle between what was told and the floor, with its deviation."""
    angle = float(np.arctan2(np.linalg.norm(np.cross(told.vector, seen.vector)), told.vector @ seen.vector))
    both = told.covariance + seen.covariance
    away = seen.vector - (seen.vector @ told.vector) * told.vector
    length = float(np.linalg.norm(away))
    # where they agree no direction is special: the mean of both tilts
    variance = float(away @ both @ away) / length**2 if length > 1e-9 else 0.5 * float(np.trace(both))
    deviation = float(np.sqrt(max(variance, 0.0)))
    expected = angle <= max(np.deg2rad(config.tilt_limit), 3.0 * deviation)
    return Tilt(angle, deviation, bool(expected))
