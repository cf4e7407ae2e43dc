"""Objects: unions of surfaces that belong together, by the evidence along their common borders.

Where two surfaces meet in a convex crease, or continue each other, they are probably faces of one thing;
where they meet in a concave one, one thing stands before or on another. At a step of depth one only hides
the other, which tells hardly anything. Each link of a border gives log-odds from the models of both sides
with their uncertainty; they add up along the border, and surfaces are joined best first while what is
between them is positive, all borders of a union counted together. Floor, walls and large supports take no
part.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from rcseg_core.world.boxes import Borders, box_of, points_of, stands_on
from rcseg_core.world.contacts import Links
from rcseg_core.world.scene import Scene
from rcseg_core.world.shell import find_shell
from rcseg_core.world.values import Category, Object, Up

Array = NDArray[np.float64]

#: Probability of a convex, a flat and a concave border between surfaces of one object, and of two.
SAME, OTHER = np.array([0.70, 0.15, 0.15]), np.array([0.12, 0.13, 0.75])
#: Log-odds of a link at which one surface hides the other.
HIDDEN = -0.85
#: Creases below this angle are flat; least uncertainty of an angle; rad.
FLAT, LEAST_SIGMA = 0.15, 0.10
#: Models that lie farther apart at their border than this share of the depth and so many pixels of slant do
#: not meet there.
APART_SHARE, APART_PX = 0.008, 2.0


def find_objects(
    scene: Scene, up: Up | None, floor: int, categories: Sequence[Category], links: Links
) -> tuple[NDArray[np.int32], tuple[Object, ...]]:
    """Object labels (H, W) int32 and the objects, the largest first."""
    odds = evidence(links, scene)
    shell = find_shell(scene, floor, categories, links, odds)
    groups = join(len(scene.surfaces), shell, links.surfaces, odds)
    sizes = np.bincount(groups, [0, *(s.pixel_count for s in scene.surfaces)])
    order = [g for g in np.argsort(-sizes, kind="stable") if g > 0 and sizes[g] > 0]
    number = np.zeros(len(sizes), np.int32)
    number[order] = np.arange(1, len(order) + 1)
    number = number[groups]
    labels = np.take(number, scene.surface_labels)
    points = points_of(scene, labels, sizes[[0, *order]].astype(np.int64))
    borders, objects = Borders(links, number), []
    for k in range(1, len(order) + 1):
        members = tuple(int(s) for s in np.flatnonzero(number == k))
        box = box_of(scene, members, points[k], up)
        support = stands_on(scene, k, points[k], up, borders)
        objects.append(Object(k, members, int(sizes[order[k - 1]]), box, support))
    return labels, tuple(objects)


def evidence(links: Links, scene: Scene) -> Array:
    """(n,) log-odds of each link that its two surfaces are of one object."""
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = np.sqrt(np.einsum("ni,ni->n", links.edge[:, 0], links.edge[:, 0]))
        meets = links.apart <= APART_SHARE * depth + APART_PX * links.slant
        sigma = np.maximum(_angle_sigma(scene)[links.surfaces].max(axis=1), LEAST_SIGMA)
        convex, concave = ndtr((links.angle - FLAT) / sigma), ndtr((-links.angle - FLAT) / sigma)
        kinds = np.stack([convex, 1.0 - convex - concave, concave], axis=1)
        odds = np.log((kinds @ SAME) / (kinds @ OTHER))
    return np.where(np.isfinite(odds) & meets, np.nan_to_num(odds), HIDDEN)


def _angle_sigma(scene: Scene) -> Array:
    """(M + 1,) about how well the direction of each surface is known, rad."""
    out = np.full(len(scene.surfaces) + 1, LEAST_SIGMA)
    for surface in scene.surfaces:
        plane = scene.planes[surface.label - 1]
        if plane is not None:
            out[surface.label] = np.sqrt(np.trace(plane.covariance_of("total")[:2, :2]))
        else:
            out[surface.label] = 0.15 + 2.0 / np.sqrt(surface.pixel_count)
    return out


def join(count: int, apart: NDArray[np.bool_], pairs: NDArray[np.int64], odds: Array) -> NDArray[np.int64]:
    """(count + 1,) the group of each surface, named by its lowest member; 0 for surfaces that take no part.

    Parameters
    ----------
    apart : (count + 1,) bool, surfaces that take no part
    pairs, odds : (n, 2) and (n,), links and their log-odds

    Greedy additive contraction: the pair of groups with the largest sum is joined, ties by the lower labels,
    until no sum is positive.
    """
    group = np.arange(count + 1)
    group[apart] = 0
    sums: dict[tuple[int, int], float] = {}
    kept = ~apart[pairs].any(axis=1)
    low, high = pairs[kept].min(axis=1), pairs[kept].max(axis=1)
    keys, index = np.unique(low * (count + 1) + high, return_inverse=True)
    for key, total in zip(keys.tolist(), np.bincount(index, odds[kept], len(keys)).tolist(), strict=True):
        sums[key // (count + 1), key % (count + 1)] = total
    while sums:
        (a, b), best = min(sums.items(), key=lambda item: (-item[1], item[0]))
        if best <= 0:
            break
        group[group == b] = a
        moved = {pair: total for pair, total in sums.items() if b in pair}
        for (c, d), total in moved.items():
            del sums[c, d]
            other = c if d == b else d
            if other != a:
                pair = min(a, other), max(a, other)
                sums[pair] = sums.get(pair, 0.0) + total
    return group
