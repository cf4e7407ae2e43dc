"""The shape that many frames tell: an information filter whose systematic part does not average away.

Each frame is a measurement z = x + r + s of the shape's free parameters: r is new in every frame, s is not.
Frames are weighted by the inverse of both, W = (R + S)^-1, as if both were new; what the mean is worth is
worked out with what they are:

    random      (sum W)^-1 (sum W R W) (sum W)^-1        shrinks with the number of frames
    systematic  L L', L = (sum W)^-1 sum W S^(1/2)       a mean of the frames', all of one sign

A frame that is worse than the mean can make it worse (its bias counts as the others'), so that a frame which
does, counts for nothing, and one that alone is better than the mean begins it anew. Planes, spheres and
cylinders differ only in how a measurement is related to the filter's anchor.

Where the surfaces themselves tell how the sensor moved, each motion has an error, which is new in every frame
and adds to the random part of what was seen before it. These errors are summed once for all tracks, as those
of a small motion about the origin of the fixed frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_core.shapes.local_forms import LocalCylinder, LocalSphere
from rcseg_core.shapes.plane_forms import LocalPlane
from rcseg_core.tracking.kernels import MOST, SCRATCH, add_frame, add_spread, relate_planes

Array = NDArray[np.float64]
Local = LocalPlane | LocalSphere | LocalCylinder
#: Cosine between two normals, or axes, below which a difference is none of small angles.
LEAST_COSINE = 0.7
#: The error of no motion.
NO_DRIFT: Array = np.zeros((6, 6))


@dataclass(frozen=True)
class Related:
    """A measurement seen from an anchor of its own kind.

    difference : (q,) of its free parameters from those of the anchor
    random, systematic : (q, q) of that
    """

    difference: Array
    random: Array
    systematic: Array


def moved(form: Local, pose: NDArray[Any]) -> Local:
    """A shape of the sensor's frame in the frame that `pose` (4, 4) takes it to.

    Covariances of planes and cylinders are in their own axes and stay; that of a sphere's centre turns.
    """
    if isinstance(form, LocalSphere):
        turn = np.eye(4)
        turn[:3, :3] = pose[:3, :3]
        center = pose[:3, :3] @ form.center + pose[:3, 3]
        return LocalSphere(
            center, form.radius, turn @ form.covariance @ turn.T, turn @ form.systematic @ turn.T
        )
    if isinstance(form, LocalCylinder):
        return LocalCylinder(pose @ form.pose, form.radius, form.covariance, form.systematic)
    return LocalPlane(pose @ form.pose, form.covariance, form.systematic)


def relate(anchor: Local, form: Local) -> Related | None:
    """A measurement seen from an anchor, in one frame; None where they are of two kinds or far apart.

    The free parameters are those of the local forms, at the anchor's own origin.
    """
    if isinstance(anchor, LocalSphere) and isinstance(form, LocalSphere):
        difference = np.append(form.center - anchor.center, form.radius - anchor.radius)
        return Related(difference, form.covariance.copy(), form.systematic)
    if isinstance(anchor, LocalPlane) and isinstance(form, LocalPlane):
        return _relate_planes(anchor, form)
    if isinstance(anchor, LocalCylinder) and isinstance(form, LocalCylinder):
        return _relate_cylinders(anchor, form)
    return None


def _relate_planes(anchor: LocalPlane, form: LocalPlane) -> Related | None:
    difference, random, systematic = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    scratch = np.empty((SCRATCH, MOST + 1, MOST))
    near = relate_planes(
        anchor.pose, form.pose, form.covariance, form.systematic, LEAST_COSINE, difference, random,
        systematic, scratch,
    )  # fmt: skip
    return Related(difference, random, systematic) if near else None


def _relate_cylinders(anchor: LocalCylinder, form: LocalCylinder) -> Related | None:
    axes = anchor.pose[:3, :3]
    turn = axes.T @ form.pose[:3, :3]
    if abs(turn[2, 2]) < LEAST_COSINE:
        return None
    x, y, z = axes.T @ (form.pose[:3, 3] - anchor.pose[:3, 3])
    along = turn[:, 2] / turn[2, 2]  # the axis at height 1
    difference = np.array(
        [-along[1], along[0], x - z * along[0], y - z * along[1], form.radius - anchor.radius]
    )
    table = np.zeros((5, 5))
    table[:2, :2] = turn[:2, :2]  # a tilt is a turn in space, whichever way the axis points
    table[2:4, 2:4] = turn[:2, :2]
    table[2] += -z * table[1]
    table[3] += z * table[0]
    table[4, 4] = 1.0
    return Related(difference, table @ form.covariance @ table.T, table @ form.systematic @ table.T)


def in_fixed_frame(pose: Array, covariance: Array) -> Array:
    """(6, 6) of a small motion, a translation and a turn, about the fixed frame's origin, from the same about
    the sensor at `pose` (4, 4) and in its axes."""
    turn, (x, y, z) = pose[:3, :3], pose[:3, 3].tolist()
    table = np.zeros((6, 6))
    table[:3, :3] = table[3:, 3:] = turn
    table[:3, 3:] = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ turn
    told: Array = table @ covariance @ table.T
    return told


def levers(form: Local) -> Array:
    """(q, 6) by how much a small motion about the origin, a translation and a turn, changes the free
    parameters of a shape."""
    if isinstance(form, LocalSphere):
        table = np.zeros((4, 6))
        table[:3, :3] = np.eye(3)
        table[:3, 3:] = np.cross(np.eye(3), form.center).T
        return table
    axes, origin = form.pose[:3, :3], form.pose[:3, 3]
    table = np.zeros((len(form.covariance), 6))
    table[:2, 3:] = axes[:, :2].T
    along = axes[:, :2].T if isinstance(form, LocalCylinder) else axes[:, 2:].T
    table[2 : 2 + len(along), :3] = along
    table[2 : 2 + len(along), 3:] = np.cross(origin, along)
    return table


def shifted(anchor: Local, change: Array, random: Array, systematic: Array) -> Local:
    """The anchor with its free parameters changed, and with these errors."""
    if isinstance(anchor, LocalSphere):
        return LocalSphere(anchor.center + change[:3], float(anchor.radius + change[3]), random, systematic)
    pose = anchor.pose.copy()
    axes = anchor.pose[:3, :3]
    direction = axes @ np.array([change[1], -change[0], 1.0])
    direction /= np.linalg.norm(direction)
    x = axes[:, 0] - (axes[:, 0] @ direction) * direction
    x /= np.linalg.norm(x)
    (a, b, c), (d, e, f) = direction.tolist(), x.tolist()
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = x, (b * f - c * e, c * d - a * f, a * e - b * d), direction
    if isinstance(anchor, LocalCylinder):
        pose[:3, 3] += axes[:, 0] * change[2] + axes[:, 1] * change[3]
        return LocalCylinder(pose, float(anchor.radius + change[4]), random, systematic)
    pose[:3, 3] += change[2] * axes[:, 2]
    return LocalPlane(pose, random, systematic)


class Filter:
    """The fused shape of one track.

    Parameters
    ----------
    first : the first measurement, which is the anchor too; in the fixed frame
    drift : (6, 6) the errors of all motions so far, see `in_fixed_frame`

    Attributes
    ----------
    state : (6, 5, 5) the sums of `add_frame` (0 to 2), random and systematic part of the mean (3, 4), and in
        rows of 5: value, change, best
    drift : (6, 6) up to which it was carried
    levers : (q, 6) of its anchor
    """

    def __init__(self, first: Local, drift: Array = NO_DRIFT) -> None:
        self.anchor = first
        self.size = len(first.covariance)
        self.state = np.zeros((6, MOST, MOST))
        self.state[5, 2] = np.inf
        self.drift, self.levers = drift, levers(first)
        self._told: Local | None = first
        self.add(Related(np.zeros(self.size), first.covariance, first.systematic))

    def carried(self, drift: Array) -> Filter:
        """Itself, less certain by the errors of the motions since it was last carried.

        Parameters
        ----------
        drift : (6, 6) the errors of all motions so far; only ever grows
        """
        if drift is not self.drift:
            more, state = self.levers @ (drift - self.drift) @ self.levers.T, self.state
            told, q = self.fused, self.size
            if add_spread(
                more, self.size, state[5, 2], state[:3], state[5, 0], state[5, 1], state[3:5],
                np.empty((SCRATCH, MOST + 1, MOST)),
            ):  # fmt: skip
                self._told = replace(told, covariance=state[3, :q, :q].copy())
            self.drift = drift
        return self

    def add(self, seen: Related) -> None:
        """Take in one more frame."""
        state, fused, change = self.state, np.zeros((2, MOST, MOST)), np.empty(MOST)
        if add_frame(
            seen.difference, seen.random, seen.systematic, self.size, state[5, 2], state[:3], state[5, 0],
            change, fused, np.empty((SCRATCH, MOST + 1, MOST)),
        ):  # fmt: skip
            state[3:5], state[5, 1], self._told = fused, change, None

    @property
    def fused(self) -> Local:
        """The mean, its random and its systematic covariance."""
        if self._told is None:
            q = self.size
            random, systematic = self.state[3:5, :q, :q].copy()
            self._told = shifted(self.anchor, self.state[5, 1, :q], random, systematic)
        return self._told
