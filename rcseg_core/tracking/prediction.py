"""Where the last frame lies in this one: its points rendered into the new view, nearest first.

Each visible point votes for the label that it falls on, unless what is measured there is nearer (it is
hidden) or farther (what it stood for has gone). Votes of a track on a label are the overlap of the visible
part.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.models.polynomials import predict
from rcseg_core.tracking.observation import Observation

Array = NDArray[np.float64]
#: Rows and columns at which a point votes, in margins: itself, and the four around it.
AROUND = np.array([[0, 0], [-1, 0], [0, 1], [1, 0], [0, -1]], np.int64)
#: Votes that are for no label.
GONE, HIDDEN = -1, 0


@bare
def _project(xyz, pixel, lens, height, width, at):  # type: ignore[no-untyped-def]
    """at (n, 2): row, column of each point, -1 outside; without a camera the pixel that it was seen at."""
    for i in range(xyz.shape[0]):
        at[i, 0] = -1
        row, col = np.float64(pixel[i, 0]), np.float64(pixel[i, 1])
        if lens[0] > 0.0:
            if not xyz[i, 2] > 1e-6:
                continue
            col = xyz[i, 0] / xyz[i, 2] * lens[0] + lens[2]
            row = xyz[i, 1] / xyz[i, 2] * lens[1] + lens[3]
        if -0.5 <= row < height - 0.5 and -0.5 <= col < width - 0.5:
            at[i, 0] = int(row + 0.5)
            at[i, 1] = int(col + 0.5)


@bare
def _nearest(xyz, at, step, buffer):  # type: ignore[no-untyped-def]
    """buffer: least depth of the points in each square of the view."""
    buffer[:] = np.inf
    for i in range(xyz.shape[0]):
        if at[i, 0] >= 0:
            row, col = at[i, 0] // step, at[i, 1] // step
            buffer[row, col] = min(buffer[row, col], xyz[i, 2])


@bare
def _vote(xyz, at, labels, models, lens, scale, offset, step, buffer, around, margin, tolerance, out):  # type: ignore[no-untyped-def]
    """See `carry`; buffer of one square: no point hides another."""
    height, width = labels.shape
    hides = buffer.shape[0] > 1
    for i in range(xyz.shape[0]):
        for v in range(around.shape[0]):
            out[i, v] = 0
        if at[i, 0] < 0:
            continue
        if hides and xyz[i, 2] > buffer[at[i, 0] // step, at[i, 1] // step] * (1.0 + tolerance):
            continue
        for v in range(around.shape[0]):
            row = at[i, 0] + margin * around[v, 0]
            col = at[i, 1] + margin * around[v, 1]
            if row < 0 or row >= height or col < 0 or col >= width:
                continue
            k = labels[row, col]
            if k <= 0:
                continue
            if lens[0] == 0.0:
                out[i, v] = k
                continue
            seen = (predict(models, k, row, col, 0, 0) * scale[0] + offset[0]) * xyz[i, 2]  # over 1: nearer
            if seen > 1.0 + tolerance:
                out[i, v] = 0
            elif seen < 1.0 - tolerance:
                out[i, v] = -1
            else:
                out[i, v] = k


def carry(
    xyz: Array, pixel: NDArray[np.int64], seen: Observation, step: int, tolerance: float, margin: int = 0,
    hides: bool = True,
) -> NDArray[np.int64]:  # fmt: skip
    """The regions that points vote for in the new view.

    Parameters
    ----------
    xyz : (n, 3) float64, m, in the new sensor frame
    pixel : (n, 2) where they were seen, which is where they are without a camera
    step : side of the squares in which the nearest point hides the others, px
    tolerance : by which depths may differ, fraction of depth
    margin : px between the places at which a point votes; 0: at its own alone
    hides : whether points hide each other

    Returns
    -------
    (n, v) int64, for each point and place the region that it falls on and agrees with; HIDDEN where it tells
    nothing (out of the image, behind something, unlabelled); GONE where something farther is seen
    """
    height, width = seen.labels.shape
    at = np.empty((len(xyz), 2), np.int64)
    _project(xyz, pixel, seen.lens, height, width, at)
    size = (height // step + 1, width // step + 1) if hides else (1, 1)
    buffer = np.empty(size)
    if hides:
        _nearest(xyz, at, step, buffer)
    around = AROUND if margin else AROUND[:1]
    out = np.empty((len(xyz), len(around)), np.int64)
    _vote(
        xyz, at, seen.labels, seen.models, seen.lens, seen.scale, seen.offset, step, buffer, around, margin,
        tolerance, out,
    )  # fmt: skip
    return out


class Overlap(NamedTuple):
    """How the tracks of one kind lie over its labels, in squares.

    common : (T + 1, M + 1) float64, votes of track row t for label m; row and column 0 are of no meaning
    visible : (T + 1,) all votes of t that tell something
    """

    common: Array
    visible: Array


def overlap(
    votes: NDArray[np.int64], weight: Array, row: NDArray[np.int64], rows: int, group: NDArray[np.int64],
    count: int,
) -> Overlap:  # fmt: skip
    """Sum the votes of points for one kind.

    Parameters
    ----------
    votes : (n, v) as `carry` gives them
    weight, row : (n,) of each point, and the row of its track, 1..rows
    group : (N + 1,) label of this kind by region
    count : labels of this kind
    """
    over = Overlap(np.zeros((rows + 1, count + 1)), np.zeros(rows + 1))
    _count(votes, weight, row, group, *over)
    return over


@bare
def _count(votes, weight, row, group, common, visible):  # type: ignore[no-untyped-def]
    """See `overlap`; adds to common and visible."""
    places = votes.shape[1]
    for i in range(votes.shape[0]):
        share = weight[i] / places
        for v in range(places):
            label = votes[i, v]
            if label != HIDDEN:
                visible[row[i]] += share
            if label > 0:
                common[row[i], group[label]] += share
