"""The shell of a scene: floor, walls, ceiling and large supports, which are told from the objects in it.

Behind the shell nothing is seen: a large plane with nothing on its far side is a wall, a floor, or the
table that fills the image. A large horizontal plane is a support, whatever lies below.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rcseg_core.world.contacts import Links
from rcseg_core.world.scene import Scene
from rcseg_core.world.up import share_below, visible_area
from rcseg_core.world.values import Category

#: Share of the points that may lie behind the shell.
LEAST_BEHIND = 0.02
#: Planes that touch the rim of the image along this share of its length, or are as large as a support, may be
#: shell: faces of objects end within the image.
RIM_SHARE = 0.04
FACING_UP = ("floor", "horizontal")


def find_shell(
    scene: Scene, floor: int, categories: Sequence[Category], links: Links, odds: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """(M + 1,) bool: surfaces that are no part of an object; index 0 (unlabelled) is one of them.

    odds : (n,) log-odds of the links; what lies flat on the floor is parted from it by them
    """
    shell = np.zeros(len(scene.surfaces) + 1, np.bool_)
    shell[0] = True
    rim = _on_rim(scene)
    for surface, plane, category in zip(scene.surfaces, scene.planes, categories, strict=True):
        s = surface.label
        if plane is None:
            continue
        area = visible_area(plane, surface.pixel_count, scene)
        large = area >= scene.config.support_area
        if s == floor or category.name == "floor":
            beside = ((links.surfaces == (s, floor)) | (links.surfaces == (floor, s))).all(axis=1)
            shell[s] = odds[beside].sum() >= 0
        elif large and (category.name in FACING_UP or area >= 4.0 * scene.config.support_area):
            shell[s] = True
        elif large or rim[s] >= RIM_SHARE:
            shell[s] = share_below(plane, scene) <= LEAST_BEHIND
    return shell


def _on_rim(scene: Scene) -> NDArray[np.float64]:
    """(M + 1,) share of the image's rim that each surface holds."""
    labels = scene.surface_labels
    rim = np.concatenate([labels[0], labels[-1], labels[1:-1, 0], labels[1:-1, -1]])
    return np.bincount(rim, minlength=len(scene.surfaces) + 1) / len(rim)
