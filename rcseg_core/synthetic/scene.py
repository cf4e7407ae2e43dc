"""Scenes with exact truth: draw a layout, cast it, then let a sensor look at it.

The truth belongs to the scene, not to the measurement: pixels that the sensor lost or disturbed keep their
labels. The layout depends on the family and the seed alone; size, noise and all other options change only
how it is seen, and every option has its own random stream.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rcseg_core.errors import InputError
from rcseg_core.frame import PinholeCamera, RangeColorFrame

from . import sensor
from .geometry import occluded
from .layouts import BUILDERS, Layout
from .render import Labels, Rendering

Array = NDArray[np.float64]

FAMILIES: tuple[str, ...] = tuple(BUILDERS)
SCANNER_FAMILIES: tuple[str, ...] = ("billiard", "painting")
REGIONS = (5, 15)
"""Least and largest number of truth regions that matter; other layouts are drawn again."""
BACKGROUND = ("floor", "wall", "table")
"""Names of solids that are no objects."""
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
        Truth regions: surface x albedo, 4-connected components; 0 where the ray meets nothing. Printed
        texture and shading are no albedo. Pixels that are invalid or dropped in the frame keep their label.
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
    background : labels of `object_labels` that are no objects: floor, walls, table
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
    background: tuple[int, ...] = ()


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
        By default f = 525 px at 640 px width with the principal point in the middle; scanner families have
        none.
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
        A Kinect-like sensor: noise correlated over 1.5 px, 1/8 px disparity steps, projector shadow, flying
        pixels at depth edges, shading, and texture on half of the surfaces unless these are set already;
        cameras only.

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
    options = sensor.SensorOptions(
        noise,
        color_noise,
        outliers,
        dropout,
        quantization,
        correlation_px,
        shading,
        texture,
        structured_light,
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
        labels = Rendering(layout, camera, shape).labels
        areas = np.bincount(labels.ravel())[1:]
        if REGIONS[0] <= np.count_nonzero(areas >= AREA_SHARE * labels.size) <= REGIONS[1]:
            return layout
    raise AssertionError(
        f"no layout of family {family!r}, seed {seed}, has {REGIONS[0]}-{REGIONS[1]} regions"
    )


def observe(
    layout: Layout,
    camera: PinholeCamera | None,
    shape: tuple[int, int],
    options: sensor.SensorOptions,
    *,
    family: str,
    seed: int,
    shot: int = 0,
) -> SyntheticScene:
    """Let the sensor look at a layout; `shot` numbers the frames of a sequence (each has its own noise)."""

    def stream(name: str) -> np.random.Generator:
        return _stream(family, seed, f"{name}/{shot}" if shot else name)

    scene = Rendering(layout, camera, shape)
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
        frame=RangeColorFrame(
            points.astype(np.float32), np.clip(np.round(color), 0, 255).astype(np.uint8), camera
        ),
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
        background=tuple(i + 1 for i, solid in enumerate(layout.solids) if solid.name in BACKGROUND),
    )


def _range_noise(
    layout: Layout, camera: PinholeCamera | None, options: sensor.SensorOptions
) -> sensor.RangeNoise:
    sigma, step = layout.sigma * options.noise, 0.0
    correlation_px = options.correlation_px or (1.5 if options.structured_light else 0.0)
    if camera is not None:
        quantization = options.quantization or (0.125 if options.structured_light else 0.0)
        step = quantization / (camera.fx * sensor.BASELINE_M)
    return sensor.RangeNoise(sigma, step, correlation_px)


def _measure(
    scene: Rendering,
    depth_m: Array,
    camera: PinholeCamera | None,
    noise: sensor.RangeNoise,
    rng: np.random.Generator,
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


def _replace_depth(scene: Rendering, points: Array, depth_m: Array, camera: PinholeCamera | None) -> Array:
    if camera is not None:
        return scene.points(depth_m)
    return np.concatenate([points[..., :2], depth_m[..., None]], axis=-1)


def _lamp(scene: Rendering, rng: np.random.Generator) -> Array:
    """Factor on the colour of every ray (N,) from a lamp within half a metre (scanners: a quarter) of the
    sensor."""
    reach = 0.25 if scene.layout.image_height_m is not None else 0.5
    position = scene.layout.position + rng.uniform(-reach, reach, 3) @ np.diag([1.0, 0.3, 1.0])
    factor, seen = np.ones(len(scene.hits.t)), scene.seen
    factor[seen] = sensor.light(scene.world_points[seen], scene.normals[seen], position, ambient=0.35)
    return factor


def _projector_shadow(scene: Rendering) -> NDArray[np.bool_]:
    """Pixels (H, W) that a projector one baseline to the right of the camera cannot reach."""
    projector = scene.layout.position + sensor.BASELINE_M * scene.layout.rotation[0]
    shadow, seen = np.zeros(len(scene.hits.t), bool), scene.seen
    shadow[seen] = occluded(scene.layout.solids, scene.world_points[seen], projector)
    return shadow.reshape(scene.shape)
