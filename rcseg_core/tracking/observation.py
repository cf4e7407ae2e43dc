"""What tracking looks at in a frame: points of its models, a few for each square of pixels.

Names hang on places, so the surfaces of a frame are carried into the next by points on their own models,
which are free of noise. Regions that are too small for the squares have points of their own.
"""

from __future__ import annotations

from typing import Any, NamedTuple

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
    squares : (N + 1,) float64, squares of each region
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
    squares: Array
    group: dict[str, NDArray[np.int64]]
    images: dict[str, NDArray[np.int32]]
    colors: dict[str, Array]
    shapes: list[Local | None]

    def count(self, kind: str) -> int:
        """Number of labels of a kind."""
        return len(self.colors[kind]) - 1

    def squares_of(self, kind: str) -> Array:
        """(M + 1,) squares of each label of a kind."""
        squares: NDArray[Any] = np.bincount(self.group[kind], self.squares, self.count(kind) + 1)
        return squares

    def pick(
        self, kind: str, row: NDArray[np.int64], pose: Array, points: Array, pixels: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """Some points of some labels of a kind, evenly over all that they have.

        Parameters
        ----------
        row : (M + 1,) row of `points` (n, s, 3) and `pixels` (n, s, 2) to be filled; -1 for other labels
        pose : (4, 4) takes points to the frame that they are kept in

        Returns
        -------
        (M + 1,) how many points each label has there, at most s
        """
        region, group = self.points.region, self.group[kind]
        of_region = np.bincount(region, minlength=len(group))
        total = np.bincount(group, of_region, self.count(kind) + 1).astype(np.int64)
        every = np.maximum(-(-total // points.shape[1]), 1)
        _pick(
            region, group, row, every, self.points.xyz, self.points.pixel, pose, np.zeros_like(total), points,
            pixels,
        )  # fmt: skip
        return np.asarray(-(-total // every))


@bare
def _choose(labels, sizes, boxes, step, pixel, weight, region):  # type: ignore[no-untyped-def]
    """Fill pixels of all regions, their weights and labels; their number."""
    height, width = labels.shape
    square = step * step
    n = 0
    for row in range(step // 2, height, step):
        for col in range(step // 2, width, step):
            k = labels[row, col]
            if k > 0 and sizes[k] >= LEAST_POINTS * square:
                pixel[n, 0], pixel[n, 1] = row, col
                weight[n] = 1.0
                region[n] = k
                n += 1
    for k in range(1, sizes.shape[0]):
        if sizes[k] == 0 or sizes[k] >= LEAST_POINTS * square:
            continue
        every = max(sizes[k] // LEAST_POINTS, 1)
        seen = 0
        for row in range(boxes[k, 0], boxes[k, 2] + 1):
            for col in range(boxes[k, 1], boxes[k, 3] + 1):
                if labels[row, col] == k:
                    if seen % every == every // 2 and n < region.shape[0]:
                        pixel[n, 0], pixel[n, 1] = row, col
                        weight[n] = np.float64(every) / square
                        region[n] = k
                        n += 1
                    seen += 1
    return n


@bare
def _place(models, lens, scale, offset, count, xyz, pixel, weight, region):  # type: ignore[no-untyped-def]
    """Points of the models at the first `count` pixels; those whose model lies behind the camera are left
    out, and the others move up. Their number."""
    n = 0
    for i in range(count):
        row, col, k = pixel[i, 0], pixel[i, 1], region[i]
        if lens[0] > 0.0:
            w = predict(models, k, row, col, 0, 0) * scale[0] + offset[0]
            if not w > 1e-6:
                continue
            xyz[n, 0] = (col - lens[2]) / lens[0] / w
            xyz[n, 1] = (row - lens[3]) / lens[1] / w
            xyz[n, 2] = 1.0 / w
        else:
            for c in range(3):
                xyz[n, c] = predict(models, k, row, col, 0, c) * scale[c] + offset[c]
        pixel[n, 0], pixel[n, 1] = row, col
        weight[n], region[n] = weight[i], k
        n += 1
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
    labels, signals, regions = result.labels, result.signals, result.regions
    surfaces, objects = result.surfaces, world.objects
    count = len(regions)
    sizes, of_surface = np.zeros(count + 1, np.int64), np.zeros(count + 1, np.int64)
    sizes[1:] = [region.pixel_count for region in regions]
    of_surface[1:] = [region.surface for region in regions]
    boxes = np.array([(0, 0, 0, 0), *(region.box for region in regions)], np.int64)
    of_object = np.zeros(len(surfaces) + 1, np.int64)
    for thing in objects:
        for surface in thing.surfaces:
            of_object[surface] = thing.label
    group = {"surface": of_surface, "region": np.arange(count + 1), "object": of_object[of_surface]}
    images = {
        "surface": result.surface_labels,
        "region": labels,
        "object": world.object_labels if len(objects) else np.zeros_like(labels),
    }
    lens, models = lens_of(result), result.models
    most = (-(-labels.shape[0] // step)) * (-(-labels.shape[1] // step)) + (LEAST_POINTS * 2) * (count + 1)
    points = Points(
        np.empty((most, 3)), np.empty((most, 2), np.int64), np.empty(most), np.empty(most, np.int64)
    )
    n = _choose(labels, sizes, boxes, step, points.pixel, points.weight, points.region)
    n = _place(models, lens, signals.scale, signals.offset, n, *points)
    points = points.first(n)
    first = signals.n_range
    color = models.coef[: count + 1, first : first + 3, 0, 0] * signals.scale[first:] + signals.offset[first:]
    counts = {"surface": len(surfaces), "region": count, "object": len(objects)}
    return Observation(
        labels, lens, models, signals.scale, signals.offset, points,
        np.bincount(points.region, points.weight, count + 1).astype(np.float64, copy=False), group, images,
        {kind: _mean_color(color, sizes, group[kind], counts[kind]) for kind in group},
        [None, *(surface.local for surface in surfaces)],
    )  # fmt: skip


@bare
def _pick(region, group, row, every, xyz, pixel, pose, seen, points, pixels):  # type: ignore[no-untyped-def]
    """See `Observation.pick`; seen (M + 1,) are zeros."""
    for i in range(region.shape[0]):
        label = group[region[i]]
        r = row[label]
        if r < 0:
            continue
        if seen[label] % every[label] == 0:
            k = seen[label] // every[label]
            for a in range(3):
                points[r, k, a] = (
                    pose[a, 0] * xyz[i, 0] + pose[a, 1] * xyz[i, 1] + pose[a, 2] * xyz[i, 2] + pose[a, 3]
                )
            pixels[r, k, 0] = pixel[i, 0]
            pixels[r, k, 1] = pixel[i, 1]
        seen[label] += 1


def _mean_color(color: Array, sizes: NDArray[np.int64], group: NDArray[np.int64], count: int) -> Array:
    """(count + 1, 3) mean of the colours of regions over the groups they form; NaN where there is none."""
    mean, total = np.zeros((count + 1, 3)), np.zeros(count + 1)
    _average(color, sizes, group, mean, total)
    return mean


@bare
def _average(color, sizes, group, mean, total):  # type: ignore[no-untyped-def]
    """See `_mean_color`; mean and total are zeros."""
    for k in range(color.shape[0]):
        total[group[k]] += sizes[k]
        for c in range(3):
            mean[group[k], c] += color[k, c] * sizes[k]
    for label in range(mean.shape[0]):
        for c in range(3):
            mean[label, c] = mean[label, c] / total[label] if label and total[label] > 0.0 else np.nan
