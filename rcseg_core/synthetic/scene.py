"""Scenes with exact truth: draw a layout, cast it, then let a sensor look at it.

The truth belongs to the scene, not to the measurement: pixels that the sensor lost or disturbed keep their labels. The
layout depends on the family and the seed alone; size, noise and all other options change only how it is seen, and every
option has its own random stream.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_core.errors import InputError
from rcseg_core.frame import PinholeCamera, RangeColorFrame
from . import sensor
from .geometry import Hits, Solid, cast, occluded
from .layouts import BUILDERS, Layout
from .paint import random_texture

Array = NDArray[np.float64]
Labels = NDArray[np.int32]

FAMILIES: tuple[str, ...] = tuple(BUILDERS)
SCANNER_FAMILIES: tuple[str, ...] = ("billiard", "painting")
BASELINE_M = 0.075
MAX_RANGE_M = 6.0
"""Beyond this a camera gets no return."""
REGIONS = (5, 15)
"""Least and largest number of truth regions that matter; other layouts are drawn again."""
AREA_SHARE = 100 / (640 * 480)
"""Hoover's least region area, 100 px at 640 x 480, as a share of the image."""


@dataclass(frozen=True)
class SyntheticScene:
    """A frame and everything that is true about it. Arrays are (H, W) or (H, W, 3), row major.

    Attributes
    ----------
    frame : RangeColorFrame
        What the sensor delivers.
    labels : int32
        Truth regions: surface x albedo, 4-connected components; 0 where the ray meets nothing. Printed texture and
        shading are no albedo. Pixels that are invalid or dropped in the frame keep their label.
    surface_labels : int32
        Truth surfaces: 4-connected components of one face of one solid.
    object_labels : int32
        Number of the solid, the same in every frame of a sequence.
    clean_points : float64, metres
        Points without noise in the camera's frame; NaN where the ray meets nothing.
    clean_color : float32, levels
        Colour without noise (with shading and texture).
    normals : float32
        Unit outward normals in the camera's frame; NaN where the ray meets nothing.
    range_outliers, color_outliers : bool
        Impulse outliers of each signal; flying pixels count as range outliers.
    dropped : bool
        Pixels that meet a surface but have no range: drop-out and projector shadow.
    sigma_range : float32, metres
        True standard deviation of depth, quantisation included; NaN where the ray meets nothing.
    pose : (4, 4) float64
        Camera to world.
    """

    frame: RangeColorFrame
    labels: Labels
    surface_labels: Labels
    object_labels: Labels
    clean_points: Array
    clean_color: NDArray[np.float32]
    normals: NDArray[np.float32]
    range_outliers: NDArray[np.bool_]
    color_outliers: NDArray[np.bool_]
    dropped: NDArray[np.bool_]
    sigma_range: NDArray[np.float32]
    family: str
    seed: int
    pose: Array = field(default_factory=lambda: np.eye(4))


@dataclass(frozen=True)
class SensorOptions:
    """How a scene is seen; see `make_scene` for the meaning of each."""

    noise: float = 1.0
    color_noise: float = 3.0
    outliers: float = 0.0
    dropout: float = 0.0
    quantization: float = 0.0
    correlation_px: float = 0.0
    shading: bool = False
    texture: float = 0.0
    structured_light: bool = False

    def check(self, family: str, has_camera: bool) -> None:
        for name, high in (("outliers", 1.0), ("dropout", 1.0), ("texture", 1.0), ("noise", 1e3),
                           ("color_noise", 255.0), ("quantization", 64.0), ("correlation_px", 100.0)):  # fmt: skip
            value = getattr(self, name)
            if not 0 <= value <= high:
                raise InputError(f"make_scene: {name} is {value}; it must lie within 0 and {high:g}")
        if not has_camera and (self.quantization or self.structured_light):
            option = "structured_light" if self.structured_light else "quantization"
            raise InputError(
                f"make_scene: {option} needs a camera and family {family!r} is a scanner grid; take room, blocks or curved"
            )


def make_scene(
    family: str,
    seed: int,
    *,
    width: int = 640,
    height: int = 480,
    camera: PinholeCamera | None = None,
    noise: float = 1.0,
    color_noise: float = 3.0,
    outliers: float = 0.0,
    dropout: float = 0.0,
    quantization: float = 0.0,
    correlation_px: float = 0.0,
    shading: bool = False,
    texture: float = 0.0,
    structured_light: bool = False,
) -> SyntheticScene:
    """Draw and render one scene.

    Parameters
    ----------
    family : one of FAMILIES
    seed : int
        0-99 are meant for tuning, 100 and up for reporting.
    width, height : int
        Pixels.
    camera : PinholeCamera, optional
        By default f = 525 px at 640 px width with the principal point in the middle; scanner families have none.
    noise : float
        Factor on the family's range noise (Kinect v1: sigma_z = 1.425e-3 z^2; scanners: some tenths of a mm).
    color_noise : float
        Sigma of each channel, levels.
    outliers : float
        Share of impulse outliers, drawn independently for range and for colour.
    dropout : float
        Share of pixels that lose their range.
    quantization : float
        Step of the disparity in px (baseline 75 mm), 0 for none; cameras only.
    correlation_px : float
        Sigma of the Gaussian that correlates the range noise (its variance is kept).
    shading : bool
        Lambertian light with falloff from a lamp near the sensor.
    texture : float
        Share of the surfaces that carry a printed pattern. Truth ignores it.
    structured_light : bool
        A Kinect-like sensor: noise correlated over 1.5 px, 1/8 px disparity steps, projector shadow, flying pixels at
        depth edges, shading, and texture on half of the surfaces unless these are set already; cameras only.

    Raises
    ------
    InputError
        Unknown family, an option out of range, or one that a scanner grid does not have.
    """
    if family not in BUILDERS:
        raise InputError(f"make_scene: unknown family {family!r}; the families are {', '.join(FAMILIES)}")
    if width < 16 or height < 16:
        raise InputError(f"make_scene: the image is {width} x {height}; it must be at least 16 x 16 pixels")
    scanner = family in SCANNER_FAMILIES
    if scanner and camera is not None:
        raise InputError(f"make_scene: family {family!r} is a scanner grid and takes no camera")
    options = SensorOptions(
        noise, color_noise, outliers, dropout, quantization, correlation_px, shading, texture, structured_light
    )
    options.check(family, not scanner)
    if not scanner and camera is None:
        camera = default_camera(width, height)
    layout = _draw_layout(family, seed)
    return observe(layout, camera, (height, width), options, family=family, seed=seed)


def default_camera(width: int, height: int) -> PinholeCamera:
    """Kinect's f = 525 px at 640 px width, scaled to `width`, with the principal point in the middle."""
    focal = 525.0 * width / 640
    return PinholeCamera(focal, focal, (width - 1) / 2, (height - 1) / 2)


def _stream(family: str, seed: int, name: str) -> np.random.Generator:
    """The generator of one effect: independent of all other effects, families and seeds."""
    return np.random.default_rng([seed, *f"{family}/{name}".encode()])


def _draw_layout(family: str, seed: int) -> Layout:
    """The first layout of the seed with an acceptable number of regions.

    It is judged at 160 x 120, whatever the size of the image, so that all sizes show the same scene.
    """
    rng = _stream(family, seed, "layout")
    shape = (120, 160)
    for _ in range(200):
        layout = BUILDERS[family](rng)
        camera = None if family in SCANNER_FAMILIES else default_camera(shape[1], shape[0])
        labels = _Rendering(layout, camera, shape).labels
        areas = np.bincount(labels.ravel())[1:]
        if REGIONS[0] <= np.count_nonzero(areas >= AREA_SHARE * labels.size) <= REGIONS[1]:
            return layout
    raise AssertionError(f"no layout of family {family!r}, seed {seed}, has {REGIONS[0]}-{REGIONS[1]} regions")


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


class _Rendering:
    """The truth of one layout from one pose: geometry, paint and labels, before any light or noise."""

    def __init__(self, layout: Layout, camera: PinholeCamera | None, shape: tuple[int, int]) -> None:
        self.layout, self.shape = layout, shape
        start, self.direction = _rays(layout, camera, shape)
        self.start = start
        world_start = layout.position + start @ layout.rotation
        world_direction = self.direction @ layout.rotation
        hits = cast(layout.solids, world_start, world_direction)
        too_far = hits.t > MAX_RANGE_M
        self.hits = Hits(
            np.where(too_far, np.inf, hits.t), np.where(too_far, -1, hits.solid), np.where(too_far, -1, hits.face)
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


def _choose_textures(solids: list[Solid], rng: np.random.Generator, share: float) -> dict:
    """Textures for a share of all faces, drawn for every face in turn so that the choice does not hang on the view."""
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


def observe(
    layout: Layout,
    camera: PinholeCamera | None,
    shape: tuple[int, int],
    options: SensorOptions,
    *,
    family: str,
    seed: int,
    shot: int = 0,
) -> SyntheticScene:
    """Let the sensor look at a layout; `shot` numbers the frames of a sequence (each has its own noise)."""

    def stream(name: str) -> np.random.Generator:
        return _stream(family, seed, f"{name}/{shot}" if shot else name)

    scene = _Rendering(layout, camera, shape)
    textured = options.texture or (0.5 if options.structured_light else 0.0)
    albedo = scene.color(_stream(family, seed, "texture"), textured)
    if options.shading or options.structured_light:
        albedo = albedo * _lamp(scene, _stream(family, seed, "light"))[:, None]
    clean_color = albedo.reshape(*shape, 3)
    depth_m, flying, shadow = scene.depth_m, np.zeros(shape, bool), np.zeros(shape, bool)
    if options.structured_light:
        depth_m, flying = sensor.flying_pixels(stream("flying"), depth_m)
        shadow = _projector_shadow(scene)
    noise = _range_noise(layout, camera, options)
    measured, points = _measure(scene, depth_m, camera, noise, stream("range"))
    outlier_depth, hit = sensor.impulse_range(stream("range outliers"), measured, options.outliers)
    dropped = np.isfinite(measured) & (shadow | (stream("dropout").random(shape) < options.dropout))
    points = np.where(hit[..., None], _replace_depth(scene, points, outlier_depth, camera), points)
    points[dropped] = np.nan
    color = sensor.digitise_color(stream("color"), clean_color, options.color_noise)
    color, color_hit = sensor.impulse_color(stream("color outliers"), color, options.outliers)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = layout.rotation.T, layout.position
    slope = 1.0 if camera is None else scene.depth_m**2
    return SyntheticScene(
        frame=RangeColorFrame(points.astype(np.float32), np.clip(np.round(color), 0, 255).astype(np.uint8), camera),
        labels=scene.labels,
        surface_labels=scene.surface_labels,
        object_labels=scene.object_labels,
        clean_points=scene.points(scene.depth_m),
        clean_color=np.clip(clean_color, 0, 255).astype(np.float32),
        normals=(scene.normals @ layout.rotation.T).reshape(*shape, 3).astype(np.float32),
        range_outliers=(hit | flying) & ~dropped,
        color_outliers=color_hit,
        dropped=dropped,
        sigma_range=np.where(np.isfinite(scene.depth_m), noise.total * slope, np.nan).astype(np.float32),
        family=family,
        seed=seed,
        pose=pose,
    )


def _range_noise(layout: Layout, camera: PinholeCamera | None, options: SensorOptions) -> sensor.RangeNoise:
    sigma, step = layout.sigma * options.noise, 0.0
    correlation_px = options.correlation_px or (1.5 if options.structured_light else 0.0)
    if camera is not None:
        quantization = options.quantization or (0.125 if options.structured_light else 0.0)
        step = quantization / (camera.fx * BASELINE_M)
    return sensor.RangeNoise(sigma, step, correlation_px)


def _measure(
    scene: _Rendering, depth_m: Array, camera: PinholeCamera | None, noise: sensor.RangeNoise, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Noisy depth (H, W) and points (H, W, 3)."""
    if camera is not None:
        with np.errstate(divide="ignore"):
            measured = 1.0 / np.maximum(sensor.disturb(rng, 1.0 / depth_m, noise), 1e-2)
        return measured, scene.points(measured)
    measured = sensor.disturb(rng, depth_m, noise)
    points = scene.points(measured)
    points[..., :2] += sensor.LATERAL_NOISE * noise.sigma * rng.normal(size=(*scene.shape, 2))
    return measured, points


def _replace_depth(scene: _Rendering, points: Array, depth_m: Array, camera: PinholeCamera | None) -> Array:
    if camera is not None:
        return scene.points(depth_m)
    return np.concatenate([points[..., :2], depth_m[..., None]], axis=-1)


def _visible(scene: _Rendering) -> NDArray[np.bool_]:
    return np.isfinite(scene.hits.t)


def _lamp(scene: _Rendering, rng: np.random.Generator) -> Array:
    """Factor on the colour of every ray (N,) from a lamp within half a metre (scanners: a quarter) of the sensor."""
    reach = 0.25 if scene.layout.image_height_m is not None else 0.5
    position = scene.layout.position + rng.uniform(-reach, reach, 3) @ np.diag([1.0, 0.3, 1.0])
    factor, seen = np.ones(len(scene.hits.t)), _visible(scene)
    factor[seen] = sensor.light(scene.world_points[seen], scene.normals[seen], position, ambient=0.35)
    return factor


def _projector_shadow(scene: _Rendering) -> NDArray[np.bool_]:
    """Pixels (H, W) that a projector one baseline to the right of the camera cannot reach."""
    projector = scene.layout.position + BASELINE_M * scene.layout.rotation[0]
    shadow, seen = np.zeros(len(scene.hits.t), bool), _visible(scene)
    shadow[seen] = occluded(scene.layout.solids, scene.world_points[seen], projector)
    return shadow.reshape(scene.shape)
