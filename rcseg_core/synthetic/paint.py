"""What is painted on a surface: a base colour, regions of other colours, slow variation, printed texture.

Regions are albedo, part of the truth (surface x albedo). Variation and texture are not: they are what a
real board or a printed box does to a segmentation that believes in one colour a region.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rcseg_core.errors import InputError

Array = NDArray[np.float64]
Mask = Callable[[Array], NDArray[np.bool_]]

PaintedRegion = tuple[Mask, Array]
"""Where on the face, and in which colour."""
LEAST_DIFFERENCE = 45.0
"""Least distance, in the largest channel and in 0-255 levels, of two colours that are told apart by colour
alone."""


@dataclass(frozen=True)
class Paint:
    """Colours of one face: `base` and painted regions, the later over the earlier; all in 0-255 levels."""

    base: Array
    regions: tuple[PaintedRegion, ...] = ()
    variation: Callable[[Array], Array] | None = None
    texture: Callable[[Array], Array] | None = None

    def index(self, coords: Array) -> NDArray[np.int32]:
        """Number of the paint at face coordinates (N, 2 or 3): (N,) int32, 0 the base, i + 1 the i-th
        region."""
        index = np.zeros(len(coords), np.int32)
        for number, (mask, _) in enumerate(self.regions, start=1):
            index[mask(coords)] = number
        return index

    def color(self, coords: Array, index: NDArray[np.int32]) -> Array:
        """Colour before light and noise: (N, 3) float64 levels."""
        color = np.stack([self.base, *(c for _, c in self.regions)])[index]
        if self.variation is not None:
            color = color + self.variation(coords)
        if self.texture is not None:
            color = color * self.texture(coords)[:, None]
        return np.asarray(color)

    def textured(self, texture: Callable[[Array], Array]) -> Paint:
        return replace(self, texture=texture)


def distinct_colors(
    rng: np.random.Generator,
    count: int,
    *,
    avoid: Array | None = None,
    low: float = 40.0,
    high: float = 230.0,
) -> Array:
    """Random colours (count, 3), each at least LEAST_DIFFERENCE levels (largest channel) from the others
    and `avoid`.

    Raises
    ------
    InputError
        When so many distinct colours do not fit.
    """
    found = np.empty((0, 3)) if avoid is None else np.atleast_2d(avoid)
    given = len(found)
    for _ in range(5000):
        if len(found) == given + count:
            return found[given:]
        color = rng.uniform(low, high, 3)
        if (np.abs(found - color).max(axis=1) >= LEAST_DIFFERENCE).all():
            found = np.vstack([found, color])
    raise InputError(
        f"distinct_colors: {count} colours {LEAST_DIFFERENCE:g} levels apart do not fit; ask for fewer"
    )


def rectangle(center: tuple[float, float], half: tuple[float, float], angle: float = 0.0) -> Mask:
    """Points of the face within a turned rectangle; metres."""
    along = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-np.sin(angle), np.cos(angle)])
    middle = np.asarray(center)

    def mask(coords: Array) -> NDArray[np.bool_]:
        local = coords[:, :2] - middle
        return np.asarray((np.abs(local @ along) <= half[0]) & (np.abs(local @ across) <= half[1]))

    return mask


def ellipse(center: tuple[float, float], half: tuple[float, float]) -> Mask:
    """Points of the face within an ellipse with axes along the face's; metres."""
    middle, axes = np.asarray(center), np.asarray(half)

    def mask(coords: Array) -> NDArray[np.bool_]:
        return np.asarray(np.sum(((coords[:, :2] - middle) / axes) ** 2, axis=1) <= 1)

    return mask


def band(axis: int, low: float, high: float) -> Mask:
    """Points whose face coordinate `axis` lies within [low, high): a stripe round a cylinder or a ball."""
    return lambda coords: (coords[:, axis] >= low) & (coords[:, axis] < high)


def disc(direction: Array, cos_angle: float) -> Mask:
    """On a ball: the cap round the unit vector `direction`, out to the angle whose cosine is given."""
    return lambda coords: np.asarray(coords @ direction >= cos_angle)


def random_texture(rng: np.random.Generator, scale_m: float) -> Callable[[Array], Array]:
    """A printed pattern as a factor on the albedo, 0.45-1: stripes, checks or text-like blocks of about
    `scale_m`."""
    kind = rng.choice(["stripes", "checks", "blocks"])
    angle, dark = rng.uniform(0, np.pi), rng.uniform(0.45, 0.75)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    scale = np.array([scale_m * rng.uniform(0.6, 1.4), scale_m * rng.uniform(0.3, 1.0)])
    table = rng.random((64, 64)) < 0.45

    def texture(coords: Array) -> Array:
        cell = np.floor((coords[:, :2] @ turn.T) / scale).astype(np.int64)
        if kind == "stripes":
            printed = cell[:, 1] % 2 == 0
        elif kind == "checks":
            printed = (cell[:, 0] + cell[:, 1]) % 2 == 0
        else:
            printed = (cell[:, 1] % 2 == 0) & table[cell[:, 0] % 64, cell[:, 1] % 64]
        return np.where(printed, dark, 1.0)

    return texture
