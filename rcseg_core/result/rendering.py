"""The image that the parameters stand for (eq. 1-2): the model of each pixel's region, in sensor units.

A polynomial in x and y is one in x alone along a row, so its coefficients there are worked out once for each
run of a label, and a pixel costs as many products as its model has degrees.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.compute.parallel import BANDS, over_bands
from rcseg_core.frame import PinholeCamera
from rcseg_core.models.polynomials import Models, along_row
from rcseg_core.signal.signals import Signals
from rcseg_core.signal.units import UNIT_PX


@bare
def _values(line, degree, start, center, size, shift, out):  # type: ignore[no-untyped-def]
    """out (n,): one channel of columns from start on, in sensor units; planes and quadrics by loops that the
    compiler can do several columns at a time."""
    if degree == 1:
        a0, a1 = line[0], line[1]
        for i in range(out.size):
            out[i] = ((start + i - center) / UNIT_PX * a1 + a0) * size + shift
    elif degree == 2:
        a0, a1, a2 = line[0], line[1], line[2]
        for i in range(out.size):
            x = (start + i - center) / UNIT_PX
            out[i] = ((x * a2 + a1) * x + a0) * size + shift
    else:
        for i in range(out.size):
            x = (start + i - center) / UNIT_PX
            value = 0.0
            for a in range(degree, -1, -1):
                value = value * x + line[a]
            out[i] = value * size + shift


@bare
def _put_colors(red, green, blue, out):  # type: ignore[no-untyped-def]
    for i in range(red.size):
        out[i, 0] = np.uint8(min(max(np.rint(red[i]), 0.0), 255.0))
        out[i, 1] = np.uint8(min(max(np.rint(green[i]), 0.0), 255.0))
        out[i, 2] = np.uint8(min(max(np.rint(blue[i]), 0.0), 255.0))


@bare
def _put_points(inverse, across, down, out):  # type: ignore[no-untyped-def]
    """Points (n, 3) of inverse depths (n,), which become depths; across (n,), down: x and y over depth."""
    for i in range(inverse.size):
        inverse[i] = 1.0 / inverse[i] if inverse[i] > 0.0 else np.nan
    for i in range(inverse.size):
        depth = inverse[i]
        out[i, 0] = across[i] * depth
        out[i, 1] = down * depth
        out[i, 2] = depth


@bare
def _render(models, labels, n_range, scale, offset, lens, across, first, last, line, values, points, color):  # type: ignore[no-untyped-def]
    """Fill rows first..last-1 of points and color, run by run of a label.

    lens : (fx, fy, cx, cy) where range channel 0 is inverse depth, else fx = 0; across : (W,) x over depth
    line : (C, D + 1) scratch; values : (C, W) scratch
    """
    width = labels.shape[1]
    for row in range(first, last):
        end = 0
        while end < width:
            start = end
            k = labels[row, start]
            while end < width and labels[row, end] == k:
                end += 1
            if k <= 0:
                points[row, start:end] = np.nan
                color[row, start:end] = 0
                continue
            along_row(models, k, row, n_range, line)
            center = models.center[k, 0]
            for c in range(line.shape[0]):
                degree = models.degree[k, 0 if c < n_range else 1]
                _values(line[c], degree, start, center, scale[c], offset[c], values[c, start:end])
            red, green, blue = values[n_range], values[n_range + 1], values[n_range + 2]
            _put_colors(red[start:end], green[start:end], blue[start:end], color[row, start:end])
            if lens[0] == 0.0:
                for col in range(start, end):
                    for c in range(3):
                        points[row, col, c] = values[c, col]
                continue
            down = (row - lens[3]) / lens[1]
            _put_points(values[0, start:end], across[start:end], down, points[row, start:end])


def render(
    models: Models, labels: NDArray[np.int32], signals: Signals, camera: PinholeCamera | None
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Points and colours of every pixel's model.

    Parameters
    ----------
    models : of regions 1..N, whitened by `signals`
    labels : (H, W) int32, 0 unlabelled
    camera : needed where the range signal is inverse depth

    Returns
    -------
    points : (H, W, 3) float32, m; NaN where unlabelled or where the model lies behind the camera
    color : (H, W, 3) uint8, clipped to 0..255; 0 where unlabelled
    """
    channels = signals.scale.size
    lens = np.zeros(4)
    if signals.inverse_depth:
        assert camera is not None
        lens[:] = camera.fx, camera.fy, camera.cx, camera.cy
    across = (np.arange(labels.shape[1]) - lens[2]) / (lens[0] or 1.0)
    points = np.empty((*labels.shape, 3), np.float32)
    color = np.empty((*labels.shape, 3), np.uint8)
    line = np.empty((BANDS, channels, models.coef.shape[2]))
    values = np.empty((BANDS, channels, labels.shape[1]))

    def render_band(i: int, first: int, last: int) -> None:
        _render(
            models, labels, signals.n_range, signals.scale, signals.offset, lens, across, first, last,
            line[i], values[i], points, color,
        )  # fmt: skip

    over_bands(labels.shape[0], render_band)
    return points, color
