"""Many planes at once: most surfaces are planes, and calls for each of fifty take longer than the algebra."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.shapes.plane_forms import LocalPlane
from rcseg_core.tracking.fusion import LEAST_COSINE, Local
from rcseg_core.tracking.kernels import MOST, SCRATCH, add_frame, add_spread, chi_squared, relate_planes

Array = NDArray[np.float64]


class Planes(NamedTuple):
    """The planes among some shapes.

    row : (n,) int64, row of each shape below; -1 for what is no plane
    pose : (m, 4, 4); random, systematic : (m, 3, 3)
    """

    row: NDArray[np.int64]
    pose: Array
    random: Array
    systematic: Array

    def spread(self, sensor: Array, shift2: float, pose_turn2: float, turn2: float) -> Array:
        """(m, 3) as `matching.spread_by_pose` of each."""
        more = np.full((len(self.pose), 3), turn2)
        more[:, 2] = shift2
        if pose_turn2 > 0.0:  # else wherever the sensor is
            off = self.pose[:, :3, 3] - sensor
            along = np.einsum("ij,ij->i", off, self.pose[:, :3, 2])
            more[:, 2] += pose_turn2 * np.maximum(np.einsum("ij,ij->i", off, off) - along**2, 0.0)
        return more

    def some(self, rows: list[int]) -> Planes:
        """Those of some rows below."""
        return Planes(np.arange(len(rows)), self.pose[rows], self.random[rows], self.systematic[rows])

    def split(self, share: float) -> Planes:
        """The same where only a share of the random part is new in each frame; the rest is systematic."""
        return self._replace(
            random=share * self.random, systematic=self.systematic + (1.0 - share) * self.random
        )

    @classmethod
    def of(cls, forms: Sequence[Local | None]) -> Planes:
        """Those of a list of shapes."""
        at = [i for i, form in enumerate(forms) if isinstance(form, LocalPlane)]
        flat: list[LocalPlane] = [forms[i] for i in at]  # type: ignore[misc]
        row = np.full(len(forms), -1)
        row[at] = np.arange(len(at))
        return cls(
            row,
            _stacked([form.pose for form in flat], 4),
            _stacked([form.covariance for form in flat], 3),
            _stacked([form.systematic for form in flat], 3),
        )


def _stacked(matrices: list[Array], size: int) -> Array:
    """(m, size, size) of m matrices."""
    return np.concatenate(matrices).reshape(-1, size, size) if matrices else np.empty((0, size, size))


class FusedPlanes(NamedTuple):
    """What `fusion.Filter` knows of planes, a row for each of n tracks; changed in place.

    known : (n,) bool, whether the track is a plane; where not, the rest tells nothing
    anchor : (n, 4, 4) pose of the first measurement
    pose : (n, 4, 4) of the mean
    state : (n, 6, 5, 5) as `Filter.state`
    levers : (n, 3, 6) as `Filter.levers`
    latest_pose, latest_random : (n, 4, 4) and (n, 3, 3), the last measurement as it was stated
    """

    known: NDArray[np.bool_]
    anchor: Array
    pose: Array
    state: Array
    levers: Array
    latest_pose: Array
    latest_random: Array

    @classmethod
    def none(cls, count: int) -> FusedPlanes:
        """Rows that are no planes."""
        return cls(
            np.zeros(count, np.bool_), np.zeros((count, 4, 4)), np.zeros((count, 4, 4)),
            np.zeros((count, 6, MOST, MOST)), np.zeros((count, 3, 6)), np.zeros((count, 4, 4)),
            np.zeros((count, 3, 3)),
        )  # fmt: skip

    def fused(self, pose: Array | None = None) -> list[LocalPlane | None]:
        """The means, None where there is none; `pose` (4, 4) takes them to another frame."""
        poses = self.pose.copy() if pose is None else np.matmul(pose, self.pose)
        random, systematic = self.state[:, 3, :3, :3].copy(), self.state[:, 4, :3, :3].copy()
        return [
            LocalPlane(poses[i], random[i], systematic[i]) if known else None
            for i, known in enumerate(self.known.tolist())
        ]

    def carry(self, more: Array) -> None:
        """`Filter.carried` of all by the error of a motion (6, 6), see `fusion.in_fixed_frame`."""
        spread = self.levers @ more @ self.levers.transpose(0, 2, 1)
        _carry(self.known, self.state, spread, np.empty((SCRATCH, MOST + 1, MOST)))


@bare
def _carry(known, state, more, scratch):  # type: ignore[no-untyped-def]
    for i in range(state.shape[0]):
        if known[i]:
            mine = state[i]
            add_spread(more[i], 3, mine[5, 2], mine[:3], mine[5, 0], mine[5, 1], mine[3:5], scratch)


def forbid(
    allowed: NDArray[np.bool_], rows: NDArray[np.int64], tracks: FusedPlanes, labels: Planes, more: Array,
    limit: float,
) -> None:  # fmt: skip
    """Forbid pairs of planes that differ by more than chance.

    Parameters
    ----------
    allowed : (T, M) is changed
    rows : (T,) of the tracks
    labels : the planes among M shapes
    more : (m, 3) variances beside those of both errors, for each plane of `labels`
    limit : chi-squared
    """
    _forbid(
        allowed, rows, tracks.known, tracks.pose, tracks.state, *labels, more, LEAST_COSINE, limit,
        np.empty(3), np.empty((4, 3, 3)), np.empty((SCRATCH, MOST + 1, MOST)),
    )  # fmt: skip


@bare
def _forbid(  # type: ignore[no-untyped-def]
    allowed, rows, known, known_pose, state, found, pose, random, systematic, more, least_cosine, limit,
    difference, room, scratch,
):  # fmt: skip
    for t in range(allowed.shape[0]):
        i = rows[t]
        if not known[i]:
            continue
        for m in range(allowed.shape[1]):
            j = found[m]
            if not allowed[t, m] or j < 0:
                continue
            far = _miss(
                known_pose[i], state[i, 3], state[i, 4], pose[j], random[j], systematic[j], more[j],
                least_cosine, difference, room, scratch,
            )  # fmt: skip
            allowed[t, m] = far <= limit


@bare
def _miss(  # type: ignore[no-untyped-def]
    known_pose, known_random, known_systematic, pose, random, systematic, more, least_cosine, difference,
    room, scratch,
):  # fmt: skip
    """Chi-squared of the difference of two planes; inf where their normals are far apart."""
    if not relate_planes(
        known_pose, pose, random, systematic, least_cosine, difference, room[0], room[1], scratch
    ):
        return np.inf
    for a in range(3):
        for b in range(3):
            room[2, a, b] = room[0, a, b] + room[1, a, b] + known_random[a, b] + known_systematic[a, b]
        room[2, a, a] += more[a]
    return chi_squared(difference, room[2], 3, scratch[0])


def misses(rows: NDArray[np.int64], tracks: FusedPlanes, now: Planes, more: Array) -> Array:
    """(n,) chi-squared of the differences of the last measurements of some tracks from as many of now.

    By the random parts of both and `more` (n, 3); inf where their normals are far apart, NaN where a track
    was no plane.
    """
    out = np.full(len(rows), np.nan)
    _misses(
        rows, tracks.known, tracks.latest_pose, tracks.latest_random, now.pose, now.random, more,
        LEAST_COSINE, out, np.empty(3), np.empty((5, 3, 3)), np.empty((SCRATCH, MOST + 1, MOST)),
    )  # fmt: skip
    return out


@bare
def _misses(  # type: ignore[no-untyped-def]
    rows, known, known_pose, known_random, pose, random, more, least_cosine, out, difference, room, scratch
):
    none = room[4]
    none[:, :] = 0.0
    for j in range(rows.shape[0]):
        i = rows[j]
        if known[i]:
            out[j] = _miss(
                known_pose[i], known_random[i], none, pose[j], random[j], none, more[j], least_cosine,
                difference, room, scratch,
            )  # fmt: skip


def fuse(
    rows: NDArray[np.int64], tracks: FusedPlanes, seen: Planes, more: Array, limit: float
) -> NDArray[np.bool_]:
    """Take one measurement into each of some tracks; those that have moved, or were none, begin anew.

    Parameters
    ----------
    rows : (n,) of the tracks, each once
    seen : as many planes
    more : (n, 3) variances beside those of their own errors
    limit : chi-squared beyond which a plane has moved

    Returns
    -------
    (n,) whether the plane is still the same
    """
    same = np.zeros(len(rows), np.bool_)
    _fuse(
        rows, tracks.known, tracks.anchor, tracks.pose, tracks.state, tracks.levers, seen.pose, seen.random,
        seen.systematic, more, LEAST_COSINE, limit, same, np.empty(3), np.empty((4, 3, 3)), np.empty(MOST),
        np.empty((2, MOST, MOST)), np.empty((SCRATCH, MOST + 1, MOST)),
    )  # fmt: skip
    return same


@bare
def _fuse(  # type: ignore[no-untyped-def]
    rows, known, anchor, fused_pose, state, levers, pose, random, systematic, more, least_cosine, limit, same,
    difference, room, change, fused, scratch,
):  # fmt: skip
    for j in range(rows.shape[0]):
        i = rows[j]
        mine = state[i]
        if known[i]:
            far = _miss(
                fused_pose[i], mine[3], mine[4], pose[j], random[j], systematic[j], more[j], least_cosine,
                difference, room, scratch,
            )  # fmt: skip
            same[j] = far <= limit and relate_planes(
                anchor[i], pose[j], random[j], systematic[j], least_cosine, difference, room[0], room[1],
                scratch,
            )  # fmt: skip
        if not same[j]:
            known[i] = True
            _begin(pose[j], random[j], systematic[j], more[j], anchor[i], fused_pose[i], mine, levers[i])
            for a in range(3):
                difference[a] = 0.0
                for b in range(3):
                    room[0, a, b], room[1, a, b] = random[j, a, b], systematic[j, a, b]
        for a in range(3):
            room[0, a, a] += more[j, a]
        if add_frame(
            difference, room[0], room[1], 3, mine[5, 2], mine[:3], mine[5, 0], change, fused, scratch
        ):
            for a in range(3):
                mine[5, 1, a] = change[a]
                for b in range(3):
                    mine[3, a, b] = fused[0, a, b]
                    mine[4, a, b] = fused[1, a, b]
            _shift(anchor[i], change, fused_pose[i])


@bare
def _begin(pose, random, systematic, more, anchor, fused_pose, state, levers):  # type: ignore[no-untyped-def]
    """The row of a plane before its first measurement counts, see `fusion.Filter` and `fusion.levers`."""
    for a in range(4):
        for b in range(4):
            anchor[a, b] = fused_pose[a, b] = pose[a, b]
    state[:, :, :] = 0.0
    state[5, 2, 0] = np.inf
    levers[:, :] = 0.0
    for a in range(3):
        for b in range(3):
            state[3, a, b] = random[a, b]
            state[4, a, b] = systematic[a, b]
        state[3, a, a] += more[a]
        b, c = (a + 1) % 3, (a + 2) % 3
        levers[0, 3 + a] = pose[a, 0]
        levers[1, 3 + a] = pose[a, 1]
        levers[2, a] = pose[a, 2]
        levers[2, 3 + a] = pose[b, 3] * pose[c, 2] - pose[c, 3] * pose[b, 2]


@bare
def _shift(anchor, change, pose):  # type: ignore[no-untyped-def]
    """The pose of a plane (4, 4) whose free parameters are changed, as `fusion.shifted`."""
    length = np.sqrt(1.0 + change[0] ** 2 + change[1] ** 2)
    along = 0.0
    for a in range(3):
        pose[a, 2] = (anchor[a, 0] * change[1] - anchor[a, 1] * change[0] + anchor[a, 2]) / length
        along += anchor[a, 0] * pose[a, 2]
        pose[a, 3] = anchor[a, 3] + change[2] * anchor[a, 2]
    length = 0.0
    for a in range(3):
        pose[a, 0] = anchor[a, 0] - along * pose[a, 2]
        length += pose[a, 0] ** 2
    length = np.sqrt(length)
    for a in range(3):
        pose[a, 0] /= length
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        pose[a, 1] = pose[b, 2] * pose[c, 0] - pose[c, 2] * pose[b, 0]
