"""Which track is which label: an optimal assignment of overlaps among pairs whose shapes may be one.

Overlap decides. A chi-squared test of the parameters, with the errors of both sides, systematic ones
included, forbids pairs that lie over each other and are two surfaces all the same; colour breaks ties.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

from rcseg_core.compute.jit import bare
from rcseg_core.config import TrackingConfig
from rcseg_core.shapes.local_forms import LocalSphere
from rcseg_core.tracking.fusion import Local, Related, relate
from rcseg_core.tracking.kernels import MOST, chi_squared

Array = NDArray[np.float64]
#: Distance in RGB at which colours are no longer equal, levels.
COLOR_SIGMA = 30.0


class Side(NamedTuple):
    """Tracks or labels that compete, n of them.

    size : (n,) squares: of a track those that are visible
    color : (n, 3) levels; NaN where it is unknown
    """

    size: Array
    color: Array


def scores(
    common: Array, tracks: Side, labels: Side, free: NDArray[np.bool_], config: TrackingConfig
) -> tuple[Array, NDArray[np.bool_]]:
    """How well tracks and labels go together by place and colour.

    Parameters
    ----------
    common : (T, M) intersections, squares
    free : (M,) whether the label may be taken

    Returns
    -------
    score : (T, M) intersection over union, and a bonus for equal colour; 0 where the next is False
    allowed : (T, M) whether they overlap enough
    """
    score, allowed = np.zeros(common.shape), np.zeros(common.shape, np.bool_)
    _score(common, *tracks, *labels, free, config.min_overlap, config.color_weight, score, allowed)
    return score, allowed


@bare
def _score(  # type: ignore[no-untyped-def]
    common, visible, color, size, seen_color, free, least, color_weight, score, allowed
):
    for t in range(common.shape[0]):
        for m in range(common.shape[1]):
            both = common[t, m]
            if not both > 0.0 or not free[m]:
                continue
            union = visible[t] + size[m] - both
            share = both / union if union > 0.0 else both
            if share < least:
                continue
            distance2 = 0.0
            for c in range(3):
                distance2 += (color[t, c] - seen_color[m, c]) ** 2
            like = np.exp(-0.5 * distance2 / COLOR_SIGMA**2)
            allowed[t, m] = True
            score[t, m] = share + (color_weight * like if like == like else 0.0)  # NaN is unlike itself


def assign(score: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns of the pairs with the largest sum of scores (T, M); 0 forbids a pair.

    Rows are in the order of the tracks' ids and columns in that of labels, and so are equal choices.
    """
    rows, columns = linear_sum_assignment(score, maximize=True)
    made = score[rows, columns] > 0
    return rows[made], columns[made]


def slack_of(config: TrackingConfig) -> tuple[float, float, float]:
    """What a pose's error and a surface's own motion add to shapes: shift2, pose_turn2 and turn2 of
    `spread_by_pose`."""
    turn2 = config.pose_sigma_rad**2
    return config.slack_m**2 + config.pose_sigma_m**2, turn2, config.slack_rad**2 + turn2


def spread_by_pose(form: Local, sensor: Array, shift2: float, pose_turn2: float, turn2: float) -> Array:
    """Variances (q,) of the parameters of a shape that is shifted, turned with the sensor, and turned."""
    if pose_turn2 == 0.0:  # wherever the sensor is
        return _anywhere(len(form.covariance), shift2, turn2)
    if isinstance(form, LocalSphere):
        off = form.center - sensor
        return np.append(np.full(3, shift2 + pose_turn2 * float(off @ off)), shift2)
    off = form.pose[:3, 3] - sensor
    off2 = float(off @ off)
    if len(form.covariance) == 3:
        along = float(off @ form.pose[:3, 2])
        return np.array([turn2, turn2, shift2 + pose_turn2 * max(off2 - along**2, 0.0)])
    across = shift2 + pose_turn2 * off2
    return np.array([turn2, turn2, across, across, shift2])


@cache
def _anywhere(size: int, shift2: float, turn2: float) -> Array:
    """`spread_by_pose` of planes (3), spheres (4) and cylinders (5) under poses that are exact."""
    tilts = 0 if size == 4 else 2
    return np.array([turn2] * tilts + [shift2] * (size - tilts))


def may_be_one(track: Local, form: Local, more: Array, gate: float) -> bool:
    """Whether the parameters of a track's shape and of a measurement may differ by chance.

    Two kinds of shape tell nothing: what a surface is recognised as may change with the view.

    Parameters
    ----------
    more : (q,) variances beside those of both errors
    gate : probability below which they are not one
    """
    if type(track) is not type(form):
        return True
    seen = relate(track, form)
    return seen is not None and miss(track, seen, more) <= chi2_limit(gate, len(seen.difference))


def miss(track: Local, seen: Related, more: Array) -> float:
    """Chi-squared of a difference."""
    q = len(seen.difference)
    total = seen.random + seen.systematic + track.covariance + track.systematic
    total.flat[:: q + 1] += more
    return float(chi_squared(seen.difference, total, q, np.empty((MOST + 1, MOST))))


_LIMITS: dict[tuple[float, int], float] = {}


def chi2_limit(gate: float, freedom: int) -> float:
    """Chi-squared that is exceeded with probability `gate`."""
    key = gate, freedom
    if key not in _LIMITS:
        _LIMITS[key] = float(chi2.isf(gate, freedom))
    return _LIMITS[key]
