"""Ground and obstacles: where a robot may drive or put a foot, and what it must not touch.

Surfaces are nodes. From the floor the ground grows over borders at which two walkable surfaces differ in
height by no more than a step; a surface that is not walkable but nowhere rises above a step (the riser of a
low step, a cable) is passed and belongs to the ground as well. Heights are taken from the floor's own
plane, which is seen, rather than along an up that may be told wrong.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.compute.small import quantile
from rcseg_core.shapes.plane_forms import LocalPlane
from rcseg_core.world.contacts import Links
from rcseg_core.world.scene import Scene
from rcseg_core.world.values import GROUND, NO_DEPTH, OBSTACLE, Category

Array = NDArray[np.float64]

#: Links that must be low for a border to be taken, as a number and as a share of the border.
LEAST_LINKS, LEAST_LOW = 4, 0.3
#: Two surfaces touch where their models are no farther apart than this, beside the step itself, m.
REACH_M = 0.1
#: Quantile of the ground's height along a border that what is passed must stay low against.
LOWEST = 0.1
#: Share of the pixels of a surface that may stand out higher: noise, pixels of what is behind.
LEAST_HIGH = 0.05
#: Pixels of the box of a surface that tell whether it is low.
ENOUGH = 10_000


def find_ground(scene: Scene, floor: int, categories: Sequence[Category], links: Links) -> NDArray[np.uint8]:
    """(H, W) uint8, see `World.ground`; `floor` is the label of the floor itself, 0 where there is none."""
    plane = scene.planes[floor - 1] if floor else None
    if plane is None:
        return np.where(scene.measured, OBSTACLE, NO_DEPTH).astype(np.uint8)
    step, own = scene.config.step_height, scene.surface_labels
    parts = [s for s, c in enumerate(categories, start=1) if c.name == "floor" and s != floor]
    table = _references(scene, [floor, *parts], plane, links)
    out = np.empty(own.shape, np.uint8)
    _classes(scene.points, scene.measured, own, table, np.float32(step), out)
    return out


@bare
def _classes(points, measured, surfaces, table, step, out):  # type: ignore[no-untyped-def]
    """Ground is what lies within a step of the reference plane (nx, ny, nz, d) of its surface: table
    (M + 1, 4). What stands out by more is none, whatever its label."""
    for row in range(surfaces.shape[0]):
        for col in range(surfaces.shape[1]):
            if not measured[row, col]:
                out[row, col] = NO_DEPTH
                continue
            s = surfaces[row, col]
            height = np.float32(
                points[row, col, 0] * table[s, 0]
                + points[row, col, 1] * table[s, 1]
                + points[row, col, 2] * table[s, 2]
                - table[s, 3]
            )
            out[row, col] = GROUND if abs(height) <= step else OBSTACLE


def _references(scene: Scene, floors: list[int], plane: LocalPlane, links: Links) -> Array:
    """(M + 1, 4) the plane that the ground is at each surface; NaN for surfaces that are none of it.

    That of a walkable surface is its own; what is passed because it is low, and what has no surface, is held
    against the floor's plane at the height of the ground beside it.
    """
    table = np.full((len(scene.surfaces) + 1, 4), np.nan)
    table[0] = np.append(plane.normal, plane.distance)
    walkable = _walkable(scene, plane)
    between = _Borders(links, plane)
    step = scene.config.step_height
    for s in floors:  # wherever it is seen: things part a floor in the image
        own = scene.planes[s - 1]
        assert own is not None
        table[s] = np.append(own.normal, own.distance)
    waiting, high = list(floors), set()
    for s in waiting:  # grows while it is walked
        for t, here, there, apart in between.of(s):
            if np.isfinite(table[t, 3]) or t in high:
                continue
            level = here if walkable[s] else np.full(len(here), table[s, 3] - plane.distance)
            if walkable[t]:
                low = (np.abs(there - level) <= step) & (apart <= REACH_M + step)
                if np.count_nonzero(low) < max(LEAST_LINKS, LEAST_LOW * len(low)):
                    continue
                own = scene.planes[t - 1]
                assert own is not None
                table[t] = np.append(own.normal, own.distance)
            else:
                ground = quantile(level, LOWEST)  # beside a ramp its side is low at one end only
                if not _is_low(scene, t, plane, ground):
                    high.add(t)  # seen from the floor first: that it is low beside a ramp does not matter
                    continue
                table[t] = np.append(plane.normal, plane.distance + ground)
            waiting.append(t)
    return table


def _walkable(scene: Scene, plane: LocalPlane) -> NDArray[np.bool_]:
    """(M + 1,) planes that are tilted against the floor by no more than the limit."""
    least = np.cos(np.deg2rad(scene.config.slope_limit))
    tilts = [False, *(p is not None and bool(p.normal @ plane.normal >= least) for p in scene.planes)]
    return np.array(tilts)


def _is_low(scene: Scene, label: int, plane: LocalPlane, ground: float) -> bool:
    """Whether nearly all of a surface lies within a step of the ground beside it."""
    row_0, col_0, row_1, col_1 = scene.surfaces[label - 1].box
    stride = 1 + int(np.sqrt((row_1 - row_0 + 1) * (col_1 - col_0 + 1) / ENOUGH))
    window = slice(row_0, row_1 + 1, stride), slice(col_0, col_1 + 1, stride)
    seen, high = _count_high(
        scene.points[window], scene.surface_labels[window], label, plane.normal, plane.distance + ground,
        scene.config.step_height,
    )  # fmt: skip
    return bool(seen > 0 and high <= LEAST_HIGH * seen)


@bare
def _count_high(points, surfaces, label, normal, level, step):  # type: ignore[no-untyped-def]
    """Measured points of a surface, and those of them that are farther than a step from a level of a
    plane."""
    seen = high = 0
    for row in range(surfaces.shape[0]):
        for col in range(surfaces.shape[1]):
            if surfaces[row, col] != label or np.isnan(points[row, col, 2]):
                continue
            height = (
                points[row, col, 0] * normal[0]
                + points[row, col, 1] * normal[1]
                + points[row, col, 2] * normal[2]
            )
            seen += 1
            high += abs(height - level) > step
    return seen, high


class _Borders:
    """The links of a frame by surface, with heights above a plane."""

    def __init__(self, links: Links, plane: LocalPlane) -> None:
        height = links.edge @ plane.normal - plane.distance
        apart = links.apart
        # each link is seen from both of its sides
        near = np.concatenate([links.surfaces, links.surfaces[:, ::-1]])
        both = np.concatenate([height, height[:, ::-1]])
        kept = np.flatnonzero(np.isfinite(both[:, 0] + both[:, 1]))
        key = near[kept, 0] * (int(near.max(initial=0)) + 1) + near[kept, 1]
        order = kept[np.argsort(key, kind="stable")]
        self.near, self.height, self.apart = near[order], both[order], np.tile(apart, 2)[order]

    def of(self, surface: int) -> Iterator[tuple[int, Array, Array, Array]]:
        """Each surface that borders on one, the heights on this side and on that, and how far these are
        apart."""
        first, last = np.searchsorted(self.near[:, 0], [surface, surface + 1])
        others, starts = np.unique(self.near[first:last, 1], return_index=True)
        bounds = [*(first + starts), last]
        for other, a, b in zip(others, bounds[:-1], bounds[1:], strict=True):
            yield int(other), self.height[a:b, 0], self.height[a:b, 1], self.apart[a:b]
