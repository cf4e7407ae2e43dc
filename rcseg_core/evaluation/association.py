"""EVOPS's figures of association: planes of a frame that name the right one of the frame before.

A. Kornilova et al., "EVOPS Benchmark: Evaluation of Plane Segmentation from RGBD and LiDAR Data", 2022. Each
machine plane belongs to the truth that most of its pixels are on, and a truth to the plane that has most of
it. A plane is right where the plane that it names in the frame before belongs to the same truth, and where it
names none and there is none.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Owned(NamedTuple):
    """Machine planes of one frame.

    truth : dict, id to the truth that it belongs to; 0 for none
    size : dict, id to its pixels
    """

    truth: dict[int, int]
    size: dict[int, int]


def owners(ids: NDArray[np.integer], truth: NDArray[np.integer]) -> Owned:
    """What the machine planes of a frame belong to.

    Parameters
    ----------
    ids, truth : integers of one shape, 0 for none

    Notes
    -----
    Of equal overlaps the smaller truth, and the smaller id, goes first. A plane most of which is on no truth
    belongs to none, and so does one whose truth a larger part has.
    """
    names, rows = np.unique(ids.ravel(), return_inverse=True)
    truths, columns = np.unique(truth.ravel(), return_inverse=True)
    table = np.bincount(rows.ravel() * len(truths) + columns.ravel(), minlength=len(names) * len(truths))
    table = table.reshape(len(names), len(truths))
    sizes = dict(zip(names.tolist(), table.sum(axis=1).tolist(), strict=True))
    best = dict(zip(names.tolist(), table.argmax(axis=1).tolist(), strict=True))
    most = dict(zip(names.tolist(), table.max(axis=1).tolist(), strict=True))
    sizes.pop(0, None)
    owner, taken = dict.fromkeys(sizes, 0), {0}
    for name in sorted(sizes, key=lambda name: (-most[name], name)):
        mine = int(truths[best[name]])
        if mine not in taken:
            owner[name] = mine
            taken.add(mine)
    return Owned(owner, sizes)


def matched_ratios(before: Owned, now: Owned) -> tuple[float, float]:
    """matched_planes_ratio and matched_points_ratio of two frames in which equal ids are one plane.

    Returns
    -------
    Shares of the planes of the second frame, and of their pixels, that name the right plane of the first; NaN
    where it has none.
    """
    holder = {mine: name for name, mine in before.truth.items() if mine}
    right = {
        name: (name if name in before.truth else None) == holder.get(now.truth[name]) for name in now.truth
    }
    if not right:
        return float("nan"), float("nan")
    points = sum(now.size[name] for name in right if right[name])
    return sum(right.values()) / len(right), points / sum(now.size.values())
