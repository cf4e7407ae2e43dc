"""Boundaries of surfaces: sub-pixel rings in the image, in 3-D, and polygons with holes on planes.

The rays through the vertices of the rings (`rings`) are intersected with the plane, which keeps lines
straight and rings simple; measured points play no part. On curved surfaces they meet the patch of the
region beside them.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.errors import RcsegError
from rcseg_core.frame import PinholeCamera
from rcseg_core.models.polynomials import predict
from rcseg_core.shapes.plane_forms import LocalPlane
from rcseg_core.world.rings import Rings, trace
from rcseg_core.world.scene import Scene, Shaped
from rcseg_core.world.values import Boundary, Ring

Array = NDArray[np.float64]

#: Where a plane lies beyond this many times the measured depth it says nothing of the pixel.
MOST_DEPTH = 2.0
#: Inverse depth of a plane at one corner of its box over that at another below which its pixels are looked
#: at.
NEAR_HORIZON = 0.05


@bare
def _along_models(models, owner, pixels, out):  # type: ignore[no-untyped-def]
    """out (n, Cr): the whitened range channels of regions owner (n,) at pixels (n, 2)."""
    for i in range(owner.size):
        for c in range(out.shape[1]):
            out[i, c] = predict(models, owner[i], pixels[i, 0], pixels[i, 1], 0, c)


@bare
def _before_horizon(surfaces, points, planes, lens, out):  # type: ignore[no-untyped-def]
    """out (H, W): the surfaces without pixels at which their plane lies behind or much beyond what was
    measured.

    planes : (M + 1, 3) normal over distance, so that its product with a ray is inverse depth; 0 for others
    lens : (fx, fy, cx, cy)
    """
    for row in range(surfaces.shape[0]):
        y = (row - lens[3]) / lens[1]
        for col in range(surfaces.shape[1]):
            s = surfaces[row, col]
            out[row, col] = s
            if s > 0 and planes[s, 2] + abs(planes[s, 0]) + abs(planes[s, 1]) != 0.0:
                inverse = planes[s, 0] * (col - lens[2]) / lens[0] + planes[s, 1] * y + planes[s, 2]
                depth = points[row, col, 2]
                if inverse <= 0.0 or inverse * MOST_DEPTH * depth < 1.0:
                    out[row, col] = 0


def find_rings(scene: Scene) -> Rings:
    """The rings of all surfaces of a scene, found once."""
    if "rings" not in scene.known:
        surfaces = scene.surface_labels
        if scene.camera is not None:
            planes = _with_horizon(scene, scene.camera)
            if planes.any():
                camera, surfaces = scene.camera, np.empty_like(surfaces)
                lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
                _before_horizon(scene.surface_labels, scene.points, planes, lens, surfaces)
        scene.known["rings"] = trace(surfaces, scene.labels, scene.models, scene.signals.inverse_depth)
    found: Rings = scene.known["rings"]
    return found


def _with_horizon(scene: Scene, camera: PinholeCamera) -> Array:
    """(M + 1, 3) normal over distance of planes whose horizon comes near their box in the image; 0 for
    others."""
    out = np.zeros((len(scene.surfaces) + 1, 3))
    planes = [(s.label, s.box, p) for s, p in zip(scene.surfaces, scene.planes, strict=True) if p is not None]
    if not planes:
        return out
    labels = np.array([label for label, _, _ in planes])
    boxes = np.array([box for _, box, _ in planes], float)
    over = np.array([plane.normal / plane.distance for _, _, plane in planes])
    x, y = (boxes[:, 1::2] - camera.cx) / camera.fx, (boxes[:, ::2] - camera.cy) / camera.fy
    inverse = x[:, :, None] * over[:, :1, None] + y[:, None] * over[:, 1:2, None] + over[:, 2:, None]
    corners = inverse.reshape(-1, 4)
    near = corners.min(axis=1) < NEAR_HORIZON * corners.max(axis=1)
    out[labels[near]] = over[near]
    return out


def outline(scene: Scene, surface: Shaped) -> Boundary:
    """Where a surface ends, see `values.Boundary`."""
    rings = find_rings(scene)
    parts = _parts(rings, np.flatnonzero(rings.surfaces == surface.label), scene.config.polygon_least)
    plane = scene.planes[surface.label - 1]
    rays = _rays_of(scene, rings) if scene.camera is not None else None
    drawn, polygons = [], []
    for part in parts:
        local = []
        for i in part:
            own = slice(rings.starts[i], rings.starts[i + 1])
            pixels = rings.vertices[own]
            if plane is not None and rays is not None:
                points = _on_plane(plane, rays[own])
            else:
                points = _on_models(scene, pixels, rings.owners[own])
            drawn.append(Ring(pixels, points, i != part[0]))
            if plane is not None:
                local.append((points - plane.origin) @ plane.pose[:3, :2])
        if plane is not None:
            polygons.append(_polygon(local, scene.config.polygon_tolerance))
    return Boundary(tuple(drawn), tuple(p for p in polygons if not p.is_empty))


def _parts(rings: Rings, own: NDArray[np.int64], least_px: float) -> list[list[int]]:
    """The rings of each part of a surface, the outer one first, the largest part first.

    Parts and holes of fewer than `least_px` pixels are left out, though not the largest part.
    """
    least = least_px - 0.501  # four corners are cut by an eighth of a pixel each
    outer = [int(i) for i in own[np.argsort(-rings.areas[own], kind="stable")] if rings.areas[i] > 0]
    outer = [i for at, i in enumerate(outer) if at == 0 or rings.areas[i] >= least]
    parts = {i: [i] for i in outer}
    holes = [int(i) for i in own if rings.areas[i] <= -least]
    if len(outer) == 1:
        parts[outer[0]] += holes
    elif holes:
        shapes = {i: shapely.Polygon(rings.vertices[rings.starts[i] : rings.starts[i + 1]]) for i in outer}
        for hole in holes:
            inside = [i for i in outer if shapely.contains_xy(shapes[i], *rings.vertices[rings.starts[hole]])]
            if inside:  # else in a part that was left out
                parts[min(inside, key=lambda i: rings.areas[i])].append(hole)
    return list(parts.values())


def _rays(scene: Scene, pixels: Array) -> Array:
    assert scene.camera is not None
    camera = scene.camera
    rays = np.ones((len(pixels), 3))
    rays[:, 0] = (pixels[:, 1] - camera.cx) / camera.fx
    rays[:, 1] = (pixels[:, 0] - camera.cy) / camera.fy
    return rays


def _rays_of(scene: Scene, rings: Rings) -> Array:
    """The rays of all vertices of a scene's rings, once."""
    if "rays" not in scene.known:
        scene.known["rays"] = _rays(scene, rings.vertices)
    return np.asarray(scene.known["rays"])


def _on_plane(plane: LocalPlane, rays: Array) -> Array:
    """(n, 3) where rays meet a plane; at its horizon as far away as half the least ahead."""
    inverse = rays @ plane.normal / plane.distance
    ahead = inverse[inverse > 0]
    return rays / np.maximum(inverse, 0.5 * ahead.min() if len(ahead) else 1.0)[:, None]


def _on_models(scene: Scene, pixels: Array, beside: NDArray[np.int64]) -> Array:
    """(n, 3) where the rays of pixels meet the patch of the region beside them; NaN behind the camera."""
    signals = scene.signals
    owner = scene.labels[beside[:, 0], beside[:, 1]].astype(np.int64)
    values = np.empty((len(pixels), signals.n_range))
    _along_models(scene.models, owner, np.ascontiguousarray(pixels), values)
    values = values * signals.scale[: signals.n_range] + signals.offset[: signals.n_range]
    if not signals.inverse_depth:
        return values
    inverse = np.where(values[:, 0] > 0, values[:, 0], np.nan)
    return np.asarray(_rays(scene, pixels) / inverse[:, None])


def _polygon(rings: Sequence[Array], tolerance_m: float) -> shapely.Polygon:
    """A valid polygon of an outer ring and holes (n, 2), simplified; the largest part where one must be
    cut."""
    exact = shapely.Polygon(rings[0], rings[1:])
    if tolerance_m > 0:
        few = [_thinned(ring, tolerance_m) for ring in rings]
        if min(len(ring) for ring in few) >= 3:
            quick = shapely.Polygon(few[0], few[1:])
            if quick.is_valid:
                return shapely.normalize(quick)
        simple = shapely.simplify(
            exact, tolerance_m, preserve_topology=True
        )  # slower, and keeps the topology
        if isinstance(simple, shapely.Polygon) and not simple.is_empty and simple.is_valid:
            return shapely.normalize(simple)
    if exact.is_valid:
        return shapely.normalize(exact)
    pieces = shapely.get_parts(shapely.get_parts(shapely.make_valid(exact)))
    pieces = [piece for piece in pieces if isinstance(piece, shapely.Polygon)]
    return shapely.normalize(max(pieces, key=lambda piece: piece.area)) if pieces else shapely.Polygon()


def _thinned(ring: Array, tolerance_m: float) -> Array:
    """A ring (n, 2) without points that are not needed (Douglas and Peucker); it may come to cross itself."""
    thin = cv2.approxPolyDP(ring.astype(np.float32), tolerance_m, True)
    return np.asarray(thin[:, 0], np.float64)


def triangles(polygon: shapely.Polygon) -> tuple[Array, NDArray[np.int32]]:
    """A polygon cut into triangles that leave its holes open.

    Returns
    -------
    vertices : (n, 2) float64
    triangles : (m, 3) int32, counter-clockwise
    """
    if hasattr(shapely, "constrained_delaunay_triangles"):
        cut = shapely.normalize(shapely.constrained_delaunay_triangles(polygon))
        corners = shapely.get_coordinates(cut).reshape(-1, 4, 2)[:, :3]
    else:
        corners = _earcut(polygon)
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    turn = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    corners[turn < 0] = corners[turn < 0][:, ::-1]
    vertices, index = np.unique(corners.reshape(-1, 2), axis=0, return_inverse=True)
    return vertices, index.reshape(-1, 3).astype(np.int32)


def _earcut(polygon: shapely.Polygon) -> Array:
    """(m, 3, 2) corners of triangles, where shapely is older than 2.1."""
    try:
        import mapbox_earcut
    except ImportError:
        raise RcsegError("triangles need shapely 2.1 or mapbox_earcut: pip install mapbox_earcut") from None
    rings = [np.asarray(ring.coords)[:-1] for ring in (polygon.exterior, *polygon.interiors)]
    vertices = np.concatenate(rings)
    ends = np.cumsum([len(ring) for ring in rings]).astype(np.uint32)
    return np.asarray(vertices[mapbox_earcut.triangulate_float64(vertices, ends).reshape(-1, 3)])


def inset(polygon: shapely.Polygon, distance_m: float) -> shapely.Polygon | shapely.MultiPolygon:
    """A polygon without what is nearer than a distance to its outline or to a hole."""
    return polygon.buffer(-distance_m, join_style="mitre") if distance_m > 0 else polygon
