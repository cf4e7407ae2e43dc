"""What a robot takes from a segmentation: up, classes of surfaces, ground, polygons, objects.

Knows configuration, cameras, signals, models and primitives; nothing of how they were found. For others:
`World` and the values it is made of. Everything is computed on access, and once.
"""

from rcseg_core.world.outlines import triangles
from rcseg_core.world.values import (
    CATEGORIES,
    GROUND,
    NO_DEPTH,
    OBSTACLE,
    Boundary,
    Box3d,
    Category,
    Object,
    Ring,
    Tilt,
    Up,
)
from rcseg_core.world.world import World

__all__ = [
    "CATEGORIES",
    "GROUND",
    "NO_DEPTH",
    "OBSTACLE",
    "Boundary",
    "Box3d",
    "Category",
    "Object",
    "Ring",
    "Tilt",
    "Up",
    "World",
    "triangles",
]
