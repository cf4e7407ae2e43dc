"""The small motion between two frames that nobody told: where three surfaces hold it, they tell it.

Points of the last frame's models are moved until they lie on the models of this one, by least squares of
distances along the normals (Chen & Medioni 1992) with points and models met along the ray, as in
KinectFusion. A wall tells how far it is and how it is turned, not how far the camera went along it: a prior
of no motion keeps what the surfaces do not hold, and how much of it is left says whether they held all.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.compute.small import rotation
from rcseg_core.models.polynomials import Models, predict

Array = NDArray[np.float64]
#: Points at most, and steps.
MOST_POINTS, STEPS = 1500, 7
#: One sigma of the motion between two frames: translation, m, and rotation, rad.
PRIOR_M, PRIOR_RAD = 0.05, 0.05
#: Distances beyond this share of depth are no measure of a motion; halved with every step, down to a fifth.
REACH = 0.1
#: Share of depth within which points agree with a guess.
AGREE = 0.01
#: Points that make one independent measurement, and a model's own error, share of depth.
POINTS_A_MEASUREMENT, MODEL_ERROR = 20.0, 0.002
#: Share of the prior's sigma that may be left in any direction where a motion counts as held.
HELD = 0.15


class Modelled(Protocol):
    """What a motion is told by: the part of an `Observation` that is named here."""

    @property
    def labels(self) -> NDArray[np.int32]: ...
    @property
    def lens(self) -> Array: ...
    @property
    def models(self) -> Models: ...
    @property
    def scale(self) -> Array: ...
    @property
    def offset(self) -> Array: ...


@bare
def _equations(xyz, every, move, seen_labels, models, lens, scale, offset, reach, gram, right, row):  # type: ignore[no-untyped-def]
    """Normal equations of the step (translation, rotation) of `move` (3, 4); the weight of the points."""
    height, width = seen_labels.shape
    gram[:, :] = 0.0
    right[:] = 0.0
    weight = 0.0
    for i in range(0, xyz.shape[0], every):
        x = move[0, 0] * xyz[i, 0] + move[0, 1] * xyz[i, 1] + move[0, 2] * xyz[i, 2] + move[0, 3]
        y = move[1, 0] * xyz[i, 0] + move[1, 1] * xyz[i, 1] + move[1, 2] * xyz[i, 2] + move[1, 3]
        z = move[2, 0] * xyz[i, 0] + move[2, 1] * xyz[i, 1] + move[2, 2] * xyz[i, 2] + move[2, 3]
        if not z > 1e-6:
            continue
        px, py = x / z, y / z
        col, row_at = px * lens[0] + lens[2], py * lens[1] + lens[3]
        if not (-0.5 <= row_at < height - 0.5 and -0.5 <= col < width - 0.5):
            continue
        k = seen_labels[int(row_at + 0.5), int(col + 0.5)]
        if k <= 0:
            continue
        w = predict(models, k, row_at, col, 0, 0) * scale[0] + offset[0]
        if not abs(w * z - 1.0) < reach:
            continue
        # tangent plane n . X = 1 of the model there, from the slopes of inverse depth
        nx = (
            predict(models, k, row_at, col + 0.5, 0, 0) - predict(models, k, row_at, col - 0.5, 0, 0)
        ) * scale[0]
        ny = (
            predict(models, k, row_at + 0.5, col, 0, 0) - predict(models, k, row_at - 0.5, col, 0, 0)
        ) * scale[0]
        nx *= lens[0]
        ny *= lens[1]
        nz = w - nx * px - ny * py
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        miss = (nx * x + ny * y + nz * z - 1.0) / length
        nx, ny, nz = nx / length, ny / length, nz / length
        sigma = MODEL_ERROR * z
        far = miss / (5.0 * sigma)
        share = 1.0 / (1.0 + far * far) ** 2 / (sigma * sigma)  # Geman-McClure
        row[0], row[1], row[2] = nx, ny, nz
        row[3], row[4], row[5] = y * nz - z * ny, z * nx - x * nz, x * ny - y * nx
        weight += 1.0
        for a in range(6):
            right[a] -= share * row[a] * miss
            for b in range(a + 1):
                gram[a, b] += share * row[a] * row[b]
    for a in range(6):
        for b in range(a):
            gram[b, a] = gram[a, b]
    return weight


@bare
def _agreeing(xyz, every, move, seen_labels, models, lens, scale, offset, reach):  # type: ignore[no-untyped-def]
    """How many of the points of `_equations` lie within reach of a model."""
    height, width = seen_labels.shape
    count = 0
    for i in range(0, xyz.shape[0], every):
        x = move[0, 0] * xyz[i, 0] + move[0, 1] * xyz[i, 1] + move[0, 2] * xyz[i, 2] + move[0, 3]
        y = move[1, 0] * xyz[i, 0] + move[1, 1] * xyz[i, 1] + move[1, 2] * xyz[i, 2] + move[1, 3]
        z = move[2, 0] * xyz[i, 0] + move[2, 1] * xyz[i, 1] + move[2, 2] * xyz[i, 2] + move[2, 3]
        if not z > 1e-6:
            continue
        col, row_at = x / z * lens[0] + lens[2], y / z * lens[1] + lens[3]
        if not (-0.5 <= row_at < height - 0.5 and -0.5 <= col < width - 0.5):
            continue
        k = seen_labels[int(row_at + 0.5), int(col + 0.5)]
        if k > 0 and abs((predict(models, k, row_at, col, 0, 0) * scale[0] + offset[0]) * z - 1.0) < reach:
            count += 1
    return count


def estimate_motion(
    xyz: Array, seen: Modelled, starts: Sequence[Array], sigma: tuple[float, float] = (PRIOR_M, PRIOR_RAD)
) -> tuple[Array, bool, Array]:
    """The motion that takes points of the last sensor frame into that of `seen`.

    Parameters
    ----------
    xyz : (n, 3) float64, m, on the models of the last frame
    starts : guesses (4, 4); the one that most points agree with is taken, the first of equal ones, and
        directions that nothing tells keep to it
    sigma : how far it may be off, m and rad

    Returns
    -------
    motion : (4, 4) float64
    held : whether the surfaces told all six directions
    covariance : (6, 6) of the error of the motion, a translation, m, and a turn, rad, about the new sensor
    """
    if seen.lens[0] == 0.0 or not len(xyz):
        return starts[0], False, np.diag(np.repeat(sigma, 3) ** 2)
    every = max(len(xyz) // MOST_POINTS, 1)
    gram, right, row = np.empty((6, 6)), np.empty(6), np.empty(6)

    def equations(move: Array, reach: float) -> float:
        told: float = _equations(
            xyz, every, move, seen.labels, seen.models, seen.lens, seen.scale, seen.offset, reach,
            gram, right, row,
        )  # fmt: skip
        return told

    def agreeing(start: Array) -> int:
        count: int = _agreeing(
            xyz, every, start[:3].copy(), seen.labels, seen.models, seen.lens, seen.scale, seen.offset, AGREE
        )
        return count

    start = starts[0] if len(starts) == 1 else max(starts, key=agreeing)
    move = start[:3].copy()
    spread = np.repeat(sigma, 3)
    prior = np.diag(spread**-2.0)
    gone = np.zeros(6)  # from the guess, to first order
    told = 0.0
    for step in range(STEPS):
        told = equations(move, REACH * max(0.5**step, 0.2))
        share = every / POINTS_A_MEASUREMENT if every < POINTS_A_MEASUREMENT else 1.0
        change = np.asarray(np.linalg.solve(share * gram + prior, share * right - prior @ gone), np.float64)
        turn = rotation(change[3:])
        move[:, :3] = turn @ move[:, :3]
        move[:, 3] = turn @ move[:, 3] + change[:3]
        gone += change
        if np.abs(change / spread).max() < 1e-3:
            break
    covariance = np.asarray(np.linalg.inv(share * gram + prior), np.float64)
    left = covariance / np.outer(spread, spread)
    held = told > 0 and float(np.linalg.eigvalsh(left)[-1]) < HELD**2
    motion = np.eye(4)
    motion[:3] = move
    return motion, held, covariance
