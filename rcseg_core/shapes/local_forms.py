"""Recognised shapes in minimal local form: as many errors as degrees of freedom, about the middle.

The random part is that of the fit. The systematic part is told as a bias of depth, of which one sigma at the
middle of the surface is given. Nothing more is known of it than that it is smooth, so it is taken as the sum
of independent bends of that amplitude: one that is the same everywhere and moves the surface along the rays,
one that grows from minus to plus sigma over each half extent and tilts it, and for curved shapes one that
sags by sigma at the rim and changes the radius. Half extents are those of an even spread, sqrt(3) deviations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.small import cross, square_to
from rcseg_core.shapes.cells import Cells
from rcseg_core.shapes.plane_forms import LocalPlane
from rcseg_core.shapes.primitives import Primitive
from rcseg_core.shapes.spread import spread_of
from rcseg_core.signal.noise import NoiseModel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LocalSphere:
    """A sphere: centre and radius, in the camera's (scanner's) frame.

    Attributes
    ----------
    center : (3,) float64, m
    radius : float, m
    covariance : (4, 4) float64, m^2, random part of the errors of x, y, z of the centre and of the radius
    systematic : (4, 4) float64, m^2, likewise what no number of pixels averages away
    """

    center: Array
    radius: float
    covariance: Array
    systematic: Array


@dataclass(frozen=True)
class LocalCylinder:
    """A cylinder without ends, in the camera's (scanner's) frame.

    Attributes
    ----------
    pose : (4, 4) float64
        Origin: the point of the axis beside the surface's middle, m. z: the axis. x: from there towards the
        sensor, square to the axis.
    radius : float, m
    covariance : (5, 5) float64
        Random part of the errors of tilt about x, tilt about y (rad), offset along x, along y, radius (m).
    systematic : (5, 5) float64, likewise what no number of pixels averages away
    """

    pose: Array
    radius: float
    covariance: Array
    systematic: Array


def depth_bias(noise: NoiseModel, point: Array) -> float:
    """One sigma of the systematic error of depth at a point (3,), m.

    A law of inverse depth is one of the depth: dz = z^2 dw. Of grids of x, y, z it is that of z.
    """
    law = noise.systematic_law
    if len(law) > 1:
        a, b, c = law[-1]
        return float(a + point[2] * (b + point[2] * c))
    a, b, c = law[0]
    w = 1.0 / point[2]
    return float((a + w * (b + w * c)) / w**2)


def local_forms(
    found: Sequence[Primitive], cells: Sequence[Cells], noise: NoiseModel
) -> list[LocalPlane | LocalSphere | LocalCylinder | None]:
    """Recognised shapes in minimal local form; None where none was recognised.

    Parameters
    ----------
    found, cells : the shape of each surface, and the measurements that it was found in
    noise : what is systematic is taken from it, see `depth_bias`
    """
    biases = [
        0.0 if one.kind == "none" else depth_bias(noise, _middle(part))
        for one, part in zip(found, cells, strict=True)
    ]
    flat = [i for i, one in enumerate(found) if one.kind == "plane"]
    surfaces = [(cells[i].points, cells[i].pixels) for i in flat]
    forms: list[LocalPlane | LocalSphere | LocalCylinder | None] = [None] * len(found)
    for i, plane in zip(
        flat, _local_planes([found[i] for i in flat], surfaces, [biases[i] for i in flat]), strict=True
    ):
        forms[i] = plane
    for i, (one, part) in enumerate(zip(found, cells, strict=True)):
        if one.kind == "sphere":
            forms[i] = local_sphere(one, part.points, part.pixels, biases[i])
        elif one.kind == "cylinder":
            forms[i] = local_cylinder(one, part.points, part.pixels, biases[i])
    return forms


def local_plane(
    found: Primitive, points: Array, weight: Array, systematic_sigma_m: float = 0.0
) -> LocalPlane:
    """The minimal form of a plane.

    Parameters
    ----------
    found : Primitive of kind "plane"
    points, weight : (m, 3) m and (m,), the surface; its centroid and longest spread are theirs
    systematic_sigma_m : one sigma of the systematic error of depth at the centroid, m
    """
    return _local_planes([found], [(points, weight)], [systematic_sigma_m])[0]


def _local_planes(
    found: Sequence[Primitive], surfaces: Sequence[tuple[Array, Array]], sigmas_m: Sequence[float]
) -> list[LocalPlane]:
    """`local_plane` of n planes at once: each costs some thirty calls for a few numbers."""
    if not found:
        return []
    normal = np.array([one.parameters["normal"] for one in found], np.float64)
    distance = np.array([float(one.parameters["distance"]) for one in found])
    spreads = [spread_of(points, weight) for points, weight in surfaces]
    origin, spread = np.array([one[0] for one in spreads]), np.array([one[1] for one in spreads])
    origin = origin + (distance - _dot(normal, origin))[:, None] * normal
    onto: Array = np.eye(3) - normal[:, :, None] * normal[:, None]
    spread = onto @ spread @ onto
    x = np.linalg.eigh(spread)[1][:, :, 2]
    largest = np.take_along_axis(x, np.abs(x).argmax(axis=1)[:, None], axis=1)
    x = np.where(largest > 0, x, -x)
    x = x - _dot(x, normal)[:, None] * normal
    x /= np.sqrt(_dot(x, x))[:, None]
    y = np.cross(normal, x)
    pose = np.tile(np.eye(4), (len(found), 1, 1))
    pose[:, :3] = np.stack([x, y, normal, origin], axis=2)
    # a turn about x moves the normal by -y, one about y by x; an offset is what is left at the centroid
    table = np.zeros((len(found), 3, 4))
    table[:, 0, :3], table[:, 1, :3], table[:, 2, :3], table[:, 2, 3] = -y, x, -origin, 1.0
    covariance = table @ np.array([one.covariance for one in found]) @ table.swapaxes(1, 2)
    ahead = np.maximum(np.abs(origin[:, 2]), 1e-12)
    shift = np.array(sigmas_m) * np.abs(_dot(normal, origin)) / ahead
    systematic = np.zeros((len(found), 3, 3))
    for i, axis in enumerate((y, x)):  # half extents
        along = _dot(axis, (spread @ axis[:, :, None])[:, :, 0])
        systematic[:, i, i] = (shift / np.maximum(np.sqrt(3.0 * np.maximum(along, 0.0)), 1e-9)) ** 2
    systematic[:, 2, 2] = shift**2
    return [LocalPlane(*parts) for parts in zip(pose, covariance, systematic, strict=True)]


def _dot(a: Array, b: Array) -> Array:
    """(n,) products of vectors (n, 3)."""
    return np.asarray(np.einsum("ni,ni->n", a, b))


def local_sphere(
    found: Primitive, points: Array, weight: Array, systematic_sigma_m: float = 0.0
) -> LocalSphere:
    """The minimal form of a sphere; parameters as in `local_plane`."""
    center, radius = np.asarray(found.parameters["center"]), float(found.parameters["radius"])
    share = weight / weight.sum()
    local = share @ points - center
    u = local / max(float(np.linalg.norm(local)), 1e-12)
    across = np.stack(_square_to(u))
    half = _half_extents((points - center) @ across.T, share)
    sag = 2.0 * radius**2 / float(half.max()) ** 2  # of a cap: half^2 / (2 radius)
    ray = share @ points
    ray = ray / max(abs(float(ray[2])), 1e-12)
    # along the rays; turned about the middle of the cap; more curved, the middle of the cap at rest
    modes = np.zeros((4, 4))
    modes[0, :3] = ray
    modes[1:3, :3] = across * (radius / half)[:, None]
    modes[3] = sag * np.append(-u, 1.0)
    table = systematic_sigma_m * modes
    return LocalSphere(center, radius, np.array(found.covariance), table.T @ table)


def local_cylinder(
    found: Primitive, points: Array, weight: Array, systematic_sigma_m: float = 0.0
) -> LocalCylinder:
    """The minimal form of a cylinder; parameters as in `local_plane`."""
    axis, origin = np.asarray(found.parameters["axis"]), np.asarray(found.parameters["point"])
    radius, share = float(found.parameters["radius"]), weight / weight.sum()
    x = -origin + (origin @ axis) * axis
    if np.linalg.norm(x) < 1e-9:
        x = _square_to(axis)[0]
    x = x / np.linalg.norm(x)
    y = cross(axis, x)
    # the axis turned about x moves by -y, about y by x
    table = np.zeros((5, 7))
    table[0, 3:6], table[1, 3:6], table[2, :3], table[3, :3], table[4, 6] = -y, x, x, y, 1.0
    across, along = _half_extents((points - origin) @ np.stack([y, axis], axis=1), share)
    ray = share @ points
    ray = ray / max(abs(float(ray[2])), 1e-12)
    side = float(np.sign((share @ points - origin) @ x)) or 1.0
    modes = np.zeros((4, 5))
    modes[0, 2:4] = ray @ x, ray @ y  # along the rays
    modes[1, 1] = 1.0 / along  # one end nearer than the other
    modes[2, 3] = radius / across  # turned about the middle of the strip
    modes[3, [2, 4]] = 2.0 * radius**2 / across**2 * np.array([-side, 1.0])  # more curved
    modes *= systematic_sigma_m
    covariance = table @ found.covariance @ table.T
    return LocalCylinder(_pose(x, y, axis, origin), radius, covariance, modes.T @ modes)


def _middle(cells: Cells) -> Array:
    return np.asarray(cells.pixels @ cells.points / cells.pixels.sum())


def _square_to(axis: Array) -> tuple[Array, Array]:
    """Two unit vectors that complete a unit vector (3,) to a right-handed frame, the vector last."""
    first = square_to(axis)
    return first, cross(axis, first)


def _half_extents(flat: Array, share: Array) -> Array:
    """(k,) half extents of points (m, k) in each coordinate, as if they were spread evenly."""
    deviation = np.sqrt(np.maximum(share @ flat**2 - (share @ flat) ** 2, 0.0))
    return np.asarray(np.maximum(np.sqrt(3.0) * deviation, 1e-9))


def _pose(x: Array, y: Array, z: Array, origin: Array) -> Array:
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = x, y, z, origin
    return pose
