"""The shapes of a frame and those of the tracks: which may be one, and what they tell together.

Planes, which most surfaces are, go many at once; spheres and cylinders, which are bent, one by one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.config import TrackingConfig
from rcseg_core.shapes.local_forms import LocalCylinder, LocalSphere
from rcseg_core.tracking import matching
from rcseg_core.tracking.columns import longer, some
from rcseg_core.tracking.fusion import NO_DRIFT, Filter, Local, moved, relate
from rcseg_core.tracking.novelty import Novelty
from rcseg_core.tracking.planes import FusedPlanes, Planes, forbid, fuse, misses

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
#: Probability of a difference below which a shape has moved: the frames before tell nothing of it any more.
MOVED = 1e-6


class Shapes(NamedTuple):
    """The shapes of a frame in the fixed frame.

    planes : those of labels 0..M, of which 0 is none
    bent : by label the spheres and cylinders
    """

    planes: Planes
    bent: dict[int, Local]


def fixed_shapes(forms: Sequence[Local | None], pose: Array) -> Shapes:
    """Shapes (M + 1,) of the frame of a sensor at `pose` (4, 4) in the fixed frame."""
    planes = Planes.of(forms)
    bent = {i: form for i, form in enumerate(forms) if isinstance(form, (LocalSphere, LocalCylinder))}
    return Shapes(
        planes._replace(pose=np.matmul(pose, planes.pose)), {i: moved(form, pose) for i, form in bent.items()}
    )


class FusedShapes:
    """What all frames together tell of the shapes of some tracks.

    Attributes
    ----------
    planes : a row for each track
    bent : filters of spheres and cylinders, by the id of the track
    """

    def __init__(self) -> None:
        self.planes = FusedPlanes.none(0)
        self.bent: dict[int, Filter] = {}
        self._drift = NO_DRIFT

    def append(self, count: int) -> None:
        """Rows for so many new tracks, which have no shape yet."""
        self.planes = longer(self.planes, FusedPlanes.none(count))

    def keep(self, rows: NDArray[np.bool_], gone: Sequence[int]) -> None:
        """Keep some rows (n,); gone: ids of the others."""
        self.planes = some(self.planes, rows)
        for one in gone:
            self.bent.pop(one, None)

    def carry(self, drift: Array) -> None:
        """All of them, less certain by the errors of the motions since they were last carried; drift (6, 6)
        is the sum of all."""
        self.planes.carry(drift - self._drift)
        for one in self.bent.values():
            one.carried(drift)
        self._drift = drift

    def told(self, ids: Sequence[int], pose: Array | None) -> list[Local | None]:
        """The fused shapes of all rows, whose ids are given; `pose` (4, 4) takes them to another frame."""
        made: list[Local | None] = [*self.planes.fused(pose)]
        if self.bent:
            for row, one in enumerate(ids):
                if one in self.bent:
                    form = self.bent[one].fused
                    made[row] = form if pose is None else moved(form, pose)
        return made

    def gate(
        self, allowed: NDArray[np.bool_], rows: Rows, ids: Sequence[int], shapes: Shapes, sensor: Array,
        config: TrackingConfig,
    ) -> None:  # fmt: skip
        """Forbid pairs whose shapes differ by more than chance.

        Parameters
        ----------
        allowed : (T, M) tracks and labels from 1; is changed
        rows, ids : (T,) of the tracks
        sensor : (3,) its position in the fixed frame
        """
        slack = matching.slack_of(config)
        labels = shapes.planes._replace(row=shapes.planes.row[1:])
        limit = matching.chi2_limit(config.gate, 3)
        forbid(allowed, rows, self.planes, labels, labels.spread(sensor, *slack), limit)
        if not self.bent or not shapes.bent:
            return
        for label, form in shapes.bent.items():
            more = matching.spread_by_pose(form, sensor, *slack)
            for t in np.flatnonzero(allowed[:, label - 1]).tolist():
                if ids[t] in self.bent:
                    track = self.bent[ids[t]].fused
                    allowed[t, label - 1] = matching.may_be_one(track, form, more, config.gate)

    def fuse(
        self, rows: Rows, ids: Sequence[int], shapes: Shapes, sensor: Array, config: TrackingConfig,
        novelty: Novelty | None = None,
    ) -> None:  # fmt: skip
        """One more measurement of each shape; what has moved, or is of another kind, begins anew.

        Parameters
        ----------
        rows, ids : (M + 1,) of the tracks of the labels; of index 0 of no meaning
        sensor : as of `gate`
        novelty : learns what is new in each frame, and tells it; None: all is
        """
        turn2 = config.pose_sigma_rad**2
        by_pose = config.pose_sigma_m**2, turn2, turn2
        planes = shapes.planes
        labels = np.flatnonzero(planes.row >= 0)
        flat, more = rows[labels], planes.spread(sensor, *by_pose)
        seen = planes
        if novelty is not None:
            novelty.add(misses(flat, self.planes, planes, 2.0 * more))
            seen = planes.split(novelty.share)
        fuse(flat, self.planes, seen, more, matching.chi2_limit(MOVED, 3))
        self.planes.latest_pose[flat], self.planes.latest_random[flat] = planes.pose, planes.random
        if self.bent:
            for label in labels.tolist():
                self.bent.pop(ids[label], None)
        for label, form in shapes.bent.items():
            self.planes.known[rows[label]] = False
            split = form if novelty is None else _split(form, novelty.share)
            spread = matching.spread_by_pose(form, sensor, *by_pose)
            self.bent[ids[label]] = _fuse_one(self.bent.get(ids[label]), split, spread, self._drift)


def _split(form: Local, share: float) -> Local:
    """As `Planes.split`."""
    new = share * form.covariance
    return replace(form, covariance=new, systematic=form.systematic + form.covariance - new)


def _fuse_one(known: Filter | None, form: Local, more: Array, drift: Array) -> Filter:
    """The filter of a shape of any kind; more: (q,) variances beside those of its own errors."""
    if known is not None:
        seen, now = relate(known.anchor, form), relate(known.fused, form)
        if seen is not None and now is not None:
            limit = matching.chi2_limit(MOVED, len(now.difference))
            if matching.miss(known.fused, now, more) <= limit:
                seen.random.flat[:: len(more) + 1] += more
                known.add(seen)
                return known
    return Filter(replace(form, covariance=form.covariance + np.diag(more)), drift)
