"""False blobs: surfaces that lie wholly inside a larger one which explains their range as well.

A figure for frames without truth. It is computed from the label image and the measured points alone: the
model of the larger surface is fitted anew to its own pixels round the blob, and what counts as noise is how
these pixels spread about it. Nothing of the segmenter's models, noise or tolerances enters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from rcseg_core.frame import RangeColorFrame

RING_PX = 2
"""Width of the ring that tells what a region lies in; bridges slivers along its border."""
INSIDE_SHARE = 0.8
"""Share of the ring's labelled pixels that one larger surface must hold."""
KNOWN_SHARE = 1 / 3
"""Share of the ring that must be valid and labelled: two sides in a corner of the image are enough."""
BAND_PX = (10, 40)
"""Least and largest width of the band round the region on which the larger surface is fitted."""
PREDICTED_SHARE = 0.5
"""The larger surface predicts a region when its model is within the tolerance on this share of the pixels."""
SIGMAS = 3.0
RELATIVE_TOLERANCE = 0.005
"""Half a percent of the distance, 5 mm at 1 m: what deviates less is no thing of its own on a wall."""
SMOOTH_STEPS, SMOOTH_RELATIVE = 4.0, 0.01
"""A band whose 3 deviations exceed 4 steps between its neighbours and 1 % holds more than noise: no model."""
EIGHT = np.ones((3, 3), bool)


@dataclass(frozen=True)
class Blob:
    """A connected part of surface `label`, wholly inside the larger surface `host` that predicts its range.

    `row`, `col`: one of its pixels, near its middle; `box`: (row_min, col_min, row_max, col_max), inclusive.
    """

    label: int
    host: int
    pixel_count: int
    row: int
    col: int
    box: tuple[int, int, int, int]


def find_blobs(
    surface_labels: NDArray[np.integer], frame: RangeColorFrame, minimum_area: float
) -> tuple[Blob, ...]:
    """All false blobs of a frame, the largest first.

    A blob is an 8-connected part of one surface of at least `minimum_area` pixels such that

    - of the ring of 2 px round it at least a third is labelled, and one other, larger surface holds at least
      80 % of that;
    - a quadratic in row and column, fitted to inverse depth (inverse distance without a camera) of that
      surface's pixels in a band round the part, explains at least half of the part's pixels within a
      tolerance: the largest of 3 standard deviations of the band's own pixels (1.4826 x median absolute
      residual), one step of a quantised sensor (the median of the steps between the band's neighbours that
      differ) and 0.5 % of the distance. Where 3 deviations exceed both 4 such steps and 1 % of the distance
      the band is no smooth surface, and explains nothing.

    So a thing that stands out from a wall by more than the wall's noise is none, and neither is a region
    between two surfaces.

    Parameters
    ----------
    surface_labels : (H, W) integer, 0 unlabelled
    frame : RangeColorFrame
    minimum_area : pixels
    """
    known = frame.valid & (surface_labels > 0)
    signal = np.full(known.shape, np.nan)
    distance = frame.depth_m if frame.camera is not None else np.linalg.norm(frame.points, axis=2)
    signal[known] = 1.0 / distance[known]
    labels = np.where(known, surface_labels, 0)
    sizes = np.bincount(labels.ravel())
    found = []
    for label, box in enumerate(ndimage.find_objects(labels), start=1):
        if box is None or sizes[label] < minimum_area:
            continue
        parts = ndimage.label(labels[box] == label, EIGHT)[0]
        for number, inner in enumerate(ndimage.find_objects(parts), start=1):
            pixel_count = int(np.count_nonzero(parts[inner] == number))
            if pixel_count >= minimum_area:
                part = np.zeros(labels.shape, bool)
                part[box][inner] = parts[inner] == number
                blob = _judge(part, label, pixel_count, labels, sizes, signal)
                if blob is not None:
                    found.append(blob)
    return tuple(sorted(found, key=lambda blob: -blob.pixel_count))


def _judge(
    part: NDArray[np.bool_],
    label: int,
    pixel_count: int,
    labels: NDArray[np.integer],
    sizes: NDArray[np.integer],
    signal: NDArray[np.float64],
) -> Blob | None:
    """The blob that `part` (H, W) bool of surface `label` is, or None."""
    rows, cols = np.nonzero(part)
    box = (int(rows.min()), int(cols.min()), int(rows.max()), int(cols.max()))
    span = max(box[2] - box[0], box[3] - box[1]) + 1
    width = int(np.clip(span // 2, *BAND_PX))
    window = (
        slice(max(box[0] - width, 0), box[2] + width + 1),
        slice(max(box[1] - width, 0), box[3] + width + 1),
    )
    inside, around = part[window], labels[window]
    host = _host(inside, around)
    if host in (0, label) or sizes[host] <= pixel_count:
        return None
    if not _predicts(around == host, inside, signal[window]):
        return None
    middle = int(np.argmin((rows - rows.mean()) ** 2 + (cols - cols.mean()) ** 2))
    return Blob(label, host, pixel_count, int(rows[middle]), int(cols[middle]), box)


def _host(inside: NDArray[np.bool_], labels: NDArray[np.integer]) -> int:
    """The surface that holds the ring round a part; 0 when none does."""
    ring = ndimage.binary_dilation(inside, EIGHT, iterations=RING_PX) & ~inside
    held = np.bincount(labels[ring])
    known = held[1:].sum()
    if known < KNOWN_SHARE * ring.sum() or known == 0:
        return 0
    host = int(np.argmax(held[1:])) + 1
    return host if held[host] >= INSIDE_SHARE * known else 0


def _predicts(band: NDArray[np.bool_], inside: NDArray[np.bool_], signal: NDArray[np.float64]) -> bool:
    """Does the quadratic through the signal of `band` explain that of `inside`? All (h, w)."""
    scale = 0.5 * max(signal.shape)
    rows, cols = np.indices(signal.shape)
    y, x = rows / scale - 1, cols / scale - 1
    design = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    terms, values = design[band], signal[band]
    if not len(values):
        return False
    kept = np.ones(len(values), bool)
    size, step = float(np.median(np.abs(values))), _median_step(signal, band)
    for _ in range(3):  # strangers in the band (edges, other things of the same surface) are left out
        if kept.sum() < 2 * terms.shape[1]:
            return False
        model = np.linalg.lstsq(terms[kept], values[kept], rcond=None)[0]
        residual = np.abs(values - terms @ model)
        noise = SIGMAS * 1.4826 * float(np.median(residual))
        tolerance = max(noise, step, RELATIVE_TOLERANCE * size)
        kept = residual <= tolerance
    if noise > max(SMOOTH_STEPS * step, SMOOTH_RELATIVE * size):
        return False
    off = np.abs(signal[inside] - design[inside] @ model)
    return bool(np.mean(off <= tolerance) >= PREDICTED_SHARE)


def _median_step(signal: NDArray[np.float64], band: NDArray[np.bool_]) -> float:
    """Median of the steps between horizontal neighbours of `band` that differ; 0 when none do."""
    steps = np.abs(np.diff(signal, axis=1))[band[:, 1:] & band[:, :-1]]
    steps = steps[steps > 0]
    return float(np.median(steps)) if steps.size else 0.0
