"""Rendering (eq. 1-2) against direct sums: every pixel is its region's polynomials, in sensor units."""

import dataclasses

import numpy as np
import pytest
from crafted import crafted_signals
from oracle.naive_growth import predict as direct

from rcseg_core import PinholeCamera
from rcseg_core.models.polynomials import Models
from rcseg_core.result.rendering import render
from rcseg_core.signal.units import UNIT_PX

SHAPE = (20, 26)
CAMERA = PinholeCamera(40.0, 42.0, 12.3, 9.1)
DEGREES = np.array([(-1, -1), (1, 1), (2, 1), (4, 2)])


def case(inverse_depth, seed=0):
    """Three regions of several degrees whose labels alternate along rows; some pixels in none."""
    rng = np.random.default_rng(seed)
    n_range = 1 if inverse_depth else 3
    labels = rng.integers(0, 4, SHAPE).astype(np.int32)
    labels[5:12, 3:20] = 3
    coef = np.zeros((4, n_range + 3, 5, 5))
    for k in range(1, 4):
        for c in range(n_range + 3):
            top = DEGREES[k, int(c >= n_range)] + 1
            coef[k, c, :top, :top] = rng.normal(size=(top, top))
    coef[1, 0, 0, 0] = -1.0
    models = Models(rng.uniform(0, 20, (4, 2)), DEGREES, coef)
    signals = dataclasses.replace(
        crafted_signals(rng.normal(size=(*SHAPE, n_range + 3)), n_range),
        scale=rng.uniform(0.5, 2, n_range + 3) * np.r_[np.full(n_range, 0.1), np.full(3, 60.0)],
        offset=np.r_[np.full(n_range, 0.02), np.full(3, 120.0)],
        inverse_depth=inverse_depth,
    )
    return labels, models, signals


@pytest.mark.parametrize("inverse_depth", [True, False])
def test_pixels_are_the_sums_of_their_terms(inverse_depth):
    labels, models, signals = case(inverse_depth)
    n_range = signals.n_range
    points, color = render(models, labels, signals, CAMERA if inverse_depth else None)
    assert points.dtype == np.float32 and color.dtype == np.uint8
    behind = clipped = 0
    for (row, col), k in np.ndenumerate(labels):
        if k == 0:
            assert np.isnan(points[row, col]).all() and not color[row, col].any()
            continue
        x, y = (col - models.center[k, 0]) / UNIT_PX, (row - models.center[k, 1]) / UNIT_PX
        values = [
            direct(models.coef[k, c], x, y) * signals.scale[c] + signals.offset[c] for c in range(n_range + 3)
        ]
        if inverse_depth and values[0] <= 0:
            behind += 1
            assert np.isnan(points[row, col]).all()
        elif inverse_depth:
            ray = np.array([(col - CAMERA.cx) / CAMERA.fx, (row - CAMERA.cy) / CAMERA.fy, 1.0])
            np.testing.assert_allclose(points[row, col], ray / values[0], rtol=1e-5)
        else:
            np.testing.assert_allclose(points[row, col], values[:3], rtol=1e-5, atol=1e-6)
        wanted = np.clip(values[n_range:], 0, 255)
        clipped += int((wanted != values[n_range:]).any())
        assert np.abs(color[row, col] - wanted).max() <= 0.5 + 1e-9
    assert clipped and (behind or not inverse_depth), "the case was meant to hold these too"
