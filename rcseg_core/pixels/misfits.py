"""Misfits: pixels that got the label of a neighbour although no model predicts them, and count for no fit."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.signal.signals import MISFIT


@bare
def _mark(labels, found, flags, left):  # type: ignore[no-untyped-def]
    height, width = labels.shape
    for row in range(height):
        for col in range(width):
            if flags[row, col] == 0 and found[row, col] & MISFIT == 0:
                left[labels[row, col]] = 1
    for row in range(height):
        for col in range(width):
            if found[row, col] & MISFIT != 0 and left[labels[row, col]] != 0:
                flags[row, col] |= MISFIT


@bare
def _mark_taken(labels, before, flags):  # type: ignore[no-untyped-def]
    for row in range(labels.shape[0]):
        for col in range(labels.shape[1]):
            if before[row, col] == 0 and labels[row, col] > 0:
                flags[row, col] |= MISFIT


def mark_misfits(
    labels: NDArray[np.int32], count: int, found: NDArray[np.uint8], flags: NDArray[np.uint8]
) -> None:
    """Mark in `flags` the misfits of `found`, but those of regions that would be left without a pixel.

    labels : (H, W), 1..count; found, flags : (H, W) of a pass and of the signals that go on
    """
    _mark(labels, found, flags, np.zeros(count + 1, np.uint8))


def mark_taken(labels: NDArray[np.int32], before: NDArray[np.int32], flags: NDArray[np.uint8]) -> None:
    """Mark the pixels that have a label now and had none before."""
    _mark_taken(labels, before, flags)
