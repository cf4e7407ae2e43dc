"""The shapes of a frame and those of the tracks: which may be one, and what they tell together.

Planes, which most surfaces are, go many at once; spheres, cylinders and what changes its kind one by one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.config import TrackingConfig
from rcseg_core.shapes.plane_forms import LocalPlane
from rcseg_core.tracking import matching
from rcseg_core.tracking.fusion import Filter, Local, moved, relate
from rcseg_core.tracking.novelty import Novelty
from rcseg_core.tracking.planes import Planes, carry_planes, forbid, fuse

Array = NDArray[np.float64]
#: Probability of a difference below which a shape has moved: the frames before tell nothing of it any more.
MOVED = 1e-6


class Shapes(NamedTuple):
    """By label the shapes in the fixed frame, None for what has none, and the planes among them; no planes
    where a kind of labels has no shapes."""

    forms: list[Local | None]
    planes: Planes | None


def fixed_shapes(forms: Sequence[Local | None], pose: Array) -> Shapes:
    """Shapes of the frame of a sensor at `pose` (4, 4) in the fixed frame."""
    made = list(forms)
    planes = Planes.of(made)
    planes = planes._replace(pose=np.matmul(pose, planes.pose))
    for i, (form, row) in enumerate(zip(forms, planes.row.tolist(), strict=True)):
        if isinstance(form, LocalPlane):
            made[i] = LocalPlane(planes.pose[row], form.covariance, form.systematic)
        elif form is not None:
            made[i] = moved(form, pose)
    return Shapes(made, planes)


def gate(
    allowed: NDArray[np.bool_], filters: Sequence[Filter | None], forms: Sequence[Local | None],
    planes: Planes, sensor: Array, config: TrackingConfig, drift: Array,
) -> None:  # fmt: skip
    """Forbid pairs whose shapes differ by more than chance.

    Parameters
    ----------
    allowed : (T, M) tracks and labels from 1; is changed
    filters : (T,) of the tracks
    forms, planes : (M + 1,) as of `Shapes`
    sensor : (3,) its position in the fixed frame
    drift : (6, 6) see `Filter.carried`
    """
    carry_planes([one for one in filters if one is not None and isinstance(one.anchor, LocalPlane)], drift)
    known = [None if one is None else one.carried(drift).fused for one in filters]
    tracks, labels = Planes.of(known), planes._replace(row=planes.row[1:])
    slack = matching.slack_of(config)
    forbid(allowed, tracks, labels, planes.spread(sensor, *slack), matching.chi2_limit(config.gate, 3))
    both = (tracks.row[:, None] >= 0) & (labels.row >= 0)
    for t, m in np.argwhere(allowed & ~both).tolist():
        track, form = known[t], forms[m + 1]
        if form is not None and track is not None:
            more = matching.spread_by_pose(form, sensor, *slack)
            allowed[t, m] = matching.may_be_one(track, form, more, config.gate)


def fuse_all(
    filters: Sequence[Filter | None], forms: Sequence[Local | None], planes: Planes, sensor: Array,
    config: TrackingConfig, drift: Array, novelty: Novelty | None = None,
) -> list[Filter | None]:  # fmt: skip
    """One more measurement of each shape; what has moved, or is of another kind, begins anew.

    Parameters
    ----------
    filters : (M + 1,) of the tracks of the labels, None for what had no shape so far
    forms, planes, sensor, drift : as of `gate`
    novelty : learns what is new in each frame, and tells it; None: all is

    Returns
    -------
    (M + 1,) the filters, new ones among them
    """
    turn2 = config.pose_sigma_rad**2
    by_pose = config.pose_sigma_m**2, turn2, turn2
    made, labels, flat = list(filters), [], []
    for label, (known, form) in enumerate(zip(filters, forms, strict=True)):
        if isinstance(form, LocalPlane) and known is not None and isinstance(known.anchor, LocalPlane):
            labels.append(label)
            flat.append(known)
        elif form is not None:
            more = matching.spread_by_pose(form, sensor, *by_pose)
            made[label] = _fuse_one(
                known, form if novelty is None else _split(form, novelty.share), more, drift
            )
    row = planes.row[labels]
    seen = Planes(row, planes.pose[row], planes.random[row], planes.systematic[row])
    more = seen.spread(sensor, *by_pose)
    if novelty is not None:
        before = {i: one.latest for i, one in enumerate(flat) if one.latest is not None}
        again = list(before)
        novelty.add(list(before.values()), seen.some(again), 2.0 * more[again])
        seen = seen.split(novelty.share)
    carry_planes(flat, drift)
    same = fuse(flat, seen, more, matching.chi2_limit(MOVED, 3))
    for i in np.flatnonzero(~same).tolist():
        plane = LocalPlane(seen.pose[i], seen.random[i], seen.systematic[i])
        made[labels[i]] = _begun(plane, more[i], drift)
    for one, form in zip(made, forms, strict=True):
        if one is not None and isinstance(form, LocalPlane):
            one.latest = form
    return made


def _split(form: Local, share: float) -> Local:
    """As `Planes.split`."""
    new = share * form.covariance
    return replace(form, covariance=new, systematic=form.systematic + form.covariance - new)


def _fuse_one(known: Filter | None, form: Local, more: Array, drift: Array) -> Filter:
    """The filter of a shape of any kind; more: (q,) variances beside those of its own errors."""
    if known is not None:
        seen = relate(known.anchor, form)
        now = relate(known.carried(drift).fused, form)
        if seen is not None and now is not None:
            limit = matching.chi2_limit(MOVED, len(now.difference))
            if matching.miss(known.fused, now, more) <= limit:
                seen.random.flat[:: len(more) + 1] += more
                known.add(seen)
                return known
    return _begun(form, more, drift)


def _begun(form: Local, more: Array, drift: Array) -> Filter:
    first = type(form)(**{**vars(form), "covariance": form.covariance + np.diag(more)})
    return Filter(first, drift)
