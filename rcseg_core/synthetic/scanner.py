"""The two scenes of the paper's section 8: a billiard ball of coloured regions and wide colour bands on a
flat board.

Both are seen by a scanner on a regular x, y grid (parallel rays along z), so there is no camera model.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .geometry import UP, Plane, Solid, Sphere, random_rotation
from .paint import Mask, Paint, PaintedRegion, band, disc, distinct_colors

Array = NDArray[np.float64]


def _tilted(rng: np.random.Generator, most: float) -> tuple[Array, Array]:
    """Two axes of a plane that faces the scanner, tilted by up to `most` rad about x and about y."""
    a, b = rng.uniform(-most, most, 2)
    first = np.array([np.cos(a), 0.0, np.sin(a)])
    second = np.array([0.0, np.cos(b), np.sin(b)])
    second -= (second @ first) * first
    return first, second / np.linalg.norm(second)


def _unit(rng: np.random.Generator) -> Array:
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


def _stroke(center: Array, along: Array, half: tuple[float, float]) -> Mask:
    """A bar of a number on the ball: within `half` (radii) of `center`, long side along `along`."""
    across = np.cross(center, along)

    def mask(coords: Array) -> NDArray[np.bool_]:
        near = (np.abs(coords @ along) <= half[0]) & (np.abs(coords @ across) <= half[1])
        return np.asarray(near & (coords @ center > 0))

    return mask


def _number_disc(center: Array, along: Array, strokes: int, white: Array, ink: Array) -> list[PaintedRegion]:
    """A white disc with one to three bars of ink in it."""
    painted = [(disc(center, np.cos(0.36)), white)]
    across = np.cross(center, along)
    for number in range(strokes):
        shifted = center + 0.2 * (number - (strokes - 1) / 2) * across
        bar = _stroke(shifted / np.linalg.norm(shifted), along, (0.19, 0.045))
        painted.append((bar, ink))
    return painted


def _ball_paint(rng: np.random.Generator, to_scanner: Array) -> Paint:
    """A striped ball, a solid one with spots, or a patchwork; each with a number disc towards the scanner,
    more or less."""
    kind = rng.choice(["striped", "spots", "patchwork"])
    colors = distinct_colors(rng, 9)
    regions: list[PaintedRegion] = []
    if kind == "striped":
        width, ring = rng.uniform(0.35, 0.6), rng.uniform(0.08, 0.14)
        regions.append((band(2, -width, width), colors[1]))
        regions.append((band(2, width, width + ring), colors[2]))
        regions += [
            (disc(np.array([0.0, 0.0, s]), np.cos(0.4)), c) for s, c in ((1.0, colors[3]), (-1.0, colors[4]))
        ]
    elif kind == "spots":
        centers: list[Array] = []
        while len(centers) < 6:
            direction = _unit(rng)
            if all(direction @ other < np.cos(0.75) for other in centers):
                centers.append(direction)
        regions += [(disc(c, np.cos(rng.uniform(0.2, 0.36))), colors[1 + i]) for i, c in enumerate(centers)]
    else:
        for i in range(4):
            start = (i - 2) * np.pi / 2
            regions += [
                (_octant(start, upper=True), colors[1 + i]),
                (_octant(start, upper=False), colors[1 + (i + 2) % 4]),
            ]
    towards = to_scanner + rng.uniform(0.0, 1.0) * _unit(rng)
    towards /= np.linalg.norm(towards)
    along = np.cross(towards, _unit(rng))
    along /= np.linalg.norm(along)
    regions += _number_disc(towards, along, int(rng.integers(1, 4)), colors[7], colors[8])
    return Paint(colors[0], tuple(regions))


def _octant(start: float, *, upper: bool) -> Mask:
    """An eighth of the ball: a quarter turn from the longitude `start`, above or below the equator."""

    def mask(coords: Array) -> NDArray[np.bool_]:
        angle = np.arctan2(coords[:, 1], coords[:, 0])
        return np.asarray((angle >= start) & (angle < start + np.pi / 2) & ((coords[:, 2] >= 0) == upper))

    return mask


def billiard(rng: np.random.Generator) -> tuple[list[Solid], float, float]:
    """The billiard ball, alone or on a plate. Returns solids, height of the image (m) and sigma of range
    (m)."""
    radius = rng.uniform(0.024, 0.031)
    height_m = 2 * radius / rng.uniform(0.72, 0.9)
    slack = height_m / 2 - radius
    center = np.array([*rng.uniform(-slack, slack, 2), rng.uniform(0.25, 0.4)])
    rotation = random_rotation(rng)
    solids = [Solid(Sphere(center, radius, rotation), (_ball_paint(rng, -rotation[:, 2]),), "ball")]
    if rng.random() < 0.5:
        first, second = _tilted(rng, 0.12)
        base = distinct_colors(rng, 2)
        line = rng.uniform(-0.5, 0.5) * height_m
        halves: tuple[PaintedRegion, ...] = (
            ((lambda coords: coords[:, 0] > line, base[1]),) if rng.random() < 0.5 else ()
        )
        plate = Plane(center + 1.15 * radius * UP, first, second)
        solids.append(Solid(plate, (Paint(base[0], halves),), "plate"))
    return solids, height_m, rng.uniform(1.2e-4, 2.5e-4)


def _wavy(rng: np.random.Generator, level: float, size: float) -> Callable[[Array], Array]:
    """A brush's edge: `level` plus two slow waves along the stroke; metres."""
    waves = [
        (rng.uniform(0.002, 0.008) * size, rng.uniform(2, 9) / size, rng.uniform(0, 6.3)) for _ in range(2)
    ]

    def edge(s: Array) -> Array:
        return np.asarray(level + np.sum([a * np.sin(k * s + phase) for a, k, phase in waves], axis=0))

    return edge


def _stripe(axis: int, low: Callable[[Array], Array], high: Callable[[Array], Array]) -> Mask:
    other = 1 - axis
    return lambda c: np.asarray((c[:, axis] >= low(c[:, other])) & (c[:, axis] < high(c[:, other])))


def painting(rng: np.random.Generator) -> tuple[list[Solid], float, float]:
    """Wide colour bands on a flat board, some crossed by another. Returns as `billiard`."""
    height_m = rng.uniform(0.2, 0.4)
    whole = rng.random() < 0.5
    half = (
        (0.8 * height_m, 0.6 * height_m)
        if whole
        else tuple(height_m * rng.uniform([0.5, 0.38], [0.62, 0.47]))
    )
    count, crossing = int(rng.integers(4, 8)), int(rng.integers(0, 2))
    colors = distinct_colors(rng, count + crossing + 1)
    # The outer bands run off the board, or leave a margin of it that is as wide as a brush would.
    margin = rng.uniform(0.04, 0.08) * height_m if rng.random() < 0.5 else -0.03 * height_m
    reach = min(half[1], 0.5 * height_m) - margin
    levels = np.linspace(-reach, reach, count + 1)
    levels[1:-1] += rng.uniform(-0.2, 0.2, count - 1) * (levels[1] - levels[0])
    edges = [_wavy(rng, level, height_m) for level in levels]
    regions: list[PaintedRegion] = []
    for i in range(count):
        # Neighbours share their edge, as wet bands do, or leave a strip of bare board between them.
        gap = (levels[i + 1] - levels[i]) * rng.uniform(0.15, 0.3)
        end = _wavy(rng, levels[i + 1] - gap, height_m) if rng.random() < 0.3 else edges[i + 1]
        regions.append((_stripe(1, edges[i], end), colors[1 + i]))
    for i in range(crossing):
        at, wide = rng.uniform(-0.4, 0.4) * height_m, rng.uniform(0.05, 0.1) * height_m
        regions.append(
            (_stripe(0, _wavy(rng, at - wide, height_m), _wavy(rng, at + wide, height_m)), colors[-1 - i])
        )
    slope, phase = rng.uniform(-4, 4, (2, 3)) / height_m, rng.uniform(0, 6.3, 3)
    variation = rng.uniform(1.0, 4.0, 3)
    paint = Paint(colors[0], tuple(regions), lambda c: variation * np.sin(c[:, :2] @ slope + phase))
    first, second = _tilted(rng, 0.3)
    board = Plane(np.array([0.0, 0.0, rng.uniform(0.5, 0.8)]), first, second, None if whole else half)
    return [Solid(board, (paint,), "board")], height_m, rng.uniform(2e-4, 4e-4)
