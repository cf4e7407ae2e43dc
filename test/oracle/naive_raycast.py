"""Sphere tracing on signed distances: a second road to the first hit of a ray, sharing nothing with formulas.

Slow and plain on purpose; imports nothing of the product.
"""

import numpy as np


def sphere(point, center, radius):
    return np.linalg.norm(point - center) - radius


def cylinder(point, center, axis, radius, half_length):
    along = np.dot(point - center, axis)
    across = np.linalg.norm(point - center - along * axis)
    outside = np.maximum([across - radius, abs(along) - half_length], 0.0)
    return min(max(across - radius, abs(along) - half_length), 0.0) + np.linalg.norm(outside)


def half_spaces(point, normals, offsets):
    """A lower bound of the distance to a convex body outside it; exact in sign."""
    return np.max(normals @ point - offsets)


def trace(distance, origin, direction, far):
    """Ray parameter of the first hit, or infinity beyond `far`."""
    speed, t = np.linalg.norm(direction), 0.0
    for _ in range(20000):
        gap = distance(origin + t * direction)
        if gap < 1e-9:
            return t
        t += gap / speed
        if t > far:
            return np.inf
    return t
