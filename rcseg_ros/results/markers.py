"""Results as visualization_msgs markers for RViz and Foxglove: of regions the fitted surfaces, oriented
boxes, normals and labels; of surfaces spheres and cylinders, polygons and their outlines; boxes of objects.

Drawn from the RegionArray and ObjectArray messages, not from the core's result, so any program that holds the
messages can draw the same; the label image only cuts each patch to its region's outline. What is followed has
the number of its track, and lines the colour of that.
"""

from __future__ import annotations

from collections.abc import Iterator
from colorsys import hsv_to_rgb
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from shapely import Polygon

from rcseg_core.world import CATEGORIES, triangles
from rcseg_ros.patches import surface_points
from rcseg_ros.results.colors import CATEGORY_COLORS
from rcseg_ros.results.marker_bytes import ARROW, LINE_LIST, TEXT, TRIANGLES, Drawing

CIRCLE_LINES = 24
SHAPES = ("none", "plane", "sphere", "cylinder")  # names of the constants of rcseg_msgs/Primitive
SPHERE, CYLINDER = 2, 3  # constants of rcseg_msgs/Primitive
_SOLID = (1.0, 1.0, 1.0)  # scale of triangles, in metres
MESH_PX = 12  # side of a mesh cell; markers are pictures, not data

BOX_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
BOX_EDGES = [
    (a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(BOX_CORNERS[a] - BOX_CORNERS[b]).sum() == 1
]


def draw(array: Any, labels: NDArray[np.int32], objects: Any = None) -> list[Drawing]:
    """Markers of a frame.

    Parameters
    ----------
    array : rcseg_msgs/RegionArray
    labels : (H, W) int32 label image of the same frame
    objects : rcseg_msgs/ObjectArray of the same frame, or None
    """
    drawn = [one for region in array.regions for one in _region(array, region, labels)]
    drawn += [one for surface in array.surfaces for one in _surface(array, surface)]
    drawn += [one for each in getattr(objects, "objects", ()) for one in _object(each)]
    return [one for one in drawn if np.isfinite(one.points).all() and np.isfinite(one.position).all()]


def _region(array: Any, region: Any, labels: NDArray[np.int32]) -> Iterator[Drawing]:
    color = np.asarray(region.mean_color) / 255.0
    number = region.track or region.label
    lines = track_color(region.track) if region.track else color
    mesh = _mesh(array, region, labels)
    if len(mesh):
        yield Drawing("surfaces", number, TRIANGLES, mesh, color, 0.9, _SOLID)
    yield Drawing("boxes", number, LINE_LIST, box_edges(region.extent_pose, region.extent_size), lines, 0.8)
    yield Drawing("normals", number, ARROW, _arrow(region), (1.0, 1.0, 0.2), 1.0, (0.01, 0.02, 0.0))
    middle = (region.centroid.x, region.centroid.y, region.centroid.z)
    yield Drawing("labels", number, TEXT, scale=(0, 0, 0.04), position=middle, text=str(number))


def _surface(array: Any, surface: Any) -> Iterator[Drawing]:
    lines, number = shape_lines(array, surface), surface.track or surface.label
    if len(lines):
        yield Drawing(
            "shapes", number, LINE_LIST, lines, track_color(number) if surface.track else (1.0, 1.0, 1.0)
        )
    yield from surface_drawings(surface)


def surface_drawings(surface: Any) -> Iterator[Drawing]:
    """The polygons of a plane, filled and outlined in the colour of its class."""
    if not getattr(surface, "polygons", ()):  # recordings of older versions have none
        return
    number = surface.track or surface.label
    color = CATEGORY_COLORS[CATEGORIES[surface.category]] / 255.0
    fills, outlines = [], []
    for plane in surface.plane:
        for polygon in surface.polygons:
            flat, faces = triangles(shapely_polygon(polygon))
            fills.append(_in_space(plane.pose, flat[faces].reshape(-1, 2)))
            for ring in (polygon.outer, *polygon.holes):
                vertices = np.stack([ring.x, ring.y], axis=1)
                ends = np.stack([vertices, np.roll(vertices, -1, axis=0)], axis=1).reshape(-1, 2)
                outlines.append(_in_space(plane.pose, ends))
    if fills:
        yield Drawing("polygons", number, TRIANGLES, np.concatenate(fills), color, 0.6, _SOLID)
        yield Drawing("outlines", number, LINE_LIST, np.concatenate(outlines), color, 1.0, (0.006, 0, 0))


def _object(one: Any) -> Iterator[Drawing]:
    color = track_color(one.track) if one.track else (0.2, 0.9, 1.0)
    number = one.track or one.label
    edges = box_edges(one.box_pose, one.box_size)
    yield Drawing("objects", number, LINE_LIST, edges, color, 1.0, (0.006, 0, 0))
    at = one.box_pose.position
    yield Drawing(
        "object_labels", number, TEXT, rgb=color, scale=(0, 0, 0.05), position=(at.x, at.y, at.z),
        text=f"object {number}",
    )  # fmt: skip


def track_color(track: int) -> NDArray[np.float64]:
    """(3,) bright colour 0..1 that a track keeps; hues a golden section apart, so that near ids differ."""
    return np.asarray(hsv_to_rgb(track * 0.618033988749895 % 1.0, 0.75, 1.0))


def shapely_polygon(polygon: Any) -> Polygon:
    """A rcseg_msgs/PlanarPolygon as shapely takes it."""
    outer, *holes = (np.stack([ring.x, ring.y], axis=1) for ring in (polygon.outer, *polygon.holes))
    return Polygon(outer, holes)


def _in_space(pose: Any, flat: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 3) points of (n, 2) in the x and y of a geometry_msgs/Pose."""
    q, at = pose.orientation, pose.position
    turn = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    return np.asarray(flat @ turn[:, :2].T + [at.x, at.y, at.z])


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


def box_edges(pose: Any, size: Any) -> NDArray[np.float64]:
    """(24, 3) ends of the twelve edges of a box, of its geometry_msgs Pose and Vector3."""
    at, q = pose.position, pose.orientation
    rotation = Rotation.from_quat([q.x, q.y, q.z, q.w])
    corners = np.array([at.x, at.y, at.z]) + rotation.apply(BOX_CORNERS * [size.x, size.y, size.z])
    return corners[np.array(BOX_EDGES).ravel()]


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
    parts = [array.regions[label - 1] for label in surface.regions]
    corners = np.concatenate([box_edges(part.extent_pose, part.extent_size) for part in parts])
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
