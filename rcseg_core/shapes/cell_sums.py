"""Sums over the pixels of the cells of surfaces, see `cells`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.models.polynomials import along_row, predict
from rcseg_core.signal.signals import INVALID, MISFIT, RANGE_OUTLIER
from rcseg_core.signal.units import UNIT_PX

UNUSABLE = INVALID | RANGE_OUTLIER | MISFIT


class Layout(NamedTuple):
    """Cells of surfaces 1..M: first cell, pitch, box (row_min, col_min, rows and columns of cells) of each,
    the margin that is left out; rows and columns whose index has a bit in common with `skip` are left out."""

    first: NDArray[np.int64]
    pitch: NDArray[np.int64]
    box: NDArray[np.int64]
    margin: NDArray[np.int64]
    skip: NDArray[np.int64]


@bare
def _mark_row(own, other, rim):  # type: ignore[no-untyped-def]
    """Mark where another surface lies in a row beside."""
    for i in range(own.size):
        rim[i] |= (other[i] != own[i]) & (other[i] > 0)


@bare
def mark_rims(surfaces, margin, rim):  # type: ignore[no-untyped-def]
    """rim (H, W): whether another surface lies within the margin along the row or the column."""
    height, width = surfaces.shape
    for row in range(height):
        own, marks = surfaces[row], rim[row]
        marks[:] = False
        if row >= margin:
            _mark_row(own, surfaces[row - margin], marks)
        if row + margin < height:
            _mark_row(own, surfaces[row + margin], marks)
        if width > margin:
            _mark_row(own[margin:], own[: width - margin], marks[margin:])
            _mark_row(own[: width - margin], own[margin:], marks[: width - margin])


@bare
def _count_usable(flags, rim):  # type: ignore[no-untyped-def]
    """Usable pixels of a run, and those of them off the rim; without a branch, several at a time."""
    usable, inner = 0, 0
    for i in range(flags.size):
        good = (flags[i] & UNUSABLE) == 0
        usable += good
        inner += good & (not rim[i])
    return usable, inner


@bare
def measure_extent(labels, surfaces, rim, flags, degree, count, core, bent, box):  # type: ignore[no-untyped-def]
    """Usable pixels of each surface, those off its rim, whether a patch of it has a degree (N + 1,) above 1,
    and its box (row_min, col_min, row_max, col_max)."""
    height, width = surfaces.shape
    for row in range(height):
        end = 0
        while end < width:
            start, s, k = end, surfaces[row, end], labels[row, end]
            while end < width and surfaces[row, end] == s and labels[row, end] == k:
                end += 1
            if s <= 0:
                continue
            usable, inner = _count_usable(flags[row, start:end], rim[row, start:end])
            if usable == 0:
                continue
            first, last = start, end - 1
            while flags[row, first] & UNUSABLE:
                first += 1
            while flags[row, last] & UNUSABLE:
                last -= 1
            count[s] += usable
            core[s] += inner
            bent[s] |= degree[k] > 1
            box[s, 0] = min(box[s, 0], row)
            box[s, 1] = min(box[s, 1], first)
            box[s, 2] = max(box[s, 2], row)
            box[s, 3] = max(box[s, 3], last)


@bare
def gather(labels, surfaces, rim, signals, flags, n_range, models, layout, line, owner, sums):  # type: ignore[no-untyped-def]
    """Sums over the pixels of each cell: n, row, col, squared residuals, residuals of each range channel.

    A cell belongs to the region of its first pixel, since patches of two regions have no common residual.
    line : (Cr, D + 1) scratch
    """
    height, width = labels.shape
    for row in range(height):
        end = 0
        while end < width:
            start, s, k = end, surfaces[row, end], labels[row, end]
            while end < width and surfaces[row, end] == s and labels[row, end] == k:
                end += 1
            if s <= 0 or layout.pitch[s] <= 0 or row & layout.skip[s]:
                continue
            along_row(models, k, row, n_range, line)
            down = row - layout.box[s, 0]
            pitch, left = layout.pitch[s], layout.box[s, 1]
            start, right = max(start, left), min(end, left + pitch * layout.box[s, 3])
            if down < 0 or down >= pitch * layout.box[s, 2]:
                continue
            first = layout.first[s] + down // pitch * layout.box[s, 3]
            while start < right:
                place = (start - left) // pitch
                stop = min(right, left + (place + 1) * pitch)
                _add(start, stop, row, k, rim, signals, flags, n_range, models, layout.skip[s],
                     layout.margin[s] > 0, line, first + place, owner, sums)  # fmt: skip
                start = stop


@bare
def _add(start, stop, row, k, rim, signals, flags, n_range, models, skip, core, line, cell, owner, sums):  # type: ignore[no-untyped-def]
    """Add pixels start..stop-1 of a row, all of one region, to a cell; see `gather`."""
    degree, center = models.degree[k, 0], models.center[k, 0]
    if owner[cell] != 0 and owner[cell] != k:
        return
    # sums in registers: in an array each would wait for the one before
    n, cols, squares, first = sums[cell, 0], sums[cell, 2], sums[cell, 3], sums[cell, 4]
    before = n
    for col in range(start, stop):
        if col & skip or flags[row, col] & UNUSABLE or (core and rim[row, col]):
            continue
        n += 1.0
        cols += col
        x = (float(col) - center) / UNIT_PX
        for c in range(n_range):
            total = 0.0
            for a in range(degree, -1, -1):
                total = total * x + line[c, a]
            d = signals[row, col, c] - total
            squares += d * d
            if c == 0:
                first += d
            else:
                sums[cell, 4 + c] += d
    if n > before:
        owner[cell] = k
        sums[cell, 0], sums[cell, 2], sums[cell, 3], sums[cell, 4] = n, cols, squares, first
        sums[cell, 1] += row * (n - before)


@bare
def evaluate(models, owner, sums, n_range, out):  # type: ignore[no-untyped-def]
    """Patch of each cell at its centre of gravity: value, change a row, change a column, of each channel."""
    for cell in range(owner.shape[0]):
        k = owner[cell]
        row = sums[cell, 1] / sums[cell, 0]
        col = sums[cell, 2] / sums[cell, 0]
        for c in range(n_range):
            out[cell, c, 0] = predict(models, k, row, col, 0, c)
            out[cell, c, 1] = 0.5 * (
                predict(models, k, row + 1.0, col, 0, c) - predict(models, k, row - 1.0, col, 0, c)
            )
            out[cell, c, 2] = 0.5 * (
                predict(models, k, row, col + 1.0, 0, c) - predict(models, k, row, col - 1.0, 0, c)
            )
