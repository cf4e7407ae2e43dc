"""convex_plane_decomposition_msgs: planes as PlanarTerrain, which perceptive footstep planners take.

A region's z axis is its normal and its boundary lies in its own x and y, as ours do. The elevation map of
that message stays empty: there is none.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rcseg_core.world import World
from rcseg_ros.results.outputs import Make
from rcseg_ros.results.world import pose_message, ring_of

PACKAGE = "convex_plane_decomposition_msgs/msg"
#: A foot stands on these.
STEPPABLE = ("floor", "horizontal", "inclined")


def planar_terrain(surfaces: Sequence[Any], world: World, inset_m: float, empty_map: Any, make: Make) -> Any:
    """PlanarTerrain of the planes that face up; every part of a plane is a region.

    Parameters
    ----------
    inset_m : the insets keep so far from the boundary
    empty_map : grid_map_msgs/GridMap of the frame, without layers
    """
    regions = []
    for surface in surfaces:
        if surface.plane is None or world.categories[surface.label - 1].name not in STEPPABLE:
            continue
        for polygon in world.boundaries[surface.label - 1].polygons:
            regions.append(_region(surface.plane.pose, polygon, inset_m, make))
    return make(f"{PACKAGE}/PlanarTerrain", planar_regions=regions, gridmap=empty_map)


def _region(pose: Any, polygon: Any, inset_m: float, make: Make) -> Any:
    inner = polygon.buffer(-inset_m, join_style="mitre") if inset_m > 0 else polygon
    parts = [part for part in getattr(inner, "geoms", [inner]) if not part.is_empty]
    bounds = dict(zip(("min_x", "min_y", "max_x", "max_y"), map(float, polygon.bounds), strict=True))
    return make(
        f"{PACKAGE}/PlanarRegion",
        plane_parameters=pose_message(pose, make),
        bbox2d=make(f"{PACKAGE}/BoundingBox2d", **bounds),
        boundary=_with_holes(polygon, make),
        insets=[_with_holes(part, make) for part in parts],
    )


def _with_holes(polygon: Any, make: Make) -> Any:
    return make(
        f"{PACKAGE}/PolygonWithHoles2d",
        outer_boundary=_ring(ring_of(polygon.exterior, counter_clockwise=True), make),
        holes=[_ring(ring_of(hole, counter_clockwise=False), make) for hole in polygon.interiors],
    )


def _ring(vertices: Any, make: Make) -> Any:
    points = [make(f"{PACKAGE}/Point2d", x=x, y=y) for x, y in np.asarray(vertices).tolist()]
    return make(f"{PACKAGE}/Polygon2d", points=points)


def empty_grid_map(header: Any, make: Make) -> Any:
    """grid_map_msgs/GridMap without layers, whose frame tells the receiver that of the regions."""
    info = make(
        "grid_map_msgs/msg/GridMapInfo",
        resolution=0.0,
        length_x=0.0,
        length_y=0.0,
        pose=pose_message(np.eye(4), make),
    )
    return make(
        "grid_map_msgs/msg/GridMap",
        header=header,
        info=info,
        layers=[],
        basic_layers=[],
        data=[],
        outer_start_index=0,
        inner_start_index=0,
    )
