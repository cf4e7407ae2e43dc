"""Measures of agreement between two partitions of an image, computed from their contingency table.

Information, pair counting, overlap, parts and borders; `evaluation` says what each is for and under which
conventions they are applied.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from rcseg_core.evaluation.hoover import Contingency


def conditional_entropies(counts: NDArray[np.int64]) -> tuple[float, float]:
    """H(column | row) and H(row | column) in bits of a table of counts."""
    p = counts / counts.sum()
    rows, cols = p.sum(axis=1, keepdims=True), p.sum(axis=0, keepdims=True)
    some = p > 0
    given_row = -np.sum(p[some] * np.log2((p / np.where(rows > 0, rows, 1))[some]))
    given_col = -np.sum(p[some] * np.log2((p / np.where(cols > 0, cols, 1))[some]))
    return max(float(given_row), 0.0), max(float(given_col), 0.0)


def rand_indices(counts: NDArray[np.int64]) -> tuple[float, float]:
    """Rand index and adjusted Rand index (Hubert & Arabie 1985) of a table of counts."""
    n = float(counts.sum())
    pairs = n * (n - 1) / 2
    if pairs == 0:
        return 1.0, 1.0
    together = _pairs(counts).sum()
    in_rows, in_cols = _pairs(counts.sum(axis=1)).sum(), _pairs(counts.sum(axis=0)).sum()
    rand = float((pairs + 2 * together - in_rows - in_cols) / pairs)
    expected = in_rows * in_cols / pairs
    most = (in_rows + in_cols) / 2
    return rand, float((together - expected) / (most - expected)) if most > expected else 1.0


def _pairs(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    values = counts.astype(float)
    return np.asarray(values * (values - 1) / 2)


def intersection_over_union(table: Contingency) -> NDArray[np.float64]:
    """(N, M): IoU of every truth region with every machine region."""
    union = table.truth_sizes[:, None] + table.machine_sizes[None, :] - table.overlap
    return np.asarray(table.overlap / np.maximum(union, 1))


def covering(table: Contingency) -> float:
    """Arbelaez et al. 2011: sum over truth regions of their share of the pixels times their best IoU."""
    if not len(table.machine_ids):
        return 0.0
    best = intersection_over_union(table).max(axis=1)
    return float(best @ table.truth_sizes / table.truth_sizes.sum())


def coverage(table: Contingency) -> float:
    """Share of the truth's pixels that carry a machine label."""
    return float(1 - table.counts[1:, 0].sum() / table.counts[1:].sum())


def count_parts(table: Contingency, crumb_px: float) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Raw and weighted number of parts of each truth region (N,), by the rule in `PartMetrics`."""
    scale = np.maximum(crumb_px, 0.01 * table.truth_sizes)
    unlabelled = table.counts[1:, 0] / scale
    raw = np.zeros(len(table.truth_ids), np.int64)
    weighted = unlabelled.astype(float)
    for part in np.flatnonzero(table.overlap.sum(axis=0)):
        owner = int(np.argmax(table.overlap[:, part]))
        raw[owner] += 1
        weighted[owner] += min(1.0, table.overlap[owner, part] / scale[owner])
    return raw, np.maximum(weighted, 1.0)


def boundary_recall(
    truth: NDArray[Any], machine: NDArray[Any], mask: NDArray[np.bool_], *, within_px: float = 2.0
) -> float:
    """Share of truth border pixels with a machine border within `within_px`; NaN without truth borders.

    A pixel is on a border when a 4-neighbour has another label. On the truth both must be labelled; on the
    machine's side a step to unlabelled counts, but never a step to a pixel that is invalid in the input.
    """
    wanted = borders(truth, mask & (truth > 0))
    if not wanted.any():
        return float("nan")
    drawn = borders(machine, mask)
    if not drawn.any():
        return 0.0
    distance = ndimage.distance_transform_edt(~drawn)
    return float(np.count_nonzero(distance[wanted] <= within_px) / np.count_nonzero(wanted))


def borders(labels: NDArray[Any], mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels (H, W) of `mask` with a 4-neighbour in `mask` of another label."""
    border = np.zeros(labels.shape, bool)
    down = (labels[1:] != labels[:-1]) & mask[1:] & mask[:-1]
    right = (labels[:, 1:] != labels[:, :-1]) & mask[:, 1:] & mask[:, :-1]
    border[1:] |= down
    border[:-1] |= down
    border[:, 1:] |= right
    border[:, :-1] |= right
    return border
