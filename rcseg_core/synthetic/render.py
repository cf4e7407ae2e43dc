"""The truth of one layout from one pose: geometry, paint and labels, before any light or noise."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_core.frame import PinholeCamera

from .geometry import Hits, Solid, cast
from .layouts import Layout
from .paint import random_texture

Array = NDArray[np.float64]
Labels = NDArray[np.int32]

MAX_RANGE_M = 6.0
"""Beyond this a camera gets no return."""


def components(codes: Labels) -> Labels:
    """Label the 4-connected components of equal positive codes (H, W): int32, 1..N, 0 where the code is 0.

    Numbers go by code and then in scan order, so that the same picture gives the same labels.
    """
    labels = np.zeros(codes.shape, np.int32)
    count = 0
    for code in np.unique(codes[codes > 0]):
        number, parts = cv2.connectedComponents((codes == code).astype(np.uint8), connectivity=4)
        labels += np.where(parts > 0, parts + count, 0).astype(np.int32)
        count += number - 1
    return labels


class Rendering:
    """What the rays of one view meet. Arrays over rays are (N, ...), row major; images (H, W).

    Attributes
    ----------
    depth_m : (H, W) float64; NaN where the ray meets nothing
    world_points, normals : (N, 3) float64, world axes; NaN likewise
    labels, surface_labels, object_labels : (H, W) int32; see `SyntheticScene`
    """

    def __init__(self, layout: Layout, camera: PinholeCamera | None, shape: tuple[int, int]) -> None:
        self.layout, self.shape = layout, shape
        self.start, self.direction = _rays(layout, camera, shape)
        world_start = layout.position + self.start @ layout.rotation
        world_direction = self.direction @ layout.rotation
        hits = cast(layout.solids, world_start, world_direction)
        too_far = hits.t > MAX_RANGE_M
        self.hits = Hits(
            np.where(too_far, np.inf, hits.t),
            np.where(too_far, -1, hits.solid),
            np.where(too_far, -1, hits.face),
        )
        depth = np.where(np.isfinite(self.hits.t), self.hits.t, np.nan)
        self.world_points = world_start + depth[:, None] * world_direction
        self.depth_m = depth.reshape(shape)
        self._trace_surfaces()

    def _trace_surfaces(self) -> None:
        n = len(self.hits.t)
        self.normals, self.coords = np.full((n, 3), np.nan), np.zeros((n, 3))
        surface, paint = np.zeros(n, np.int32), np.zeros(n, np.int32)
        self.faces: list[tuple[Solid, int, NDArray[np.intp]]] = []
        keys = self.hits.solid.astype(np.int32) * 64 + self.hits.face
        for key in np.unique(keys[self.hits.solid >= 0]):
            solid, face = self.layout.solids[key // 64], int(key % 64)
            rays = np.flatnonzero(keys == key)
            normals, coords = solid.shape.describe(self.world_points[rays], face)
            self.normals[rays], self.coords[rays, : coords.shape[1]] = normals, coords
            surface[rays], paint[rays] = key + 1, solid.paint(face).index(coords)
            self.faces.append((solid, face, rays))
        self.paint_index = paint
        self.surface_labels = components(surface.reshape(self.shape))
        self.labels = components(np.where(surface > 0, surface * 64 + paint, 0).reshape(self.shape))
        self.object_labels = (self.hits.solid.astype(np.int32) + 1).reshape(self.shape)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Rays (N,) that meet something."""
        return np.isfinite(self.hits.t)

    def points(self, depth_m: Array) -> Array:
        """Points (H, W, 3) in the camera's frame for depths (H, W)."""
        flat = self.start + depth_m.reshape(-1, 1) * self.direction
        return flat.reshape(*self.shape, 3)

    def color(self, texture_rng: np.random.Generator, textured_share: float) -> Array:
        """Albedo with slow variation and texture: (N, 3) levels; 0 where the ray meets nothing."""
        color = np.zeros((len(self.hits.t), 3))
        textures = _choose_textures(self.layout.solids, texture_rng, textured_share)
        for solid, face, rays in self.faces:
            paint = solid.paint(face)
            texture = textures.get((id(solid), face))
            if texture is not None:
                paint = paint.textured(texture)
            size = solid.shape.describe(self.world_points[rays[:1]], face)[1].shape[1]
            color[rays] = paint.color(self.coords[rays, :size], self.paint_index[rays])
        return color


def _rays(layout: Layout, camera: PinholeCamera | None, shape: tuple[int, int]) -> tuple[Array, Array]:
    """Start points and directions (N, 3) of all pixels in the camera's frame; directions have z = 1."""
    rows, cols = np.mgrid[0 : shape[0], 0 : shape[1]].reshape(2, -1).astype(float)
    ones, zeros = np.ones(rows.size), np.zeros(rows.size)
    if camera is not None:
        x, y = (cols - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
        return np.zeros(3), np.stack([x, y, ones], axis=1)
    assert layout.image_height_m is not None
    pitch = layout.image_height_m / shape[0]
    x, y = (cols - (shape[1] - 1) / 2) * pitch, (rows - (shape[0] - 1) / 2) * pitch
    return np.stack([x, y, zeros], axis=1), np.stack([zeros, zeros, ones], axis=1)


def _choose_textures(
    solids: list[Solid], rng: np.random.Generator, share: float
) -> dict[tuple[int, int], Callable[[Array], Array]]:
    """Textures for a share of all faces, drawn for every face in turn so that the choice does not hang on
    the view."""
    chosen = {}
    for solid in solids:
        for face in range(8):
            picked, texture = rng.random() < share, random_texture(rng, _texture_scale(solid))
            if picked:
                chosen[id(solid), face] = texture
    return chosen


def _texture_scale(solid: Solid) -> float:
    """About an eighth of the solid; on a ball the coordinates are unit vectors, so metres become radii."""
    bound = solid.shape.bounding_sphere
    if bound is None:
        return 0.12
    return 0.25 if solid.name == "ball" else 0.25 * bound[1]
