"""Many planes at once: most surfaces are planes, and calls for each of fifty take longer than the algebra."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.shapes.plane_forms import LocalPlane
from rcseg_core.tracking.fusion import LEAST_COSINE, Filter, Local
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
        off = self.pose[:, :3, 3] - sensor
        along = np.einsum("ij,ij->i", off, self.pose[:, :3, 2])
        lever2 = np.maximum(np.einsum("ij,ij->i", off, off) - along**2, 0.0)
        more = np.full((len(off), 3), turn2)
        more[:, 2] = shift2 + pose_turn2 * lever2
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
        flat = [form for form in forms if isinstance(form, LocalPlane)]
        row = np.full(len(forms), -1)
        row[[isinstance(form, LocalPlane) for form in forms]] = np.arange(len(flat))
        return cls(
            row,
            np.array([form.pose for form in flat]).reshape(-1, 4, 4),
            np.array([form.covariance for form in flat]).reshape(-1, 3, 3),
            np.array([form.systematic for form in flat]).reshape(-1, 3, 3),
        )


def forbid(allowed: NDArray[np.bool_], tracks: Planes, labels: Planes, more: Array, limit: float) -> None:
    """Forbid pairs of planes that differ by more than chance.

    Parameters
    ----------
    allowed : (T, M) is changed
    tracks, labels : the planes among T and M shapes
    more : (m, 3) variances beside those of both errors, for each plane of `labels`
    limit : chi-squared
    """
    _forbid(
        allowed, *tracks, *labels, more, LEAST_COSINE, limit, np.empty(3), np.empty((4, 3, 3)),
        np.empty((SCRATCH, MOST + 1, MOST)),
    )  # fmt: skip


@bare
def _forbid(  # type: ignore[no-untyped-def]
    allowed, known, known_pose, known_random, known_systematic, found, pose, random, systematic, more,
    least_cosine, limit, difference, room, scratch,
):  # fmt: skip
    for t in range(allowed.shape[0]):
        i = known[t]
        for m in range(allowed.shape[1]):
            j = found[m]
            if not allowed[t, m] or i < 0 or j < 0:
                continue
            far = _miss(
                known_pose[i], known_random[i], known_systematic[i], pose[j], random[j], systematic[j],
                more[j], least_cosine, difference, room, scratch,
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


def misses(first: Planes, second: Planes, more: Array) -> Array:
    """(m,) chi-squared of the differences of planes, one by one, by the random parts of both and `more`
    (m, 3); inf where their normals are far apart."""
    out = np.empty(len(first.pose))
    _misses(
        *first[1:3], *second[1:3], more, LEAST_COSINE, out, np.empty(3), np.empty((5, 3, 3)),
        np.empty((SCRATCH, MOST + 1, MOST)),
    )  # fmt: skip
    return out


@bare
def _misses(  # type: ignore[no-untyped-def]
    known_pose, known_random, pose, random, more, least_cosine, out, difference, room, scratch
):
    none = room[4]
    none[:, :] = 0.0
    for i in range(out.shape[0]):
        out[i] = _miss(
            known_pose[i], known_random[i], none, pose[i], random[i], none, more[i], least_cosine, difference,
            room, scratch,
        )  # fmt: skip


def carry_planes(filters: Sequence[Filter], drift: Array) -> None:
    """`Filter.carried` of filters that are all of planes."""
    old = [one for one in filters if one.drift is not drift]
    if not old:
        return
    state, table = np.array([one.state for one in old]), np.array([one.levers for one in old])
    more = table @ (drift - np.array([one.drift for one in old])) @ table.transpose(0, 2, 1)
    told = np.zeros(len(old), np.bool_)
    _carry(state, more, told, np.empty((SCRATCH, MOST + 1, MOST)))
    for one, mine, renewed in zip(old, state, told.tolist(), strict=True):
        one.drift = drift
        if renewed:
            one.renew(mine.copy(), LocalPlane(one.fused.pose, mine[3, :3, :3].copy(), one.fused.systematic))  # type: ignore[union-attr]


@bare
def _carry(state, more, told, scratch):  # type: ignore[no-untyped-def]
    for i in range(state.shape[0]):
        mine = state[i]
        told[i] = add_spread(more[i], 3, mine[5, 2], mine[:3], mine[5, 0], mine[5, 1], mine[3:5], scratch)


def fuse(filters: Sequence[Filter], seen: Planes, more: Array, limit: float) -> NDArray[np.bool_]:
    """Take one measurement into each filter, all of planes.

    Parameters
    ----------
    seen : as many planes
    more : (n, 3) variances beside those of their own errors
    limit : chi-squared beyond which a plane has moved

    Returns
    -------
    (n,) whether the plane is still the same; where it has moved the filter is left as it was
    """
    same = np.zeros(len(filters), np.bool_)
    if filters:
        state = np.array([one.state for one in filters])
        anchor, pose = (
            Planes.of([one.anchor for one in filters]).pose,
            Planes.of([one.fused for one in filters]).pose,
        )
        told = np.zeros(len(filters), np.bool_)
        _fuse(
            state, anchor, pose, seen.pose, seen.random, seen.systematic, more, LEAST_COSINE, limit, same,
            told, np.empty(3), np.empty((4, 3, 3)), np.empty(MOST), np.empty((2, MOST, MOST)),
            np.empty((SCRATCH, MOST + 1, MOST)),
        )  # fmt: skip
        for i in np.flatnonzero(told).tolist():
            mine = state[i].copy()
            filters[i].renew(mine, LocalPlane(pose[i].copy(), mine[3, :3, :3].copy(), mine[4, :3, :3].copy()))
    return same


@bare
def _fuse(  # type: ignore[no-untyped-def]
    state, anchor, fused_pose, pose, random, systematic, more, least_cosine, limit, same, told, difference,
    room, change, fused, scratch,
):  # fmt: skip
    for i in range(state.shape[0]):
        mine = state[i]
        far = _miss(
            fused_pose[i], mine[3, :3, :3], mine[4, :3, :3], pose[i], random[i], systematic[i], more[i],
            least_cosine, difference, room, scratch,
        )  # fmt: skip
        if not far <= limit:
            continue
        if not relate_planes(
            anchor[i], pose[i], random[i], systematic[i], least_cosine, difference, room[0], room[1], scratch
        ):
            continue
        same[i] = True
        for a in range(3):
            room[0, a, a] += more[i, a]
        if add_frame(
            difference, room[0], room[1], 3, mine[5, 2], mine[:3], mine[5, 0], change, fused, scratch
        ):
            told[i] = True
            for a in range(3):
                mine[5, 1, a] = change[a]
                for b in range(3):
                    mine[3, a, b] = fused[0, a, b]
                    mine[4, a, b] = fused[1, a, b]
            _shift(anchor[i], change, fused_pose[i])


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
