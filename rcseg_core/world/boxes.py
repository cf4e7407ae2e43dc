"""Boxes round objects, and what objects stand on."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.compute.small import cross, quantile, square_to
from rcseg_core.shapes.cell_sums import UNUSABLE
from rcseg_core.signal.signals import INVALID
from rcseg_core.world.contacts import Links
from rcseg_core.world.scene import Scene
from rcseg_core.world.values import Box3d, Up

Array = NDArray[np.float64]

#: Models no farther apart than this share of the distance meet.
MEETS = 0.03
#: Cosine between up and the normal of what carries things; least height of a foot that hangs in the air, m.
FACES_UP, MOST_GAP = 0.8, 0.25
#: Share of the points that do not count at either end of a box: stray pixels at the rim.
OUTSIDE = 0.005
#: Points of an object that tell its box are thinned out to about so many.
ENOUGH = 1500


@bare
def _gather(flags, objects, sound, steps, seen, wait, first, rows, cols):  # type: ignore[no-untyped-def]
    """Every steps[k]-th measured pixel of object k into rows and cols, from first[k] on; seen (K + 1,) counts
    them, wait (K + 1,) those until the next that is taken."""
    height, width = objects.shape
    for row in range(height):
        end = 0
        while end < width:
            start, k = end, objects[row, end]
            while end < width and objects[row, end] == k:
                end += 1
            if k <= 0:
                continue
            left_out = UNUSABLE if sound[k] else INVALID
            step, waiting, at = steps[k], wait[k], first[k] + seen[k]
            for col in range(start, end):
                if flags[row, col] & left_out:
                    continue
                if waiting == 0:
                    waiting = step
                    rows[at] = row
                    cols[at] = col
                    at += 1
                waiting -= 1
            wait[k], seen[k] = waiting, at - first[k]


@bare
def _find_sound(flags, objects, sound):  # type: ignore[no-untyped-def]
    """sound (K + 1,): whether an object has a pixel that is no outlier."""
    for row in range(objects.shape[0]):
        for col in range(objects.shape[1]):
            k = objects[row, col]
            if k > 0 and not sound[k]:
                sound[k] = flags[row, col] & UNUSABLE == 0


def points_of(scene: Scene, objects: NDArray[np.int32], sizes: NDArray[np.int64]) -> list[Array]:
    """Measured points (n, 3) of objects 0..K, thinned out to some `ENOUGH`; none of 0.

    Pixels in mid-air, which would widen a box, are left out where an object has others.

    sizes : (K + 1,) pixels of each
    """
    flags, count = scene.signals.flags, len(sizes)
    sound = np.zeros(count, np.bool_)
    _find_sound(flags, objects, sound)
    steps = np.maximum(sizes // ENOUGH, 1)
    room = sizes // steps + 1
    room[0] = 0
    first = np.concatenate([[0], np.cumsum(room)])
    taken, wait = np.zeros(count, np.int64), np.zeros(count, np.int64)
    rows, cols = np.zeros(first[-1], np.int64), np.zeros(first[-1], np.int64)
    _gather(flags, objects, sound, steps, taken, wait, first, rows, cols)
    points = scene.points_at(rows, cols).astype(np.float64)
    within = np.isfinite(points[:, 2])  # beside a depth of micrometres one of metres is no number
    slices = [slice(start, start + n) for start, n in zip(first, taken, strict=False)]
    found = [points[each][within[each]] for each in slices]
    return [each if len(each) else np.zeros((1, 3)) for each in found]


def box_of(scene: Scene, members: Sequence[int], points: Array, up: Up | None) -> Box3d:
    """The box round points (n, 3) of some surfaces: upright where up is known, else along their largest
    plane."""
    axis = _axis(scene, members, up)
    first = square_to(axis)
    frame = np.stack([first, cross(axis, first), axis])
    local = points @ frame.T
    along = np.ascontiguousarray(local.T)
    low, high = _bounds(along)
    inside = ((along >= low[:, None]) & (along <= high[:, None])).all(axis=0)
    if np.count_nonzero(inside) >= 3:
        flat = np.stack([along[0, inside], along[1, inside]], axis=1).astype(np.float32)
        angle = np.deg2rad(cv2.minAreaRect(flat)[2])
        turn = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        frame = turn @ frame
        low, high = _bounds(np.ascontiguousarray((local @ turn.T).T))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = frame.T, frame.T @ (0.5 * (low + high))
    return Box3d(pose, high - low)


def _bounds(along: Array) -> tuple[Array, Array]:
    """(3,) each: between these all coordinates (3, n) lie but a share of `OUTSIDE` at either end."""
    count = along.shape[1]
    low = int(OUTSIDE * count)
    high = count - 1 - low
    ordered = np.partition(along, (low, high))
    return ordered[:, low], ordered[:, high]


def _axis(scene: Scene, members: Sequence[int], up: Up | None) -> Array:
    if up is not None:
        return up.vector
    flat = [s for s in members if scene.planes[s - 1] is not None]
    if flat:
        plane = scene.planes[max(flat, key=lambda s: scene.surfaces[s - 1].pixel_count) - 1]
        assert plane is not None
        return plane.normal
    return np.array([0.0, -1.0, 0.0])


class Borders:
    """Links by the objects on either side of them.

    Parameters
    ----------
    objects : (M + 1,) the object of each surface
    """

    def __init__(self, links: Links, objects: NDArray[np.int32]) -> None:
        self._surfaces, self._objects = links.surfaces, objects[links.surfaces]
        away = np.sqrt(np.einsum("nsi,nsi->ns", links.edge, links.edge))
        self._meets = links.apart[:, None] <= MEETS * away

    def of(self, label: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Surfaces of others that border on an object, ascending, and the links at which each of them meets
        it."""
        sides = self._objects == label
        at = np.flatnonzero(sides[:, 0] != sides[:, 1])
        own = sides[at, 1].astype(int)
        other = self._surfaces[at, 1 - own]
        count = np.bincount(other)
        meeting = np.bincount(other[self._meets[at, own]], minlength=len(count))
        found = np.flatnonzero(count)
        return found, meeting[found]


def stands_on(scene: Scene, label: int, points: Array, up: Up | None, borders: Borders) -> int:
    """Label of the surface below an object; 0 where up is unknown or none is seen.

    Of the surfaces of others that face up, border on it and lie below its middle: the one that it meets along
    the longest border; where it hides its own foot, as balls do, the one nearest below.
    """
    if up is None:
        return 0
    middle, below = points.mean(axis=0), []
    foot = middle + quantile((points - middle) @ up.vector, 0.02) * up.vector
    for s, meeting in zip(*(column.tolist() for column in borders.of(label)), strict=True):
        plane = scene.planes[s - 1]
        if plane is None or plane.normal @ up.vector < FACES_UP:
            continue
        height = (middle @ plane.normal - plane.distance, foot @ plane.normal - plane.distance)
        if height[0] > 0.0 and height[1] < height[0]:
            below.append((-meeting, height[1], s))
    if not below:
        return 0
    meeting, gap, best = min(below)
    return best if meeting < 0 or gap < MOST_GAP else 0
