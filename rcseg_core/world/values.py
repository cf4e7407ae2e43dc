"""The values that the world is made of; units are metres and radians, the frame is the sensor's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from shapely import Polygon

Array = NDArray[np.float64]

#: Names of the classes; the index is the value in `World.class_mask`.
CATEGORIES = (
    "unlabelled", "floor", "horizontal", "ceiling", "vertical", "inclined", "sphere", "cylinder", "other",
)  # fmt: skip
#: Values of `World.ground`.
NO_DEPTH, GROUND, OBSTACLE = 0, 1, 2


@dataclass(frozen=True)
class Up:
    """The direction away from the ground.

    Attributes
    ----------
    vector : (3,) float64, unit vector in the sensor's frame
    covariance : (3, 3) float64 of its components, rad^2, of rank 2: a unit vector does not vary along itself
    source : "floor", "parameter", "tf", "imu", or "given" where the caller told it
    """

    vector: Array
    covariance: Array
    source: str


@dataclass(frozen=True)
class Tilt:
    """How far the floor that is seen is tilted against the up that was told.

    Attributes
    ----------
    angle_rad : between the floor's normal and up
    standard_deviation_rad : of this angle, from the uncertainty of both
    expected : False where the angle is beyond `world.tilt_limit` and three deviations: the up is wrong, or
        the floor is none
    """

    angle_rad: float
    standard_deviation_rad: float
    expected: bool


@dataclass(frozen=True)
class Category:
    """The class of a surface.

    Attributes
    ----------
    name : one of `CATEGORIES` but the first
    probability : that of the name; NaN for planes where up is unknown, which are "other" then
    probabilities : of every class that the surface may be, by name
    """

    name: str
    probability: float
    probabilities: Mapping[str, float]


@dataclass(frozen=True)
class Ring:
    """A closed line round or within a surface, the first point not repeated.

    Attributes
    ----------
    pixels : (n, 2) float64, row and column, sub-pixel
    points : (n, 3) float64, m, where their rays meet the surface's model
    hole : whether the surface lies outside of it
    """

    pixels: Array
    points: Array
    hole: bool


@dataclass(frozen=True)
class Boundary:
    """Where a surface ends.

    Attributes
    ----------
    rings : of all its parts, each outer ring followed by its holes, the largest part first
    polygons : of planes, a shapely Polygon with holes for each part in the same order, in x, y of
        ``surface.plane.pose``, m, simplified; () for other surfaces
    """

    rings: tuple[Ring, ...]
    polygons: tuple[Polygon, ...]


@dataclass(frozen=True)
class Box3d:
    """An oriented box round what is seen of an object.

    Attributes
    ----------
    pose : (4, 4) float64, of the box's middle and axes in the sensor's frame, m; z is up where up is known
    size : (3,) float64, full lengths along these axes, m
    """

    pose: Array
    size: Array


@dataclass(frozen=True)
class Object:
    """Surfaces that are one thing.

    Attributes
    ----------
    label : value in `object_labels`
    surfaces : labels of its surfaces, ascending
    pixel_count : pixels of these
    box3d : Box3d
    stands_on : label of the surface it stands on (floor, table, another object's top); 0 where none is seen
    """

    label: int
    surfaces: tuple[int, ...]
    pixel_count: int
    box3d: Box3d
    stands_on: int
