"""The bridges that a node's parameters turn on, and what they remember from frame to frame."""

from __future__ import annotations

from typing import Any

from rcseg_ros.bridges.moveit import CollisionScene
from rcseg_ros.bridges.packages import BRIDGES, Bridge, load
from rcseg_ros.bridges.terrain import empty_grid_map, planar_terrain
from rcseg_ros.bridges.vision import detection_array, label_info
from rcseg_ros.results.made import ResultMessages
from rcseg_ros.results.messages import make_rcl


class NodeBridges:
    """Messages of other packages, as the node's parameters `bridges.*` ask for.

    Parameters
    ----------
    parameters : the node's, by key

    Raises
    ------
    ConfigError
        If one is asked for whose package is not installed.
    """

    def __init__(self, parameters: Any) -> None:
        chosen = [one for name, ones in BRIDGES.items() if parameters[f"bridges.{name}"] for one in ones]
        self.topics: dict[str, tuple[type, Bridge]] = {one.topic: (load(one), one) for one in chosen}
        self._inset_m = parameters["bridges.inset"]
        self._scene = CollisionScene(parameters["bridges.thickness"], parameters["bridges.gone_after"])

    def messages(self, topic: str, results: ResultMessages) -> list[Any]:
        """The messages of a frame on one of the topics."""
        world, header = results.world, results.header
        if topic == "detections":
            of_objects = results.track_ids("object")
            ids = [] if of_objects is None else [int(of_objects[one.label]) for one in world.objects]
            return [detection_array(world, header, make_rcl, ids)]
        if topic == "label_info":
            return [label_info(header, make_rcl)]
        if topic == "collision_objects":
            ids = results.track_ids("surface")
            return self._scene.update(results.surfaces, world, results.stamp_ns, header, make_rcl, ids)
        grid = empty_grid_map(header, make_rcl)
        return [planar_terrain(results.surfaces, world, self._inset_m, grid, make_rcl)]
