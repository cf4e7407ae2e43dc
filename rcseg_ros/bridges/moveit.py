"""moveit_msgs: floor, tables and shelves as CollisionObject, thin prisms that a planner keeps clear of.

A surface that was added is removed when it has not been seen for a time: `CollisionScene` remembers what was
added. Ids are those of tracks where there are any; else a surface keeps the id of the one of before whose
middle is nearest, if it is near.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rcseg_core.world import World
from rcseg_ros.bridges.shape import prism_message
from rcseg_ros.results.outputs import Make
from rcseg_ros.results.world import pose_message

ADD, REMOVE = 0, 1  # constants of moveit_msgs/CollisionObject
HORIZONTAL = ("floor", "horizontal")


@dataclass(frozen=True)
class Slab:
    """A horizontal surface that is, or was, in the planning scene."""

    name: str
    seen_ns: int
    pose: Any
    area: float


class CollisionScene:
    """The horizontal surfaces that were added to a planning scene.

    Parameters
    ----------
    thickness_m : of the prisms, downwards from the surface
    gone_after_s : a surface that is not seen for so long is removed
    same_within_m : a surface whose middle comes no nearer than that to one of before is another one
    prefix : of the ids
    """

    def __init__(
        self,
        thickness_m: float = 0.01,
        gone_after_s: float = 2.0,
        same_within_m: float = 0.1,
        prefix: str = "rcseg_",
    ) -> None:
        self._thickness_m = thickness_m
        self._gone_after_ns = round(gone_after_s * 1e9)
        self._same_within_m = same_within_m
        self._prefix = prefix
        self._slabs: dict[str, Slab] = {}
        self._count = 0

    def update(
        self,
        surfaces: Sequence[Any],
        world: World,
        stamp_ns: int,
        header: Any,
        make: Make,
        ids: Sequence[int] | None = None,
    ) -> list[Any]:
        """Messages of a frame: ADD of every horizontal surface that is seen, REMOVE of those that are gone.

        Parameters
        ----------
        ids : of the surfaces by label, such as those of tracks; a surface without one, 0, is not told of
        """
        if any(slab.seen_ns > stamp_ns for slab in self._slabs.values()):
            self._slabs = {
                n: Slab(n, stamp_ns, s.pose, s.area) for n, s in self._slabs.items()
            }  # time went back
        messages, taken = [], set()
        for surface in surfaces:
            polygons = world.boundaries[surface.label - 1].polygons
            if (
                surface.plane is None
                or world.categories[surface.label - 1].name not in HORIZONTAL
                or not polygons
            ):
                continue
            if ids is not None and not ids[surface.label]:
                continue
            pose, area = surface.plane.pose, sum(p.area for p in polygons)
            name = f"{self._prefix}{ids[surface.label]}" if ids is not None else self._name_of(pose, taken)
            taken.add(name)
            self._slabs[name] = Slab(name, stamp_ns, pose, area)
            meshes = [prism_message(polygon, self._thickness_m, make) for polygon in polygons]
            messages.append(collision_object(name, ADD, pose, meshes, header, make))
        messages += [
            collision_object(name, REMOVE, np.eye(4), [], header, make) for name in self._gone(stamp_ns)
        ]
        return messages

    def _name_of(self, pose: Any, taken: set[str]) -> str:
        """The name of the slab of before whose plane and middle are nearest, or a new one."""

        def apart(slab: Slab) -> float:
            off = slab.pose[:3, 3] - pose[:3, 3]
            return float(np.linalg.norm(off))

        near = [slab for slab in self._slabs.values() if slab.name not in taken]
        best = min(near, key=apart, default=None)
        if best is not None and apart(best) <= self._same_within_m:
            return best.name
        self._count += 1
        return f"{self._prefix}{self._count}"

    def _gone(self, stamp_ns: int) -> Iterator[str]:
        for name, slab in list(self._slabs.items()):
            if stamp_ns - slab.seen_ns > self._gone_after_ns:
                del self._slabs[name]
                yield name


def collision_object(name: str, operation: int, pose: Any, meshes: list[Any], header: Any, make: Make) -> Any:
    """moveit_msgs/CollisionObject; its meshes are in its own pose."""
    here = pose_message(np.eye(4), make)
    return make(
        "moveit_msgs/msg/CollisionObject",
        header=header,
        pose=pose_message(pose, make),
        id=name,
        type=make("object_recognition_msgs/msg/ObjectType", key="", db=""),
        primitives=[],
        primitive_poses=[],
        meshes=meshes,
        mesh_poses=[here for _ in meshes],
        planes=[],
        plane_poses=[],
        subframe_names=[],
        subframe_poses=[],
        operation=operation,
    )
