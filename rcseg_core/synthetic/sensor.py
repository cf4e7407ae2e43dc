"""What a sensor does to the truth: noise, quantisation, shadow of the projector, flying pixels, outliers,
drop-out.

Range noise acts along the ray on the sensor's own signal: on inverse depth (disparity) for cameras, on z
for scanner grids. Every effect draws from its own generator, so that switching one on leaves the others as
they were.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_core.errors import InputError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LATERAL_NOISE = 0.25
"""Noise of a scanner's x and y as a share of its range noise."""


BASELINE_M = 0.075
"""Of camera and projector: Kinect v1."""


_MOST = {
    "outliers": 1.0,
    "dropout": 1.0,
    "texture": 1.0,
    "noise": 1e3,
    "color_noise": 255.0,
    "quantization": 64.0,
    "correlation_px": 100.0,
}


@dataclass(frozen=True)
class SensorOptions:
    """How a scene is seen; `make_scene` says what each field means."""

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
        for name, high in _MOST.items():
            value = getattr(self, name)
            if not 0 <= value <= high:
                raise InputError(f"make_scene: {name} is {value}; it must lie within 0 and {high:g}")
        if not has_camera and (self.quantization or self.structured_light):
            option = "structured_light" if self.structured_light else "quantization"
            raise InputError(
                f"make_scene: {option} needs a camera and family {family!r} is a scanner grid; "
                "take room, blocks or curved"
            )


@dataclass(frozen=True)
class RangeNoise:
    """sigma in 1/m (camera) or m (scanner); `step` the quantum of the same signal, 0 for none;
    `correlation_px`."""

    sigma: float
    step: float
    correlation_px: float

    @property
    def total(self) -> float:
        """Sigma with the quantisation's uniform error (step / sqrt 12) included."""
        return float(np.hypot(self.sigma, self.step / np.sqrt(12.0)))


def white_noise(rng: np.random.Generator, shape: tuple[int, int], correlation_px: float) -> Array:
    """Gaussian noise of unit variance (H, W), smoothed by a Gaussian of `correlation_px` (0: white)."""
    if correlation_px <= 0:
        return rng.normal(size=shape)
    half = int(np.ceil(4 * correlation_px))
    kernel = np.exp(-0.5 * (np.arange(-half, half + 1) / correlation_px) ** 2)
    # White noise through a kernel k has variance sum k^2 on each axis: divide it out and the variance stays
    # 1.
    kernel /= np.sqrt(np.sum(kernel**2))
    padded = rng.normal(size=(shape[0] + 2 * half, shape[1] + 2 * half))
    smooth = cv2.sepFilter2D(padded, cv2.CV_64F, kernel, kernel)
    return np.asarray(smooth[half : half + shape[0], half : half + shape[1]])


def disturb(rng: np.random.Generator, signal: Array, noise: RangeNoise) -> Array:
    """`signal` (H, W) with noise and then quantisation."""
    noisy = signal + noise.sigma * white_noise(rng, (signal.shape[0], signal.shape[1]), noise.correlation_px)
    return np.round(noisy / noise.step) * noise.step if noise.step > 0 else noisy


def flying_pixels(
    rng: np.random.Generator, depth_m: Array, *, share: float = 0.6, least_step: float = 0.03
) -> tuple[Array, Mask]:
    """Mix depths at depth edges.

    A pixel within one pixel of a step of more than `least_step` of its depth takes, with probability
    `share`, a random mixture of the nearest and the farthest disparity of its 3 x 3 neighbourhood. Returns
    depth (H, W) and the mask.
    """
    known = np.where(np.isfinite(depth_m), depth_m, 0.0).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    far = cv2.dilate(known, kernel).astype(float)
    near = cv2.erode(np.where(known > 0, known, np.float32(1e6)), kernel).astype(float)
    step = np.isfinite(depth_m) & (far - near > least_step * near)
    flying = step & (rng.random(depth_m.shape) < share)
    weight = rng.uniform(0.1, 0.9, depth_m.shape)
    with np.errstate(divide="ignore"):
        mixed = 1.0 / (weight / near + (1 - weight) / far)
    return np.where(flying, mixed, depth_m), flying


def impulse_range(rng: np.random.Generator, depth_m: Array, fraction: float) -> tuple[Array, Mask]:
    """Replace a share of the measured depths (H, W) by uniform ones within the scene's range of depth."""
    hit = (rng.random(depth_m.shape) < fraction) & np.isfinite(depth_m)
    low, high = np.nanmin(depth_m), np.nanmax(depth_m)
    return np.where(hit, rng.uniform(low, high, depth_m.shape), depth_m), hit


def impulse_color(rng: np.random.Generator, color: Array, fraction: float) -> tuple[Array, Mask]:
    """Replace a share of the pixels of `color` (H, W, 3) by random colours."""
    hit = rng.random(color.shape[:2]) < fraction
    return np.where(hit[..., None], rng.uniform(0, 255, color.shape), color), hit


def digitise_color(rng: np.random.Generator, color: Array, sigma: float) -> Array:
    """Colour with Gaussian noise of `sigma` levels, still float: (H, W, 3)."""
    return color + sigma * rng.normal(size=color.shape)


def light(
    points: Array,
    normals: Array,
    position: Array,
    *,
    ambient: float,
    seen: Callable[[Array], Mask] | None = None,
) -> Array:
    """Lambertian light of one lamp with 1/r^2 falloff over an ambient level: factor on the albedo (N,), at
    most 1.

    The lamp is as bright as to give 1 at the nearest tenth of the points. `seen` says which points it
    reaches.
    """
    towards = position - points
    distance = np.linalg.norm(towards, axis=1)
    lambert = np.maximum(np.einsum("ij,ij->i", towards, normals) / distance, 0.0)
    falloff = np.minimum((np.percentile(distance, 10) / distance) ** 2, 1.0) if len(points) else distance
    direct = lambert * falloff
    if seen is not None:
        direct = direct * seen(points)
    return np.asarray(ambient + (1 - ambient) * direct)
