"""The world of one result: each question is answered when it is first asked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_core.config import WorldConfig
from rcseg_core.world.classes import classify
from rcseg_core.world.contacts import Links, find_links
from rcseg_core.world.ground import find_ground
from rcseg_core.world.objects import find_objects
from rcseg_core.world.outlines import outline
from rcseg_core.world.scene import Scene
from rcseg_core.world.up import find_floor, floor_up, tilt_between
from rcseg_core.world.values import CATEGORIES, Boundary, Category, Object, Tilt, Up


class Boundaries(Sequence[Boundary]):
    """Boundaries of surfaces, drawn one by one, once for all worlds of a scene."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene

    def __len__(self) -> int:
        return len(self.scene.surfaces)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        surface = self.scene.surfaces[index]
        key = "boundary", surface.label
        if key not in self.scene.known:
            self.scene.known[key] = outline(self.scene, surface)
        return self.scene.known[key]


def links_of(scene: Scene) -> Links:
    """The links of a scene, found once for all of its worlds."""
    if "links" not in scene.known:
        scene.known["links"] = find_links(scene)
    links: Links = scene.known["links"]
    return links


@dataclass(frozen=True)
class World:
    """What a robot takes from one result, seen with one up.

    Attributes
    ----------
    scene : Scene
    told : Up or None, the up that was told from outside
    """

    scene: Scene
    told: Up | None

    @property
    def config(self) -> WorldConfig:
        return self.scene.config

    @cached_property
    def floor(self) -> int:
        """Label of the surface that is the floor itself: the largest low plane that fits; 0 where none
        does."""
        return find_floor(self.scene, self.told)

    @cached_property
    def up(self) -> Up | None:
        """What was told; where nothing was and `world.up_from` is floor, the normal of the floor; else
        None."""
        if self.told is not None or self.config.up_from != "floor" or self.floor == 0:
            return self.told
        return floor_up(self.scene, self.floor)

    @cached_property
    def tilt(self) -> Tilt | None:
        """Of the floor against the up that was told; None without either."""
        if self.told is None or self.floor == 0:
            return None
        return tilt_between(self.told, floor_up(self.scene, self.floor), self.config)

    @cached_property
    def categories(self) -> Sequence[Category]:
        """(M,) the class of each surface; surface s is at s - 1."""
        return classify(self.scene, self.up, self.floor)

    @cached_property
    def class_mask(self) -> NDArray[np.uint8]:
        """(H, W) uint8, index into `CATEGORIES`; 0 unlabelled."""
        codes = np.array([0, *(CATEGORIES.index(c.name) for c in self.categories)], np.uint8)
        return np.take(codes, self.scene.surface_labels)

    @property
    def boundaries(self) -> Sequence[Boundary]:
        """(M,) where each surface ends; surface s is at s - 1. Each is drawn when it is asked for."""
        return Boundaries(self.scene)

    @cached_property
    def ground(self) -> NDArray[np.uint8] | None:
        """(H, W) uint8: 0 no depth, 1 ground, 2 obstacle; None where up is unknown.

        Ground is the floor and what is reached from it over steps of up to `world.step_height` and inclines
        of up to `world.slope_limit`. Whatever has depth and is not ground is an obstacle: without a floor all
        of it.
        """
        return (
            None
            if self.up is None
            else find_ground(self.scene, self.floor, self.categories, links_of(self.scene))
        )

    @cached_property
    def _found(self) -> tuple[NDArray[np.int32], tuple[Object, ...]]:
        return find_objects(self.scene, self.up, self.floor, self.categories, links_of(self.scene))

    @property
    def object_labels(self) -> NDArray[np.int32]:
        """(H, W) int32: 0 none (floor, walls, support), 1..K objects, the largest first."""
        return self._found[0]

    @property
    def objects(self) -> Sequence[Object]:
        """(K,) objects, ``objects[i].label == i + 1``."""
        return self._found[1]
