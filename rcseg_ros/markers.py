"""Regions as visualization_msgs markers: the fitted surfaces, oriented boxes, normals and labels, and the
spheres and cylinders among the surfaces, for RViz and Foxglove.

Drawn from the RegionArray message, not from the core's result, so any program that holds the message can
draw the same; the label image only cuts each patch to its region's outline.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rcseg_ros.outputs import Make
from rcseg_ros.patches import surface_points

CIRCLE_LINES = 24
SPHERE, CYLINDER = 2, 3  # constants of rcseg_msgs/Primitive
MESH_PX = 12  # side of a mesh cell; markers are pictures, not data
ARROW, LINE_LIST, TEXT, TRIANGLES, DELETE_ALL = 0, 5, 9, 11, 3  # constants of visualization_msgs/Marker

_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(_CORNERS[a] - _CORNERS[b]).sum() == 1]


def marker_array(array: Any, labels: NDArray[np.int32], make: Make) -> Any:
    """Draw a RegionArray; the first marker deletes what was drawn before.

    Parameters
    ----------
    array : rcseg_msgs/RegionArray
    labels : (H, W) int32 label image of the same frame
    make : callable(type name, **fields) that builds messages
    """
    markers = [make("visualization_msgs/msg/Marker", header=array.header, action=DELETE_ALL)]
    for region in array.regions:
        color = np.asarray(region.mean_color) / 255.0
        drawn = (
            ("surfaces", TRIANGLES, _mesh(array, region, labels), color, 0.9),
            ("boxes", LINE_LIST, box_edges(region), color, 0.8),
            ("normals", ARROW, _arrow(region), np.array([1.0, 1.0, 0.2]), 1.0),
        )
        for name, kind, points, rgb, alpha in drawn:
            if len(points) and np.isfinite(points).all():
                markers.append(_marker(array.header, name, region.label, kind, points, rgb, alpha, make))
        if np.isfinite(region.centroid.z):
            markers.append(_text(array.header, region, make))
    for surface in array.surfaces:
        lines = shape_lines(array, surface)
        if len(lines) and np.isfinite(lines).all():
            white = np.ones(3)
            markers.append(_marker(array.header, "shapes", surface.label, LINE_LIST, lines, white, 1.0, make))
    return make("visualization_msgs/msg/MarkerArray", markers=markers)


def _mesh(array: Any, region: Any, labels: NDArray[np.int32]) -> NDArray[np.float64]:
    """(6 M, 3) corners of the two triangles of each mesh cell whose centre pixel belongs to the region."""
    box = region.pixels
    rows = np.linspace(box.row_min, box.row_max, 2 + (box.row_max - box.row_min) // MESH_PX)
    cols = np.linspace(box.col_min, box.col_max, 2 + (box.col_max - box.col_min) // MESH_PX)
    grid = surface_points(array, region, *np.meshgrid(rows, cols, indexing="ij"))
    centers = np.ix_(
        np.rint((rows[1:] + rows[:-1]) / 2).astype(int), np.rint((cols[1:] + cols[:-1]) / 2).astype(int)
    )
    inside = labels[centers] == region.label
    a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, :-1], grid[1:, 1:]
    cells = np.stack([a, c, b, b, c, d], axis=2)[inside]
    return cells[np.isfinite(cells).all(axis=(1, 2))].reshape(-1, 3)


def box_edges(region: Any) -> NDArray[np.float64]:
    """(24, 3) ends of the twelve edges of the oriented box."""
    pose, size = region.extent_pose, region.extent_size
    orientation = pose.orientation
    rotation = Rotation.from_quat([orientation.x, orientation.y, orientation.z, orientation.w])
    center = [
        pose.position.x,
        pose.position.y,
        pose.position.z,
    ]
    corners = np.array(center) + rotation.apply(_CORNERS * [size.x, size.y, size.z])
    return corners[np.array(_EDGES).ravel()]


def shape_lines(array: Any, surface: Any) -> NDArray[np.float64]:
    """(2 M, 3) ends of the lines that show a recognised sphere or cylinder; none for other surfaces.

    A sphere is three circles, a cylinder a ring at either end of the boxes of its regions and four lines.
    """
    shape = surface.primitive
    values = np.asarray(shape.parameters)
    if shape.kind == SPHERE:
        return np.concatenate([_circle(values[:3], axis, values[3]) for axis in np.eye(3)])
    if shape.kind != CYLINDER:
        return np.empty((0, 3))
    point, axis, radius = values[:3], values[3:6], values[6]
    corners = np.concatenate([box_edges(array.regions[label - 1]) for label in surface.regions])
    heights = (corners[np.isfinite(corners).all(axis=1)] - point) @ axis
    if not len(heights):
        return np.empty((0, 3))
    low, high = (_circle(point + height * axis, axis, radius) for height in (heights.min(), heights.max()))
    quarter = len(low) // 4
    sides = np.stack([low[::quarter], high[::quarter]], axis=1).reshape(-1, 3)
    return np.concatenate([low, high, sides])


def _circle(center: NDArray[Any], axis: NDArray[Any], radius: float) -> NDArray[np.float64]:
    """(2 CIRCLE_LINES, 3) ends of the lines of a circle about a unit vector."""
    first = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    first /= np.linalg.norm(first)
    angle = 2 * np.pi * np.arange(CIRCLE_LINES + 1)[:, None] / CIRCLE_LINES
    points = center + radius * (np.cos(angle) * first + np.sin(angle) * np.cross(axis, first))
    return np.stack([points[:-1], points[1:]], axis=1).reshape(-1, 3)


def _arrow(region: Any) -> NDArray[np.float64]:
    """(2, 3) arrow from the centroid along the normal, a tenth of the region's distance long."""
    start = np.array([region.centroid.x, region.centroid.y, region.centroid.z])
    return np.stack(
        [
            start,
            start
            + 0.1 * np.linalg.norm(start) * np.array([region.normal.x, region.normal.y, region.normal.z]),
        ]
    )


def _marker(
    header: Any, name: str, label: int, kind: int, points: Any, rgb: Any, alpha: float, make: Make
) -> Any:
    width = {LINE_LIST: 0.003, ARROW: 0.01, TRIANGLES: 1.0}[kind]
    return make(
        "visualization_msgs/msg/Marker",
        header=header,
        ns=name,
        id=int(label),
        type=kind,
        scale=make(
            "geometry_msgs/msg/Vector3",
            x=width,
            y=2 * width if kind == ARROW else width,
            z=width if kind == TRIANGLES else 0.0,
        ),
        color=make("std_msgs/msg/ColorRGBA", r=float(rgb[0]), g=float(rgb[1]), b=float(rgb[2]), a=alpha),
        points=[make("geometry_msgs/msg/Point", x=x, y=y, z=z) for x, y, z in points.tolist()],
    )


def _text(header: Any, region: Any, make: Make) -> Any:
    return make(
        "visualization_msgs/msg/Marker",
        header=header,
        ns="labels",
        id=int(region.label),
        type=TEXT,
        pose=make("geometry_msgs/msg/Pose", position=region.centroid),
        scale=make("geometry_msgs/msg/Vector3", z=0.04),
        color=make("std_msgs/msg/ColorRGBA", r=1.0, g=1.0, b=1.0, a=1.0),
        text=str(region.label),
    )
