"""Before anything is measured: fill holes for the filters, and flag impulses instead of calling them edges.

A median of 5x5 survives nearly half of the pixels being wrong, so a pixel far from it is an impulse (or a
flying pixel): it neither blocks a seed window nor enters a fit. Filled values feed the filters only.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import kernel

#: Holes up to this length along a row are bridged linearly (exact on planes); longer ones by the nearer side.
LINEAR_GAP_PX = 8


@kernel
def fill_rows(image, valid, out):  # type: ignore[no-untyped-def]
    """Fill invalid pixels of a (H, W) float32 image along rows; an empty row copies the row above."""
    height, width = image.shape
    for row in range(height):
        last = -1
        for col in range(width):
            if not valid[row, col]:
                continue
            value = image[row, col]
            out[row, col] = value
            gap = col - last - 1
            if gap > 0:
                if last < 0:
                    for c in range(col):
                        out[row, c] = value
                elif gap <= LINEAR_GAP_PX:
                    left = image[row, last]
                    step = (value - left) / (gap + 1)
                    for c in range(last + 1, col):
                        out[row, c] = left + step * (c - last)
                else:
                    left = image[row, last]
                    middle = last + 1 + gap // 2
                    for c in range(last + 1, middle):
                        out[row, c] = left
                    for c in range(middle, col):
                        out[row, c] = value
            last = col
        if last >= 0:
            for c in range(last + 1, width):
                out[row, c] = image[row, last]
        else:
            for c in range(width):
                out[row, c] = out[row - 1, c] if row > 0 else 0.0
    # leading empty rows take the first row that has a value
    first = 0
    while first < height:
        found = False
        for col in range(width):
            if valid[first, col]:
                found = True
                break
        if found:
            break
        first += 1
    if 0 < first < height:
        for row in range(first):
            for col in range(width):
                out[row, col] = out[first, col]


def local_median(channels: NDArray[np.float32], valid: NDArray[np.bool_], out: NDArray[np.float32]) -> None:
    """5x5 median of each channel of (H, W, C) float32 into `out`, invalid pixels filled along rows first."""
    filled = np.empty(channels.shape[:2], np.float32)
    for c in range(channels.shape[2]):
        fill_rows(channels[..., c], valid, filled)
        out[..., c] = cv2.medianBlur(filled, 5)


def color_median(color: NDArray[np.uint8], out: NDArray[np.uint8]) -> None:
    """5x5 median of each colour channel into `out`."""
    out[...] = cv2.medianBlur(np.ascontiguousarray(color), 5)
