"""shape_msgs: a plane as the coefficients of its equation, a prism over a polygon as a mesh."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_core import LocalPlane
from rcseg_core.world import triangles
from rcseg_ros.results.outputs import Make

Array = NDArray[np.float64]


def plane_message(plane: LocalPlane, make: Make) -> Any:
    """shape_msgs/Plane: a x + b y + c z + d = 0, (a, b, c) the unit normal towards the sensor."""
    return make("shape_msgs/msg/Plane", coef=np.append(plane.normal, -plane.distance))


def prism_message(polygon: Any, thickness_m: float, make: Make) -> Any:
    """shape_msgs/Mesh of a prism: a shapely Polygon with holes in x, y, from z = 0 down to -thickness.

    Triangles are wound counter-clockwise seen from outside.
    """
    vertices, faces = prism(polygon, thickness_m)
    return make(
        "shape_msgs/msg/Mesh",
        triangles=[
            make("shape_msgs/msg/MeshTriangle", vertex_indices=np.array(face, np.uint32)) for face in faces
        ],
        vertices=[make("geometry_msgs/msg/Point", x=x, y=y, z=z) for x, y, z in vertices.tolist()],
    )


def prism(polygon: Any, thickness_m: float) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (n, 3) and triangles (m, 3) of `prism_message`."""
    flat, top = triangles(polygon)
    top = top.astype(np.int64)
    count = len(flat)
    vertices = np.concatenate([np.insert(flat, 2, 0.0, axis=1), np.insert(flat, 2, -thickness_m, axis=1)])
    # An edge that only one triangle has lies on the border, and goes round it as the triangle does.
    edges = np.concatenate([top[:, [0, 1]], top[:, [1, 2]], top[:, [2, 0]]])
    inner = {(second, first) for first, second in edges.tolist()}
    border = np.array([e for e in edges.tolist() if tuple(e) not in inner], np.int64).reshape(-1, 2)
    first, second = border.T
    sides = [
        np.stack([first, first + count, second], axis=1),
        np.stack([second, first + count, second + count], axis=1),
    ]
    return vertices, np.concatenate([top, top[:, ::-1] + count, *sides])
