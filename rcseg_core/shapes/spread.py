"""Mean and spread of the points of a surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare

Array = NDArray[np.float64]


@bare
def _spread(points, weight, middle, spread):  # type: ignore[no-untyped-def]
    x = y = z = total = 0.0
    for i in range(weight.size):
        w = weight[i]
        total += w
        x += w * points[i, 0]
        y += w * points[i, 1]
        z += w * points[i, 2]
    x, y, z = x / total, y / total, z / total
    xx = xy = xz = yy = yz = zz = 0.0
    for i in range(weight.size):
        w = weight[i]
        a, b, c = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
        xx += w * a * a
        xy += w * a * b
        xz += w * a * c
        yy += w * b * b
        yz += w * b * c
        zz += w * c * c
    middle[0], middle[1], middle[2] = x, y, z
    spread[0, 0], spread[0, 1], spread[0, 2] = xx / total, xy / total, xz / total
    spread[1, 0], spread[1, 1], spread[1, 2] = xy / total, yy / total, yz / total
    spread[2, 0], spread[2, 1], spread[2, 2] = xz / total, yz / total, zz / total


def spread_of(points: Array, weight: Array) -> tuple[Array, Array]:
    """Mean (3,), m, and mean square about it (3, 3), m^2, of points (m, 3) of weights (m,) of any sum."""
    middle, spread = np.empty(3), np.empty((3, 3))
    _spread(np.asarray(points, np.float64), np.asarray(weight, np.float64), middle, spread)
    return middle, spread
