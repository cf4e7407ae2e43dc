"""Coarse to fine: segment the means of small squares of pixels, then let the borders follow the full image.

A square of r x r pixels has the noise of its mean, so that the same surfaces are told apart with 1 / r^2 of
the pixels. Where a square lies across a depth edge only its larger side is averaged. Labels come back at full
size, where border pixels choose between the models of the regions that meet; the models, patches and coarser
levels of the full image are computed when they are asked for.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.compute.parallel import over_bands
from rcseg_core.config import SegmenterConfig
from rcseg_core.frame import PinholeCamera, RangeColorFrame
from rcseg_core.models.polynomials import Models
from rcseg_core.pixels.absorption import refine
from rcseg_core.resampling.carrying import carried
from rcseg_core.result.segmentation import Segmentation
from rcseg_core.signal.signals import build_signals, measured_again

#: A smaller image is segmented as it is.
LEAST_SIDE_PX = 32
#: Points of one square belong together when their depths differ by less than this share of depth.
SAME_SIDE = 0.02


@bare
def _side(points, valid, row0, row1, col0, col1):  # type: ignore[no-untyped-def]
    """How many pixels of a square are near in depth to the one that most are near to, and its depth."""
    best = 0
    center = np.nan
    for row in range(row0, row1):
        for col in range(col0, col1):
            if not valid[row, col]:
                continue
            z = np.float64(points[row, col, 2])
            company = 0
            for r in range(row0, row1):
                for c in range(col0, col1):
                    company += valid[r, c] and abs(points[r, c, 2] - z) <= SAME_SIDE * abs(z)
            if company > best:
                best = company
                center = z
    return best, center


@bare
def _average(points, valid, color, step, inverse, first, last, out_points, out_color):  # type: ignore[no-untyped-def]
    """Means of squares of `step` pixels, rows first..last-1 of the output; NaN where no pixel is valid.

    inverse : the mean depth is that of the inverse depths, and x, y are left as NaN
    """
    height, width = valid.shape
    for i in range(first, last):
        for j in range(out_points.shape[1]):
            row1 = min((i + 1) * step, height)
            col1 = min((j + 1) * step, width)
            # the pixel with most company in depth stands for its side of the square
            best = 0
            center = np.nan
            least = np.inf
            most = -np.inf
            for row in range(i * step, row1):
                for col in range(j * step, col1):
                    if valid[row, col]:
                        center = np.float64(points[row, col, 2])
                        least = min(least, center)
                        most = max(most, center)
                        best += 1
            if best > 0 and most - least > SAME_SIDE * min(abs(least), abs(most)):
                best, center = _side(points, valid, i * step, row1, j * step, col1)
            x = y = z = red = green = blue = n = 0.0
            for row in range(i * step, row1):
                for col in range(j * step, col1):
                    if best > 0:
                        if not valid[row, col] or abs(points[row, col, 2] - center) > SAME_SIDE * abs(center):
                            continue
                        x += points[row, col, 0]
                        y += points[row, col, 1]
                        z += 1.0 / points[row, col, 2] if inverse else points[row, col, 2]
                    red += color[row, col, 0]
                    green += color[row, col, 1]
                    blue += color[row, col, 2]
                    n += 1.0
            out_color[i, j, 0] = np.uint8(red / n + 0.5)
            out_color[i, j, 1] = np.uint8(green / n + 0.5)
            out_color[i, j, 2] = np.uint8(blue / n + 0.5)
            if best > 0:
                out_points[i, j, 0] = x / n
                out_points[i, j, 1] = y / n
                out_points[i, j, 2] = n / z if inverse else z / n
            else:
                for k in range(3):
                    out_points[i, j, k] = np.nan


@lru_cache(maxsize=2)  # an image of rays is large, and a live calibration may never repeat
def _rays(camera: PinholeCamera, height: int, width: int) -> NDArray[np.float32]:
    return camera.rays(height, width)


@lru_cache(maxsize=8)
def unreduced(config: SegmenterConfig) -> SegmenterConfig:
    """What the small image is segmented with: its colour is normalised already, its pixels are larger."""
    changes: dict[str, float | str] = {"signal.reduction": 1, "reflectance.mode": "none"}
    if config.noise.range_correlation > 0:
        squares = config.noise.range_correlation / config.signal.reduction**2
        changes["noise.range_correlation"] = max(squares, 1.0)
    return config.replace(changes)


def reduced(frame: RangeColorFrame, color: NDArray[np.uint8], step: int) -> RangeColorFrame:
    """The frame of the means of squares of `step` pixels; the last ones of a row or column may be cut off.

    color : (H, W, 3) uint8, the frame's colour after the reflectance stage
    """
    height, width = -(-frame.height // step), -(-frame.width // step)
    points, means = np.empty((height, width, 3), np.float32), np.empty((height, width, 3), np.uint8)
    old = frame.camera
    over_bands(
        height,
        lambda _, a, b: _average(
            frame.points, frame.valid, color, step, old is not None, a, b, points, means
        ),
    )
    if old is None:
        return RangeColorFrame(points, means, None)
    half = (step - 1) / 2.0
    camera = PinholeCamera(old.fx / step, old.fy / step, (old.cx - half) / step, (old.cy - half) / step)
    points = _rays(camera, height, width) * points[..., 2:]
    return RangeColorFrame(points, means, camera)


@bare
def _repeat(image, flags, step, first, last, out):  # type: ignore[no-untyped-def]
    """out[row, col] = image[row // step, col // step], 0 on flagged pixels."""
    width = out.shape[1]
    for row in range(first, last):
        i = row // step
        col = 0
        for j in range(image.shape[1]):
            value = image[i, j]
            for _ in range(min(step, width - col)):
                out[row, col] = value if flags[row, col] == 0 else 0
                col += 1


def _enlarged(image: NDArray[Any], flags: NDArray[np.uint8], step: int) -> NDArray[Any]:
    """`image` with every pixel repeated; 0 where flagged."""
    out = np.empty(flags.shape, image.dtype)
    over_bands(len(out), lambda _, a, b: _repeat(image, flags, step, a, b, out))
    return out


def _full_models(models: Models, step: int, factor: NDArray[np.float64]) -> Models:
    """Models of the small image in the coordinates and units of the full one; factor : (C,) of the units."""
    low = models.coef.shape[-1]
    powers = np.arange(low)
    shrink = float(step) ** -(powers[:, None] + powers[None, :])
    center = models.center * step + (step - 1) / 2.0
    return models._replace(center=center, coef=models.coef * shrink / factor[:, None, None])


def at_full_size(
    frame: RangeColorFrame, color: NDArray[np.uint8], small: Segmentation, config: SegmenterConfig
) -> Segmentation:
    """The result of the reduced frame on all pixels of the frame itself.

    Parameters
    ----------
    color : (H, W, 3) uint8, the frame's colour after the reflectance stage
    small : Segmentation of ``reduced(frame, config.signal.reduction)``
    """
    start = time.perf_counter()
    step = config.signal.reduction
    # a pixel has the noise of a mean times the root of the independent pixels in it; noise that was stated is
    # that of a pixel already
    noise = small.noise
    range_factor = max(step / float(np.sqrt(noise.range_correlation)), 1.0)
    color_factor = max(step / float(np.sqrt(noise.color_correlation)), 1.0)
    if config.noise.range_model != "auto":
        range_factor = 1.0
    if config.noise.color_sigma > 0:
        color_factor = 1.0
    signals = measured_again(small.signals, frame, color, range_factor, color_factor)
    factor = signals.scale / small.signals.scale
    labels = _enlarged(small.labels, signals.flags, step)
    leaves = _enlarged(small.leaves, signals.flags, step)
    refine(signals, labels, leaves, _full_models(small.models, step, factor), config.absorption.refine_passes)

    edges = _enlarged(small.edges, signals.flags, step)
    range_leaves = None if small.range_leaves is None else _enlarged(small.range_leaves, signals.flags, step)
    whiten = partial(build_signals, frame, color, config)
    result = carried(small, frame, config, labels, leaves, range_leaves, edges, whiten)
    return replace(result, timings={**small.timings, "full size": time.perf_counter() - start})
