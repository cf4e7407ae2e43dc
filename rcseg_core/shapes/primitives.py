"""Primitives on top of patches: is a surface a plane, a sphere, a cylinder, or none of these?

Each is fitted to the cells of a surface by weighted least squares of distances over their noise, which is a
law of depth. Noise alone would reject every plane of a real sensor at 20 000 pixels, so the test asks whether
the primitive misses the surface by more than a small share of noise and tolerance: then chi-squared is a
noncentral one. The simplest primitive that passes is taken; when none does, the answer is "none".
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincc

from rcseg_core.shapes.cells import Cells
from rcseg_core.shapes.distances import PLANE
from rcseg_core.shapes.fitting import (
    KINDS,
    Shape,
    fit_shape,
    parameters,
    start_cylinder,
    start_plane,
    start_sphere,
    transfer,
)
from rcseg_core.shapes.scores import CLIP, allowance, score

Array = NDArray[np.float64]

#: Share of sigma, and of the tolerance, that a shape may miss a surface by (rms).
ALLOWED = 0.25
#: The same for a plane where no curved shape fits. Sensors bend planes: floor, lid and box of a Kinect
#: recording are 0.0016 to 0.0022 of their depth off.
ALLOWED_BENT = 0.75
#: P of the test below which a primitive is rejected.
LEAST_P = 0.01
#: Normals must turn by this angle over the surface, or its curvature is not seen; rad.
LEAST_ARC = 0.35
#: Largest standard error of a direction, rad, and of a radius, relative, that still counts as known.
KNOWN = 0.1
#: Curved shapes are fitted where the surface is seen at this cosine at least: nearer to the limb, neither the
#: mean of a cell nor the noise along its ray tells where the surface is.
LEAST_COSINE = 0.5
#: Unless less than this share of the pixels would be left.
LEAST_SEEN = 0.3
#: Cells, and independent measurements, that a fit needs.
LEAST_CELLS = 8


@dataclass(frozen=True)
class Primitive:
    """A shape with its uncertainty, in the camera's (scanner's) frame.

    Attributes
    ----------
    kind : "plane", "sphere", "cylinder" or "none"
    parameters : float64 arrays by name, in the order of `covariance`
        plane: ``normal`` (3,), towards the sensor, and ``distance`` (), m, with normal . x = distance;
        sphere: ``center`` (3,), m, and ``radius`` (), m;
        cylinder: ``point`` (3,) of the axis, m, beside the surface's middle, ``axis`` (3,), ``radius`` (), m
    covariance : (q, q) float64 of the parameters in this order; unit vectors vary across themselves only, and
        the point of a cylinder across its axis; widened where the misfit is more than noise
    convex : whether the sensor sees the outside; True for a plane
    rms_m : rms distance of the single pixels, m
    rms_sigma : the same along the ray, over the sensor's noise there; 1: nothing but noise
    misfit_m : rms distance between the shape and the surface, noise taken off, m
    p_value : probability of so much misfit or more if the shape is right within what is allowed
    arc : angle that the normals turn by over nine tenths of the surface, rad
    """

    kind: str
    parameters: Mapping[str, Array]
    covariance: Array
    convex: bool
    rms_m: float
    rms_sigma: float
    misfit_m: float
    p_value: float
    arc: float

    @property
    def standard_errors(self) -> dict[str, Array]:
        """Roots of the diagonal of `covariance`, by the names of the parameters."""
        roots, at, out = np.sqrt(np.maximum(np.diag(self.covariance), 0.0)), 0, {}
        for name, value in self.parameters.items():
            out[name] = roots[at : at + value.size].reshape(value.shape)
            at += value.size
        return out


NONE = Primitive("none", {}, np.empty((0, 0)), True, np.nan, np.nan, np.nan, np.nan, np.nan)


def allowed(cells: Cells, share: float) -> Array:
    """(m,) squared misfit that is allowed, over the variance of each cell.

    See `scores.allowance`.
    """
    systematic2, rest = allowance(cells, share)
    return np.asarray(cells.worth * (systematic2 + rest * (1.0 + cells.tolerance2)))


def fit(start: Shape | None, cells: Cells) -> Primitive | None:
    """The least-squares shape next to a first guess; None without one, or where the cells do not tell it."""
    if start is None:
        return None
    limit = CLIP * np.sqrt(1.0 + allowed(cells, ALLOWED))
    found = fit_shape(start, cells.points, cells.spread, limit)
    return None if found is None else assess(*found, cells)


def noncentral_p(chi2: float, freedom: float, excess: float) -> float:
    """P that a noncentral chi-squared variable exceeds chi2 (Patnaik's scaled chi-squared)."""
    scale = (freedom + 2.0 * excess) / (freedom + excess)
    return float(gammaincc(0.5 * (freedom + excess) / scale, 0.5 * chi2 / scale))


def turn(normals: Array) -> float:
    """Opening angle of the cone about their mean that holds nine tenths of unit normals (m, 3), rad."""
    mean = normals.mean(axis=0)
    length = float(np.sqrt(mean @ mean))
    if length < 1e-9:
        return float(np.pi)
    tenth = len(normals) // 10
    least = float(np.partition(normals @ (mean / length), tenth)[tenth])
    return 2.0 * float(np.arccos(min(max(least, -1.0), 1.0)))


def assess(shape: Shape, covariance: Array, cells: Cells) -> Primitive:
    """A fitted shape as a Primitive.

    covariance : (q, q) of its local parameters
    cells : those it was fitted to
    """
    count = len(cells.points)
    freedom = max(count - len(covariance), 1)
    found = score(shape, cells, ALLOWED)
    misfit2 = found.missed - found.noise * freedom / count
    to_all = transfer(shape)
    return Primitive(
        kind=KINDS[shape.kind],
        parameters=parameters(shape),
        covariance=to_all @ (covariance * max(1.0, found.chi2 / freedom)) @ to_all.T,
        convex=shape.kind == PLANE or found.facing < 0,
        rms_m=math.sqrt(found.rms2_m),
        rms_sigma=math.sqrt(found.rms2_sigma),
        misfit_m=math.sqrt(max(misfit2, 0.0)),
        p_value=noncentral_p(found.chi2, freedom, found.excess),
        arc=0.0 if shape.kind == PLANE else turn(found.gradients),
    )


def _as_bent(plane: Primitive, cells: Cells) -> Primitive:
    """The plane with its P under the misfit that is allowed where no curved shape fits."""
    normal = plane.parameters["normal"]
    point = normal * plane.parameters["distance"]
    found = score(Shape(PLANE, point, normal, 0.0, point), cells, ALLOWED_BENT)
    freedom = max(len(cells.points) - 3, 1)
    return replace(plane, p_value=noncentral_p(found.chi2, freedom, found.excess))


def recognise(cells: Cells) -> tuple[Primitive, tuple[Primitive, ...]]:
    """The primitive that a surface is, and all that were tried.

    Returns
    -------
    primitive : the simplest that passes the test and is known well enough; where none does, the plane if it
        is only bent as sensors bend planes; else `NONE`
    candidates : the plane, and where it fails the sphere and the cylinder, as fitted
    """
    if len(cells.points) < LEAST_CELLS or cells.worth.sum() < LEAST_CELLS:
        return NONE, ()
    plane = fit(start_plane(cells.points, cells.pixels / cells.pixels.sum()), cells)
    if plane is not None and plane.p_value >= LEAST_P:
        return (plane if is_known(plane) else NONE), (plane,)
    seen = without_limb(cells)
    weight = seen.pixels / seen.pixels.sum()
    starts = start_sphere(seen.points, weight), start_cylinder(seen.points, seen.normals, weight)
    curved = [c for c in (fit(start, seen) for start in starts) if c is not None]
    adequate = [c for c in curved if c.p_value >= LEAST_P and c.arc >= LEAST_ARC and is_known(c)]
    if plane is not None:  # the test clips outliers, and may pass what is farther off than the plane
        adequate = [c for c in adequate if c.misfit_m < plane.misfit_m]
    candidates = tuple(c for c in (plane, *curved) if c is not None)
    if adequate:
        return min(adequate, key=lambda c: c.misfit_m), candidates
    if plane is not None:
        bent = _as_bent(plane, cells)
        if bent.p_value >= LEAST_P and is_known(bent):
            return bent, candidates
    return NONE, candidates


def without_limb(cells: Cells) -> Cells:
    """The cells that are not seen at a grazing angle."""
    slant = np.abs(np.sum(cells.points * cells.normals, axis=1))
    seen = slant >= LEAST_COSINE * np.sqrt(np.sum(cells.points**2, axis=1))
    if cells.pixels[seen].sum() < LEAST_SEEN * cells.pixels.sum() or seen.sum() < LEAST_CELLS:
        return cells
    return cells.chosen(seen)


def is_known(primitive: Primitive) -> bool:
    """Whether the errors of the direction and of the radius are small enough to be of use."""
    variance = np.maximum(primitive.covariance.diagonal(), 0.0).tolist()
    at, known = 0, []
    for name, value in primitive.parameters.items():
        if name in ("normal", "axis"):
            known.append(math.sqrt(sum(variance[at : at + 3])))
        elif name == "radius":
            known.append(math.sqrt(variance[at]) / max(float(value), 1e-12))
        at += value.size
    return all(error <= KNOWN for error in known)
