"""Classes of surfaces with probabilities, from geometry and its uncertainty alone.

What a surface is rests on two questions. Which shape: the test of each primitive gives a p, and the shapes
share the probability in the proportion of these, `LEAST_P` for none of them, so that a shape at the limit
of its test is as likely as none. Which way a plane faces: the angle between its normal and up has the
uncertainty of both, and a class gets the probability that the angle lies within its limits.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from rcseg_core.compute.small import square_to
from rcseg_core.shapes.plane_forms import LocalPlane
from rcseg_core.shapes.primitives import LEAST_P
from rcseg_core.world.scene import Scene, Shaped
from rcseg_core.world.up import normal_covariance
from rcseg_core.world.values import Category, Up

Array = NDArray[np.float64]

#: Nodes of Gauss and Hermite over the smaller uncertainty of a direction.
NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(24)
WEIGHTS = WEIGHTS / WEIGHTS.sum()
#: Ways that a plane may face.
WAYS = ("horizontal", "ceiling", "vertical", "inclined")


def classify(scene: Scene, up: Up | None, floor: int) -> Sequence[Category]:
    """The class of each surface; `floor` is the label of the floor itself, 0 without."""
    ground = scene.planes[floor - 1] if floor else None
    faced: list[dict[str, float]] = []
    if up is not None:
        planes = [plane for plane in scene.planes if plane is not None]
        faced = facing_of(planes, up, np.deg2rad(scene.config.horizontal_limit))
    ways = iter(faced)
    return [
        _category(surface, scene, None if plane is None else next(ways, None), ground, surface.label == floor)
        for surface, plane in zip(scene.surfaces, scene.planes, strict=True)
    ]


def _category(
    surface: Shaped, scene: Scene, ways: dict[str, float] | None, ground: LocalPlane | None, is_floor: bool
) -> Category:
    """ways : probabilities of `facing_of`; None of what is no plane, and where up is unknown"""
    shapes = shape_probabilities(surface)
    plane = scene.planes[surface.label - 1]
    found = {name: p for name, p in shapes.items() if name != "plane"}
    flat = shapes.get("plane", 0.0)
    if plane is None:  # a plane that was no better than another shape, or is not known well enough
        found["other"] += flat
    elif ways is None:
        return Category("other", float("nan"), {"other": float("nan")})
    else:
        found |= {name: flat * p for name, p in ways.items()}
        level = 1.0 if is_floor else 0.0
        if ground is not None and not is_floor:
            level = probability_within(plane, ground, scene.config.floor_tolerance)
        found["floor"] = level * found["horizontal"]
        found["horizontal"] *= 1.0 - level
    name = max(found, key=lambda key: found[key])
    return Category(name, found[name], found)


def shape_probabilities(surface: Shaped) -> dict[str, float]:
    """Of plane, sphere, cylinder, as far as they were tried, and other; they sum to 1."""
    tried = [c for c in surface.candidates if np.isfinite(c.p_value)]
    weights: dict[str, float] = {c.kind: float(c.p_value) for c in tried}
    if surface.primitive.kind != "none":
        weights[surface.primitive.kind] = surface.primitive.p_value
    if surface.primitive.kind in (
        "sphere",
        "cylinder",
    ):  # of shapes that pass the test the nearer one was taken
        weights = {k: p if k == surface.primitive.kind else min(p, LEAST_P) for k, p in weights.items()}
    elif surface.primitive.kind == "none":
        weights = {k: min(p, LEAST_P) for k, p in weights.items()}
    weights["other"] = LEAST_P
    total = sum(weights.values())
    return {kind: weight / total for kind, weight in weights.items()}


def facing(plane: LocalPlane, up: Up, limit: float) -> dict[str, float]:
    """Probabilities that a plane is horizontal, a ceiling, vertical or inclined; `limit` in rad."""
    return facing_of([plane], up, limit)[0]


def facing_of(planes: Sequence[LocalPlane], up: Up, limit: float) -> list[dict[str, float]]:
    """`facing` of each of some planes, all at once."""
    if not planes:
        return []
    normals = np.array([plane.normal for plane in planes])
    own = np.array([normal_covariance(plane) for plane in planes])
    both = up.covariance + own
    rising = normals @ up.vector
    level = _within_cone(normals, up.vector, both, limit)
    ceiling = _within_cone(normals, -up.vector, both, limit)
    # beside the upright only the tilt towards or away from up counts
    variance = own @ up.vector @ up.vector + np.einsum("ni,ij,nj->n", normals, up.covariance, normals)
    sigma = np.maximum(np.sqrt(np.maximum(variance, 0.0) / np.maximum(1.0 - rising**2, 1e-9)), 1e-9)
    slant = np.arcsin(np.clip(rising, -1.0, 1.0))
    vertical = ndtr((limit - slant) / sigma) - ndtr((-limit - slant) / sigma)
    rest = np.maximum(1.0 - level - ceiling - vertical, 0.0)
    found = np.stack([level, ceiling, vertical, rest], axis=1)
    found /= found.sum(axis=1, keepdims=True)
    return [dict(zip(WAYS, row, strict=True)) for row in found.tolist()]


def _within_cone(normals: Array, axis: Array, covariances: Array, limit: float) -> Array:
    """(n,) P that normals (n, 3) with errors of two tilts lie within `limit` of an axis, rad."""
    cosine = np.clip(normals @ axis, -1.0, 1.0)
    away = normals - cosine[:, None] * axis
    length = np.sqrt(np.einsum("ni,ni->n", away, away))[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        first = np.where(length > 1e-9, away / length, square_to(axis))
    frames = np.stack([first, np.cross(axis, first)], axis=1)
    variances, axes = np.linalg.eigh(frames @ covariances @ frames.swapaxes(1, 2))
    minor, major = np.sqrt(np.maximum(variances, 1e-18)).T[:, :, None]
    # the offset (angle, 0) along both axes of the error
    along, beside = (np.arccos(cosine)[:, None] * axes[:, 0]).T[:, :, None]
    y = along + minor * NODES
    half = np.sqrt(np.maximum(limit**2 - y**2, 0.0))
    inside = ndtr((half - beside) / major) - ndtr((-half - beside) / major)
    return np.asarray(np.where(np.abs(y) < limit, inside, 0.0) @ WEIGHTS)


def probability_within(plane: LocalPlane, ground: LocalPlane, tolerance_m: float) -> float:
    """P that the middle of a plane lies within a tolerance of the ground's plane."""
    local = ground.pose[:3, :3].T @ (plane.origin - ground.origin)
    lever = np.array([local[1], -local[0], 1.0])  # height at (x, y) by a tilt about x, about y, an offset
    variance = lever @ ground.covariance_of("total") @ lever + plane.covariance_of("total")[2, 2]
    sigma = max(float(np.sqrt(variance)), 1e-9)
    height = float(local[2])
    return float(ndtr((tolerance_m - height) / sigma) - ndtr((-tolerance_m - height) / sigma))
