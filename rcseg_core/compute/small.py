"""What NumPy does with care for any shape, for the few numbers of one surface: same values, much sooner."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def cross(a: Array, b: Array) -> Array:
    """(3,) the cross product of two vectors (3,)."""
    ax, ay, az = a.tolist()
    bx, by, bz = b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def square_to(axis: Array) -> Array:
    """(3,) the unit vector square to a unit vector (3,) and to the coordinate axis farthest from it."""
    unit = np.zeros(3)
    unit[int(np.argmin(np.abs(axis)))] = 1.0
    first = cross(axis, unit)
    return np.asarray(first / np.sqrt(first @ first))


def rotation(vector: Array) -> Array:
    """(3, 3) the turn about a vector (3,) by its length, rad, by Rodrigues' formula."""
    x, y, z = vector.tolist()
    angle2 = x * x + y * y + z * z
    angle = math.sqrt(angle2)
    if angle < 1e-4:  # to the fourth order
        sine, cosine = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        sine, cosine = math.sin(angle) / angle, 2.0 * (math.sin(0.5 * angle) / angle) ** 2
    a, b, c = cosine * x * y, cosine * y * z, cosine * z * x
    return np.array(
        [
            [1.0 - cosine * (y * y + z * z), a - sine * z, c + sine * y],
            [a + sine * z, 1.0 - cosine * (x * x + z * z), b - sine * x],
            [c - sine * y, b + sine * x, 1.0 - cosine * (x * x + y * y)],
        ]
    )


def median(values: Array) -> float:
    """``numpy.median(values)`` of numbers (n,), n > 0, without NaN."""
    half = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, half)[half])
    ordered = np.partition(values, (half - 1, half))
    return 0.5 * (float(ordered[half - 1]) + float(ordered[half]))


def lower_quantile(values: Array, share: float) -> float:
    """``numpy.quantile(values, share, method="lower")``, likewise."""
    place = int(share * (len(values) - 1))
    return float(np.partition(values, place)[place])


def quantile(values: Array, share: float) -> float:
    """``numpy.quantile(values, share)`` of numbers (n,), n > 0, without NaN."""
    place = share * (len(values) - 1)
    below = int(place)
    above, part = min(below + 1, len(values) - 1), place - below
    ordered = np.partition(values, (below, above))
    low, high = float(ordered[below]), float(ordered[above])
    return low + (high - low) * part if part < 0.5 else high - (high - low) * (1.0 - part)
