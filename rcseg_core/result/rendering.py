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
from rcseg_core.models.polynomials import Models
from rcseg_core.signal.signals import Signals
from rcseg_core.signal.units import UNIT_PX


@bare
def _along_row(models, k, row, n_range, line):  # type: ignore[no-untyped-def]
    """line[c, a]: coefficient of x^a of channel c of region k in a row."""
    y = (row - models.center[k, 1]) / UNIT_PX
    for c in range(line.shape[0]):
        degree = models.degree[k, 0 if c < n_range else 1]
        for a in range(degree + 1):
            part = 0.0
            for b in range(degree, -1, -1):
                part = part * y + models.coef[k, c, a, b]
            line[c, a] = part


@bare
def _values(models, k, n_range, scale, offset, line, start, end, values):  # type: ignore[no-untyped-def]
    """values[c, col] of columns start..end-1 of one row, in sensor units; planes and quadrics by loops that
    the compiler can do several columns at a time."""
    center = models.center[k, 0]
    for c in range(line.shape[0]):
        degree = models.degree[k, 0 if c < n_range else 1]
        size, shift = scale[c], offset[c]
        if degree == 1:
            a0, a1 = line[c, 0], line[c, 1]
            for col in range(start, end):
                values[c, col] = ((col - center) / UNIT_PX * a1 + a0) * size + shift
        elif degree == 2:
            a0, a1, a2 = line[c, 0], line[c, 1], line[c, 2]
            for col in range(start, end):
                x = (col - center) / UNIT_PX
                values[c, col] = ((x * a2 + a1) * x + a0) * size + shift
        else:
            for col in range(start, end):
                x = (col - center) / UNIT_PX
                value = 0.0
                for a in range(degree, -1, -1):
                    value = value * x + line[c, a]
                values[c, col] = value * size + shift


@bare
def _render(models, labels, n_range, scale, offset, lens, first, last, line, values, points, color):  # type: ignore[no-untyped-def]
    """Fill rows first..last-1 of points and color, run by run of a label.

    lens : (fx, fy, cx, cy) where range channel 0 is inverse depth, else fx = 0
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
            _along_row(models, k, row, n_range, line)
            _values(models, k, n_range, scale, offset, line, start, end, values)
            for col in range(start, end):
                for c in range(3):
                    color[row, col, c] = np.uint8(min(max(np.rint(values[n_range + c, col]), 0.0), 255.0))
            if lens[0] == 0.0:
                for col in range(start, end):
                    for c in range(3):
                        points[row, col, c] = values[c, col]
                continue
            y = (row - lens[3]) / lens[1]
            for col in range(start, end):
                value = values[0, col]
                depth = 1.0 / value if value > 0.0 else np.nan
                points[row, col, 0] = (col - lens[2]) / lens[0] * depth
                points[row, col, 1] = y * depth
                points[row, col, 2] = depth


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
    points = np.empty((*labels.shape, 3), np.float32)
    color = np.empty((*labels.shape, 3), np.uint8)
    line = np.empty((BANDS, channels, models.coef.shape[2]))
    values = np.empty((BANDS, channels, labels.shape[1]))

    def render_band(i: int, first: int, last: int) -> None:
        _render(
            models, labels, signals.n_range, signals.scale, signals.offset, lens, first, last, line[i],
            values[i], points, color,
        )  # fmt: skip

    over_bands(labels.shape[0], render_band)
    return points, color
