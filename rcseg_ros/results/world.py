"""Categories, polygons and objects as messages; `make(type name, **fields)` builds them as elsewhere."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_core.world import CATEGORIES, Object, World
from rcseg_ros.results.outputs import Make

Array = NDArray[np.float64]


def surface_fields(world: World, objects: Array, label: int, make: Make) -> dict[str, Any]:
    """What rcseg_msgs/Surface holds of the world.

    Parameters
    ----------
    objects : the object of each surface, see `objects_of_surfaces`
    label : of the surface
    """
    category = world.categories[label - 1]
    return {
        "category": CATEGORIES.index(category.name),
        "category_probability": float(category.probability),
        "polygons": [planar_polygon(polygon, make) for polygon in world.boundaries[label - 1].polygons],
        "object": int(objects[label]),
    }


def objects_of_surfaces(world: World, surfaces: int) -> NDArray[np.int64]:
    """(M + 1,) label of the object that each surface is part of; 0: of none."""
    of = np.zeros(surfaces + 1, np.int64)
    for one in world.objects:
        of[list(one.surfaces)] = one.label
    return of


def planar_polygon(polygon: Any, make: Make) -> Any:
    """rcseg_msgs/PlanarPolygon of a shapely Polygon: the outer ring counter-clockwise, holes clockwise."""
    return make(
        "rcseg_msgs/msg/PlanarPolygon",
        outer=_ring(ring_of(polygon.exterior, counter_clockwise=True), make),
        holes=[_ring(ring_of(hole, counter_clockwise=False), make) for hole in polygon.interiors],
        area=float(polygon.area),
    )


def ring_of(line: Any, *, counter_clockwise: bool) -> Array:
    """(n, 2) vertices of a shapely ring in that direction, the first not repeated."""
    vertices = np.asarray(line.coords)[:-1, :2]
    return vertices if line.is_ccw == counter_clockwise else vertices[::-1]


def _ring(vertices: Array, make: Make) -> Any:
    x, y = np.ascontiguousarray(vertices.T)
    return make("rcseg_msgs/msg/Ring", x=x, y=y)


def up_vector(world: World, make: Make) -> Any:
    """geometry_msgs/Vector3 of up; NaN where it is unknown."""
    return _xyz("Vector3", np.full(3, np.nan) if world.up is None else world.up.vector, make)


def object_array(world: World, header: Any, make: Make, ids: NDArray[np.int32] | None = None) -> Any:
    """rcseg_msgs/ObjectArray of a frame; ids : (K + 1,) of tracks, where objects are followed."""
    labels = world.object_labels
    return make(
        "rcseg_msgs/msg/ObjectArray",
        header=header,
        height=labels.shape[0],
        width=labels.shape[1],
        objects=[
            _object(one, 0 if ids is None else int(ids[one.label]), _pixel_box(one, world), make)
            for one in world.objects
        ],
    )


def _object(one: Any, track: int, box: list[int], make: Make) -> Any:
    names = ("row_min", "col_min", "row_max", "col_max")
    return make(
        "rcseg_msgs/msg/Object",
        label=one.label,
        track=track,
        surfaces=np.array(one.surfaces, np.uint32),
        pixel_count=one.pixel_count,
        pixels=make("rcseg_msgs/msg/PixelBox", **dict(zip(names, box, strict=True))),
        box_pose=pose_message(one.box3d.pose, make),
        box_size=_xyz("Vector3", one.box3d.size, make),
        stands_on=int(one.stands_on),
    )


def _pixel_box(one: Object, world: World) -> list[int]:
    """Smallest pixel box (row_min, col_min, row_max, col_max), inclusive: round those of its surfaces."""
    low_row, low_col, high_row, high_col = zip(
        *(world.scene.surfaces[label - 1].box for label in one.surfaces), strict=True
    )
    return [min(low_row), min(low_col), max(high_row), max(high_col)]


def polygon_instances(
    surfaces: Any, world: World, header: Any, make: Make, ids: NDArray[np.int32] | None = None
) -> list[Any]:
    """geometry_msgs/PolygonInstanceStamped of every plane: the outer ring of its largest part in 3-D.

    That message holds no holes and no second part; rcseg_msgs/Surface does. Its id is that of the track in
    `ids` (M + 1,), else the label of the surface.
    """
    found = []
    for surface in surfaces:
        polygons = world.boundaries[surface.label - 1].polygons if surface.plane is not None else ()
        if polygons:
            flat = ring_of(polygons[0].exterior, counter_clockwise=True)
            points = on_plane(surface.plane.pose, flat).astype(np.float32).tolist()
            corners = [make("geometry_msgs/msg/Point32", x=x, y=y, z=z) for x, y, z in points]
            polygon = make("geometry_msgs/msg/Polygon", points=corners)
            instance = make(
                "geometry_msgs/msg/PolygonInstance",
                polygon=polygon,
                id=int(surface.label if ids is None else ids[surface.label]),
            )
            stamped = make("geometry_msgs/msg/PolygonInstanceStamped", header=header, polygon=instance)
            found.append(stamped)
    return found


def on_plane(pose: Array, flat: Array) -> Array:
    """(n, 3) points in the sensor's frame of (n, 2) in the x, y of a plane's pose (4, 4)."""
    return np.asarray(flat @ pose[:3, :2].T + pose[:3, 3])


def pose_message(pose: Array, make: Make) -> Any:
    """geometry_msgs/Pose of a (4, 4) pose."""
    return make(
        "geometry_msgs/msg/Pose",
        position=_xyz("Point", pose[:3, 3], make),
        orientation=make(
            "geometry_msgs/msg/Quaternion", **dict(zip("xyzw", quaternion(pose[:3, :3]), strict=True))
        ),
    )


def quaternion(turn: Array) -> list[float]:
    """x, y, z, w of a rotation (3, 3): that of scipy's Rotation, in a fiftieth of its time for a single one.

    The largest of the four is found first, since the others are divided by it.
    """
    m = turn.tolist()
    trace = m[0][0] + m[1][1] + m[2][2]
    i = max(range(3), key=lambda at: m[at][at])
    j, k = (i + 1) % 3, (i + 2) % 3
    parts = [0.0] * 4
    if m[i][i] > trace:
        parts[i] = 1.0 - trace + 2.0 * m[i][i]
        parts[j], parts[k] = m[j][i] + m[i][j], m[k][i] + m[i][k]
        parts[3] = m[k][j] - m[j][k]
    else:
        parts[:] = m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1], 1.0 + trace
    length = math.sqrt(sum(part * part for part in parts))
    return [part / length for part in parts]


def _xyz(kind: str, values: Array, make: Make) -> Any:
    x, y, z = (float(value) for value in values)
    return make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)
