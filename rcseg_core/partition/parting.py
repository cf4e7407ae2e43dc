"""Parting: a bent region is several surfaces where they describe it shorter than a curved one (section 7).

A quartic bends round the creases of a far box to within the noise, above all where windows that straddled
them blur them. But a few planes that meet there do better with a fraction of the coefficients. So each bent
region is described anew, from nothing (`facets`). Parts that meet smoothly continue each other.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.parallel import together
from rcseg_core.decision.facets import LEAST_CELLS, MOST, QUADRIC, QUARTIC, Cells, describe, gather
from rcseg_core.decision.generalization import residuals_by_degree
from rcseg_core.decision.rule import error_budget
from rcseg_core.models.moments import Moments
from rcseg_core.partition.partition import Partition
from rcseg_core.signal.edges import ORIENTATION
from rcseg_core.signal.signals import INVALID, MISFIT, RANGE_OUTLIER, Signals, local_scales, scales
from rcseg_core.signal.spread import cell_share
from rcseg_core.signal.units import UNIT_PX

#: Cells of a region that are aimed at; their least side, px.
CELLS, LEAST_SIDE_PX = 400, 3
#: Squared miss of a cell, in its noise, beyond which it counts for no more.
CAP2 = 9.0
#: Surfaces that meet at a smaller angle, without a step, continue each other.
LEAST_ANGLE_RAD = np.deg2rad(25.0)
#: Least gain of a division, as a share of the squared tolerance.
EFFECT = 0.25
UNUSABLE = INVALID | RANGE_OUTLIER | MISFIT


class Parts(NamedTuple):
    """Surfaces of a region: number (h, w) the cell of each square of `side` px of its box or -1, part (n,) of
    each cell."""

    number: NDArray[np.int64]
    part: NDArray[np.int64]
    side: int


def find_parts(
    labels: NDArray[np.int32], k: int, box: NDArray[np.int64], n: float, signals: Signals
) -> Parts | None:
    """The surfaces that describe region k shorter than one curved surface, or None.

    box : (4,) of the region; n : its pixels
    """
    m = signals.noise.range_correlation
    side = max(LEAST_SIDE_PX, int(np.ceil(np.sqrt(n / CELLS))))
    channel = signals.n_range - 1
    *arrays, number, middle, scale = gather(
        labels, signals.image, signals.flags, UNUSABLE, k, box, side, channel
    )
    cells = Cells(*arrays)
    if len(cells.value) < 2 * LEAST_CELLS:
        return None
    var, eps2 = local_scales(signals.law, float(middle[2]))
    systematic2 = signals.noise.range_doubt2
    noise = var * (float(cell_share(side, np.array(m))) + systematic2)
    cap2 = CAP2 * (noise + EFFECT * eps2)
    unit = var * (m + systematic2 * n / 9.0)
    # what the sensor bends counts for less, but is not left out for that
    wide = cap2 * (1.0 + signals.noise.range_systematic**2 * n / (9.0 * m))
    price = float(np.log(max(n / m, np.e)))
    flat = (signals.slope[0] + signals.slope[1] * float(middle[2])) * scale / UNIT_PX
    owner, terms = np.zeros(len(cells.value), np.int64), np.zeros(MOST + 1, np.int64)
    coefs, joints = np.zeros((MOST + 1, QUARTIC)), np.zeros((MOST, MOST, 3))
    count, length, curved = describe(
        cells, cap2, wide, var * m, unit, price, float(flat), owner, coefs, terms, joints
    )  # fmt: skip
    if count < 2 or length >= curved:
        return None
    group = np.arange(count)
    for a, b in np.argwhere(joints[:, :, 0] > 0):
        pairs, step2, cosine = joints[a, b]
        if step2 / pairs <= cap2 and cosine / pairs >= np.cos(LEAST_ANGLE_RAD):
            group[group == group[b]] = group[a]
    names, part = np.unique(group[owner], return_inverse=True)
    return Parts(number, part.reshape(-1), side) if names.size > 1 else None


def bent_regions(moments: Moments, signals: Signals, least: int) -> NDArray[np.int64]:
    """Regions of at least `least` pixels that a plane misses by more than the error explains."""
    flat = residuals_by_degree(moments, signals.n_range, 1)[:, 0, 0]
    n = np.maximum(moments.count, 1.0)
    var, eps2 = scales(signals.law, moments.cross[:, 0, 0, 0] / n)
    budget = error_budget(0.0, signals.noise.range_doubt2, n, QUADRIC)
    bent = flat > n * signals.n_range * var + np.maximum(EFFECT * eps2 * n, budget * var)
    bent &= moments.count >= least
    bent[0] = False
    return np.nonzero(bent)[0]


def split_creases(partition: Partition, signals: Signals, least: int) -> tuple[int, NDArray[np.uint8]]:
    """Part the regions that several surfaces describe shorter; all but the largest become new regions.

    least : pixels of a region that is looked at, and of a part
    Returns how many were parted, and the creases, (H, W) uint8, ORIENTATION on either side of one.
    """
    boxes = partition.boxes()
    moments = partition.moments(signals, 1)
    bent = bent_regions(moments, signals, least)
    faces: list[Faces | None] = [None] * len(bent)

    def look(i: int) -> None:
        k = int(bent[i])
        faces[i] = _find_faces(partition.labels, k, boxes[k], float(moments.count[k]), signals, least)

    together(*(partial(look, i) for i in range(len(bent))))  # no region knows of the others
    parts = np.zeros(partition.labels.shape, np.int32)
    creases = np.zeros(partition.labels.shape, np.uint8)
    divided = last = 0
    for k, found in zip(bent, faces, strict=True):
        if found is None:
            continue
        row, col, row_max, col_max = boxes[k].tolist()
        window = slice(row, row_max + 1), slice(col, col_max + 1)
        creases[window][found.crease] = ORIENTATION
        np.add(found.image, last, out=parts[window], where=found.freed)
        last += found.many
        divided += 1
    if divided:
        partition.separate(parts, signals.flags, least)
    return divided, creases


class Faces(NamedTuple):
    """What parting a region does within its box (h, w): the part of each pixel from 1 and how many there are,
    the pixels that leave it, those beside a crease."""

    image: NDArray[np.int32]
    many: int
    freed: NDArray[np.bool_]
    crease: NDArray[np.bool_]


def _find_faces(
    labels: NDArray[np.int32], k: int, box: NDArray[np.int64], n: float, signals: Signals, least: int
) -> Faces | None:
    """`find_parts` as images; None where the region stays whole."""
    found = find_parts(labels, k, box, n, signals)
    if found is None:
        return None
    row, col, row_max, col_max = box.tolist()
    own = labels[row : row_max + 1, col : col_max + 1] == k
    image = _image_of(found, own)
    count = int(found.part.max()) + 1
    sizes = np.bincount(image[own], minlength=count + 1)
    kept = _main_piece(own & (image == int(np.argmax(sizes[1:])) + 1), least)
    near = np.ones((5, 5), np.uint8)
    thick = cv2.dilate(image.astype(np.uint8), near)
    thin = cv2.erode(np.where(own, image, 255).astype(np.uint8), near)
    crease = own & (thick != thin) & (thin > 0) & (thick < 255)
    return Faces(image, count, own & ~kept, crease)


def _main_piece(part: NDArray[np.bool_], least: int) -> NDArray[np.bool_]:
    """(h, w) a part without the pieces of `least` pixels and more that lie apart from its largest."""
    _, pieces, table, _ = cv2.connectedComponentsWithStats(part.astype(np.uint8), connectivity=8)
    sizes = table[:, cv2.CC_STAT_AREA].copy()
    sizes[0] = 0
    apart = sizes >= least
    apart[int(np.argmax(sizes))] = False
    return np.asarray(part & ~apart[pieces])


def _image_of(parts: Parts, own: NDArray[np.bool_]) -> NDArray[np.int32]:
    """(h, w) the part of each pixel of a region, from 1; that of the nearest cell where its own has none."""
    small = np.where(parts.number >= 0, parts.part[np.maximum(parts.number, 0)] + 1, 0).astype(np.int32)
    image = small.repeat(parts.side, axis=0).repeat(parts.side, axis=1)[: own.shape[0], : own.shape[1]]
    _, nearest = cv2.distanceTransformWithLabels(
        (image == 0).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.zeros(int(nearest.max()) + 1, np.int32)
    of_label[nearest[image > 0]] = image[image > 0]
    return np.where(own, of_label[nearest], 0)
