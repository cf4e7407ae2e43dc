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


@bare
def _project(xyz, pixel, into, lens, height, width, depth, at):  # type: ignore[no-untyped-def]
    """depth (n,) and at (n, 2), row and column, of each point in the new view; row -1 outside. Without a
    camera the pixel that it was seen at."""
    for i in range(xyz.shape[0]):
        at[i, 0] = -1
        x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
        depth[i] = into[2, 0] * x + into[2, 1] * y + into[2, 2] * z + into[2, 3]
        row, col = np.float64(pixel[i, 0]), np.float64(pixel[i, 1])
        if lens[0] > 0.0:
            if not depth[i] > 1e-6:
                continue
            right = into[0, 0] * x + into[0, 1] * y + into[0, 2] * z + into[0, 3]
            down = into[1, 0] * x + into[1, 1] * y + into[1, 2] * z + into[1, 3]
            col = right / depth[i] * lens[0] + lens[2]
            row = down / depth[i] * lens[1] + lens[3]
        if -0.5 <= row < height - 0.5 and -0.5 <= col < width - 0.5:
            at[i, 0] = int(row + 0.5)
            at[i, 1] = int(col + 0.5)


@bare
def _nearest(depth, at, step, buffer):  # type: ignore[no-untyped-def]
    """buffer: least depth of the points in each square of the view."""
    buffer[:] = np.inf
    for i in range(depth.shape[0]):
        if at[i, 0] >= 0:
            row, col = at[i, 0] // step, at[i, 1] // step
            buffer[row, col] = min(buffer[row, col], depth[i])


@bare
def _vote(  # type: ignore[no-untyped-def]
    weight, row, depth, at, labels, models, lens, scale, offset, step, buffer, around, margin, tolerance,
    common, visible,
):  # fmt: skip
    """See `carry`; buffer of one square: no point hides another. Adds to common and visible."""
    height, width = labels.shape
    hides = buffer.shape[0] > 1
    for i in range(depth.shape[0]):
        if at[i, 0] < 0:
            continue
        if hides and depth[i] > buffer[at[i, 0] // step, at[i, 1] // step] * (1.0 + tolerance):
            continue
        share, told = weight[i] / around.shape[0], 0
        for v in range(around.shape[0]):
            r = at[i, 0] + margin * around[v, 0]
            c = at[i, 1] + margin * around[v, 1]
            if r < 0 or r >= height or c < 0 or c >= width:
                continue
            k = labels[r, c]
            if k <= 0:
                continue
            if lens[0] > 0.0:
                seen = (predict(models, k, r, c, 0, 0) * scale[0] + offset[0]) * depth[i]  # over 1: nearer
                if seen > 1.0 + tolerance:
                    continue
                told += 1
                if seen < 1.0 - tolerance:
                    continue
            else:
                told += 1
            common[row[i], k] += share
        visible[row[i]] += told * share


class Overlap(NamedTuple):
    """How what was there lies over labels, in squares.

    common : (T + 1, M + 1) float64, votes of row t for label m; row and column 0 are of no meaning
    visible : (T + 1,) all votes of t that tell something
    """

    common: Array
    visible: Array

    def of_groups(
        self, row: NDArray[np.int64], rows: int, group: NDArray[np.int64], count: int
    ) -> Overlap:  # fmt: skip
        """The same of groups of rows and of labels.

        Parameters
        ----------
        row : (T + 1,) the group of each row, 1..rows
        group : (M + 1,) the group of each label, 1..count
        """
        over = Overlap(np.zeros((rows + 1, count + 1)), np.zeros(rows + 1))
        _sum(*self, row, group, *over)
        return over


@bare
def _sum(common, visible, row, group, out, out_visible):  # type: ignore[no-untyped-def]
    """See `Overlap.of_groups`; adds to out."""
    for t in range(common.shape[0]):
        out_visible[row[t]] += visible[t]
        for m in range(common.shape[1]):
            if common[t, m] > 0.0:
                out[row[t], group[m]] += common[t, m]


class Carried(NamedTuple):
    """Points that are looked up in a new view.

    xyz : (n, 3) float64, m
    pixel : (n, 2) int64 where they were seen, which is where they are without a camera
    weight, row : (n,) of each point, and what it belongs to, 1..rows
    """

    xyz: Array
    pixel: NDArray[np.int64]
    weight: Array
    row: NDArray[np.int64]
    rows: int


def carry(
    points: Carried, into: Array, seen: Observation, step: int, tolerance: float, margin: int = 0,
    hides: bool = True,
) -> Overlap:  # fmt: skip
    """What points belong to over the regions that they fall on in the new view, and agree with.

    A point tells nothing where it is out of the image, behind something, or where nothing is labelled; it is
    for no region where something farther is seen.

    Parameters
    ----------
    into : (4, 4) takes the points into the new sensor frame
    step : side of the squares in which the nearest point hides the others, px
    tolerance : by which depths may differ, fraction of depth
    margin : px between the places at which a point votes; 0: at its own alone
    hides : whether points hide each other
    """
    height, width = seen.labels.shape
    n, count = len(points.xyz), seen.count("region")
    depth, at = np.empty(n), np.empty((n, 2), np.int64)
    _project(points.xyz, points.pixel, into, seen.lens, height, width, depth, at)
    size = (height // step + 1, width // step + 1) if hides else (1, 1)
    buffer = np.empty(size)
    if hides:
        _nearest(depth, at, step, buffer)
    over = Overlap(np.zeros((points.rows + 1, count + 1)), np.zeros(points.rows + 1))
    _vote(
        points.weight, points.row, depth, at, seen.labels, seen.models, seen.lens, seen.scale, seen.offset,
        step, buffer, AROUND if margin else AROUND[:1], margin, tolerance, *over,
    )  # fmt: skip
    return over
