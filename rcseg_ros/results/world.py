"""Categories, polygons and objects as messages; `make(type name, **fields)` builds them as elsewhere."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import find_objects
from scipy.spatial.transform import Rotation

from rcseg_core.world import CATEGORIES, World
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
    boxes = pixel_boxes(labels, len(world.objects))
    return make(
        "rcseg_msgs/msg/ObjectArray",
        header=header,
        height=labels.shape[0],
        width=labels.shape[1],
        objects=[
            _object(one, 0 if ids is None else int(ids[one.label]), boxes[one.label - 1], make)
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


def pixel_boxes(labels: NDArray[np.int32], count: int) -> list[list[int]]:
    """Smallest pixel box (row_min, col_min, row_max, col_max), inclusive, of each label 1..count."""
    found = find_objects(labels, count)
    return [[rows.start, cols.start, rows.stop - 1, cols.stop - 1] for rows, cols in found]


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
    turn = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    return make(
        "geometry_msgs/msg/Pose",
        position=_xyz("Point", pose[:3, 3], make),
        orientation=make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", turn, strict=True))),
    )


def _xyz(kind: str, values: Array, make: Make) -> Any:
    x, y, z = (float(value) for value in values)
    return make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)
