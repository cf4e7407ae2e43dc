"""What tracking looks at in a frame: points of its models, a few for each square of pixels.

Names hang on places, so the surfaces of a frame are carried into the next by points on their own models,
which are free of noise. Regions that are too small for the squares have points of their own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.models.polynomials import Models, predict
from rcseg_core.result.segmentation import Segmentation
from rcseg_core.tracking.fusion import Local
from rcseg_core.world import World

Array = NDArray[np.float64]
#: Points of a region that has less than so many squares.
LEAST_POINTS = 4


class Points(NamedTuple):
    """Points of one frame.

    xyz : (n, 3) float64, m, in the sensor's frame
    pixel : (n, 2) int64, row, column
    weight : (n,) float64, squares that one stands for
    region : (n,) int64, label
    """

    xyz: Array
    pixel: NDArray[np.int64]
    weight: Array
    region: NDArray[np.int64]

    def first(self, count: int) -> Points:
        """The first of them."""
        return Points(self.xyz[:count], self.pixel[:count], self.weight[:count], self.region[:count])


class Observation(NamedTuple):
    """One frame as tracking sees it.

    labels : (H, W) int32, regions
    lens : (4,) float64, fx, fy, cx, cy; fx = 0 without a camera
    models, scale, offset : the models of regions and what turns their values into sensor units
    points : Points
    group : by kind, (N + 1,) int64, label of the surface, region or object that a region belongs to
    images : by kind, (H, W) int32
    colors : by kind, (M + 1, 3) float64, levels; NaN for index 0
    shapes : (M + 1,) minimal local form of each surface or None
    """

    labels: NDArray[np.int32]
    lens: Array
    models: Models
    scale: Array
    offset: Array
    points: Points
    group: dict[str, NDArray[np.int64]]
    images: dict[str, NDArray[np.int32]]
    colors: dict[str, Array]
    shapes: list[Local | None]

    def count(self, kind: str) -> int:
        """Number of labels of a kind."""
        return len(self.colors[kind]) - 1


@bare
def _put(models, k, row, col, lens, scale, offset, weight, xyz, pixel, weights, region, n):  # type: ignore[no-untyped-def]
    """Point n of region k; n + 1, or n where its model lies behind the camera."""
    if lens[0] > 0.0:
        w = predict(models, k, row, col, 0, 0) * scale[0] + offset[0]
        if not w > 1e-6:
            return n
        xyz[n, 0] = (col - lens[2]) / lens[0] / w
        xyz[n, 1] = (row - lens[3]) / lens[1] / w
        xyz[n, 2] = 1.0 / w
    else:
        for c in range(3):
            xyz[n, c] = predict(models, k, row, col, 0, c) * scale[c] + offset[c]
    pixel[n, 0] = row
    pixel[n, 1] = col
    weights[n] = weight
    region[n] = k
    return n + 1


@bare
def _sample(labels, sizes, boxes, step, models, lens, scale, offset, xyz, pixel, weights, region):  # type: ignore[no-untyped-def]
    """Fill points of all regions; their number."""
    height, width = labels.shape
    square = step * step
    n = 0
    for row in range(step // 2, height, step):
        for col in range(step // 2, width, step):
            k = labels[row, col]
            if k > 0 and sizes[k] >= LEAST_POINTS * square:
                n = _put(models, k, row, col, lens, scale, offset, 1.0, xyz, pixel, weights, region, n)
    for k in range(1, sizes.shape[0]):
        if sizes[k] == 0 or sizes[k] >= LEAST_POINTS * square:
            continue
        every = max(sizes[k] // LEAST_POINTS, 1)
        weight = np.float64(every) / square
        seen = 0
        for row in range(boxes[k, 0], boxes[k, 2] + 1):
            for col in range(boxes[k, 1], boxes[k, 3] + 1):
                if labels[row, col] == k:
                    if seen % every == every // 2 and n < xyz.shape[0]:
                        n = _put(
                            models, k, row, col, lens, scale, offset, weight, xyz, pixel, weights, region, n
                        )
                    seen += 1
    return n


def lens_of(result: Segmentation) -> Array:
    """(4,) fx, fy, cx, cy; 0 where the models are not of inverse depth in a camera."""
    camera = result.camera
    if not result.signals.inverse_depth or camera is None:
        return np.zeros(4)
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy])


def observe(result: Segmentation, world: World, step: int) -> Observation:
    """The observation of a result.

    Parameters
    ----------
    world : whose objects are followed
    step : side of the squares, px
    """
    labels, signals = result.labels, result.signals
    regions = result.regions
    count = len(regions)
    boxes, sizes = np.zeros((count + 1, 4), np.int64), np.zeros(count + 1, np.int64)
    group = {kind: np.zeros(count + 1, np.int64) for kind in ("surface", "region", "object")}
    for k, region in enumerate(regions, start=1):
        boxes[k], sizes[k] = region.box, region.pixel_count
        group["surface"][k] = region.surface
    group["region"] = np.arange(count + 1)
    lens = lens_of(result)
    images = {"surface": result.surface_labels, "region": labels, "object": np.zeros_like(labels)}
    surfaces = result.surfaces
    objects = world.objects
    if len(objects):
        images["object"] = world.object_labels
        of_surface = np.zeros(len(surfaces) + 1, np.int64)
        for thing in objects:
            of_surface[list(thing.surfaces)] = thing.label
        group["object"] = of_surface[group["surface"]]
    most = (-(-labels.shape[0] // step)) * (-(-labels.shape[1] // step)) + (LEAST_POINTS * 2) * (count + 1)
    points = Points(
        np.empty((most, 3)), np.empty((most, 2), np.int64), np.empty(most), np.empty(most, np.int64)
    )
    models = result.models
    n = _sample(labels, sizes, boxes, step, models, lens, signals.scale, signals.offset, *points)
    first = signals.n_range
    color = models.coef[: count + 1, first : first + 3, 0, 0] * signals.scale[first:] + signals.offset[first:]
    counts = {"surface": len(surfaces), "region": count, "object": len(objects)}
    return Observation(
        labels, lens, models, signals.scale, signals.offset, points.first(n), group, images,
        {kind: _mean_color(color, sizes, group[kind], counts[kind]) for kind in group},
        [None, *(surface.local for surface in surfaces)],
    )  # fmt: skip


@bare
def pick(region, group, label, out):  # type: ignore[no-untyped-def]
    """Fill out with indices of points whose region is of a label, evenly over all of them; their number."""
    total = 0
    for i in range(region.shape[0]):
        if group[region[i]] == label:
            total += 1
    every = max(-(-total // out.shape[0]), 1)
    seen = 0
    for i in range(region.shape[0]):
        if group[region[i]] == label:
            if seen % every == 0:
                out[seen // every] = i
            seen += 1
    return -(-total // every)


def _mean_color(color: Array, sizes: NDArray[np.int64], group: NDArray[np.int64], count: int) -> Array:
    """(count + 1, 3) mean of the colours of regions over the groups they form; NaN where there is none."""
    total = np.stack([np.bincount(group, color[:, c] * sizes, count + 1) for c in range(3)], axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean: Array = total / np.bincount(group, sizes, count + 1)[:, None]
    mean[0] = np.nan
    return mean
