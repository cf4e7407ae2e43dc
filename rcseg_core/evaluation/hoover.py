"""Hoover et al. (1996): every truth region and every machine region falls into exactly one class.

A. Hoover et al., "An experimental comparison of range image segmentation algorithms", IEEE PAMI 18(7),
1996. One contingency table holds all that the definitions need: O[n, m] pixels that truth region n and
machine region m share, their sizes P[n] and P[m]. For a tolerance T in (.5, 1]:

correct  n and m share at least T of both;
over     n holds two or more machine regions by at least T of each, and they cover at least T of n;
under    m holds two or more truth regions by at least T of each, and they cover at least T of m;
missed   a truth region in none of these;   noise   a machine region in none of these.

A region may satisfy up to three of the definitions at once. The instance with the largest average overlap
then wins (the mean of the share of the truth and the share of the machine regions that it explains), ties
in the order correct, over, under; an instance that lost one of its regions to a better one is void as a
whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.errors import InputError

CORRECT, OVER, UNDER, MISSED, NOISE = "correct", "over", "under", "missed", "noise"
TOLERANCES: tuple[float, ...] = (0.51, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95)
"""The sweep that reports use, as in Hoover's figures."""


@dataclass(frozen=True)
class Contingency:
    """Shared pixels of truth and machine regions.

    Attributes
    ----------
    counts : (N + 1, M + 1) int64
        Row 0: pixels without a truth region; column 0: pixels that the machine left unlabelled.
    truth_ids, machine_ids : (N,), (M,) int64
        The label of each row after the first, and of each column after the first.
    """

    counts: NDArray[np.int64]
    truth_ids: NDArray[np.int64]
    machine_ids: NDArray[np.int64]

    @property
    def overlap(self) -> NDArray[np.int64]:
        """(N, M): O[n, m]."""
        return self.counts[1:, 1:]

    @property
    def truth_sizes(self) -> NDArray[np.int64]:
        """(N,): P[n], the machine's unlabelled pixels included."""
        return np.asarray(self.counts[1:].sum(axis=1))

    @property
    def machine_sizes(self) -> NDArray[np.int64]:
        """(M,): P[m], pixels without a truth region included."""
        return np.asarray(self.counts[:, 1:].sum(axis=0))

    def without_crumbs(self, minimum_area: float) -> Contingency:
        """The table with machine regions of less than `minimum_area` pixels turned into unlabelled pixels."""
        kept = self.machine_sizes >= minimum_area
        columns = np.concatenate([[True], kept])
        counts = self.counts[:, columns].copy()
        counts[:, 0] += self.counts[:, ~columns].sum(axis=1)
        return Contingency(counts, self.truth_ids, self.machine_ids[kept])


def contingency(
    truth: NDArray[Any], machine: NDArray[Any], mask: NDArray[np.bool_] | None = None
) -> Contingency:
    """Count shared pixels.

    Parameters
    ----------
    truth, machine : (H, W) integer labels, 0 for none
    mask : (H, W) bool, optional
        Pixels that count; the others are nobody's.

    Raises
    ------
    InputError
        Images of different shape, or labels that are not integers or are negative.
    """
    for name, labels in (("truth", truth), ("machine", machine)):
        if not np.issubdtype(labels.dtype, np.integer):
            raise InputError(f"{name} labels: expected integers, got {labels.dtype}")
        if labels.size and labels.min() < 0:
            raise InputError(f"{name} labels: expected 0 (none) or positive numbers, got {labels.min()}")
    if truth.shape != machine.shape or (mask is not None and mask.shape != truth.shape):
        shapes = f"truth {truth.shape}, machine {machine.shape}" + (
            "" if mask is None else f", mask {mask.shape}"
        )
        raise InputError(f"labels must share one pixel grid, got {shapes}")
    if mask is not None:
        truth, machine = truth[mask], machine[mask]
    truth_ids, rows = _compact(truth.ravel())
    machine_ids, cols = _compact(machine.ravel())
    width = len(machine_ids) + 1
    counts = np.bincount(rows * width + cols, minlength=(len(truth_ids) + 1) * width)
    return Contingency(counts.reshape(-1, width).astype(np.int64), truth_ids, machine_ids)


def _compact(labels: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The positive labels in order, and each pixel's index among them plus 1 (0 stays 0)."""
    present = np.bincount(labels) > 0 if labels.size else np.zeros(1, bool)
    present[0] = False
    ids = np.flatnonzero(present)
    index = np.zeros(len(present), np.int64)
    index[ids] = np.arange(1, len(ids) + 1)
    return ids.astype(np.int64), index[labels]


class Instance(NamedTuple):
    """One case of a definition: its class, the rows and columns of the table it joins, its overlap."""

    kind: str
    truth: tuple[int, ...]
    machine: tuple[int, ...]
    average: float


@dataclass(frozen=True)
class HooverResult:
    """Classes at one tolerance.

    Attributes
    ----------
    truth_class, machine_class : tuple of str
        For each row and each column of the contingency table.
    instances : tuple of Instance
        The accepted cases of correct, over and under.
    matched : int
        Truth regions for which the definition of correct holds, whether or not another instance explains them
        better: a region found up to a crust that became a region of its own is matched, yet over-segmented.
    """

    tolerance: float
    truth_class: tuple[str, ...]
    machine_class: tuple[str, ...]
    instances: tuple[Instance, ...]
    matched: int

    @property
    def correct(self) -> int:
        """Truth regions found, one machine region each."""
        return self.truth_class.count(CORRECT)

    @property
    def over(self) -> int:
        """Truth regions broken into several machine regions."""
        return self.truth_class.count(OVER)

    @property
    def under(self) -> int:
        """Truth regions that share one machine region with others."""
        return self.truth_class.count(UNDER)

    @property
    def missed(self) -> int:
        return self.truth_class.count(MISSED)

    @property
    def noise(self) -> int:
        """Machine regions that stand for no truth region."""
        return self.machine_class.count(NOISE)

    @property
    def truth_regions(self) -> int:
        return len(self.truth_class)

    def counts(self) -> dict[str, int]:
        """Truth regions, the number in each class (the first four sum to them), and `matched`."""
        keys = ("truth_regions", "correct", "over", "under", "missed", "noise", "matched")
        return {key: int(getattr(self, key)) for key in keys}


def classify(table: Contingency, tolerance: float) -> HooverResult:
    """Hoover's classification at one tolerance.

    Raises
    ------
    InputError
        Unless .5 < tolerance <= 1: at or below one half the definitions are ambiguous.
    """
    if not 0.5 < tolerance <= 1:
        raise InputError(f"tolerance: expected a share above 0.5 and at most 1, got {tolerance}")
    overlap = table.overlap.astype(float)
    truth_share = overlap / np.maximum(table.truth_sizes, 1)[:, None]
    machine_share = overlap / np.maximum(table.machine_sizes, 1)[None, :]
    matches = _correct(truth_share, machine_share, tolerance)
    found = [
        *matches,
        *_split(OVER, table.overlap, table.truth_sizes, table.machine_sizes, machine_share, tolerance),
        *_split(UNDER, table.overlap.T, table.machine_sizes, table.truth_sizes, truth_share.T, tolerance),
    ]
    found.sort(key=lambda instance: -instance.average)  # stable: ties stay in the order correct, over, under
    truth_class, machine_class = [MISSED] * len(overlap), [NOISE] * overlap.shape[1]
    accepted = []
    for instance in found:
        taken = any(truth_class[n] != MISSED for n in instance.truth)
        if taken or any(machine_class[m] != NOISE for m in instance.machine):
            continue
        accepted.append(instance)
        for n in instance.truth:
            truth_class[n] = instance.kind
        for m in instance.machine:
            machine_class[m] = instance.kind
    return HooverResult(tolerance, tuple(truth_class), tuple(machine_class), tuple(accepted), len(matches))


def sweep(table: Contingency, tolerances: Sequence[float] = TOLERANCES) -> tuple[HooverResult, ...]:
    """The classification at each of several tolerances."""
    return tuple(classify(table, tolerance) for tolerance in tolerances)


def _correct(truth_share: NDArray[Any], machine_share: NDArray[Any], tolerance: float) -> list[Instance]:
    pairs = np.argwhere((truth_share >= tolerance) & (machine_share >= tolerance))
    return [
        Instance(CORRECT, (int(n),), (int(m),), float(truth_share[n, m] + machine_share[n, m]) / 2)
        for n, m in pairs
    ]


def _split(
    kind: str,
    overlap: NDArray[np.int64],
    whole_sizes: NDArray[np.int64],
    part_sizes: NDArray[np.int64],
    part_share: NDArray[Any],
    tolerance: float,
) -> list[Instance]:
    """Wholes (rows) that hold two or more parts (columns): over-segmentation; transposed, under."""
    held = part_share >= tolerance
    held_pixels = np.where(held, overlap, 0).sum(axis=1)
    wholes = np.flatnonzero((held.sum(axis=1) >= 2) & (held_pixels >= tolerance * whole_sizes))
    found = []
    for whole in wholes:
        parts = tuple(int(p) for p in np.flatnonzero(held[whole]))
        explained = held_pixels[whole] / whole_sizes[whole]
        average = float(explained + held_pixels[whole] / part_sizes[list(parts)].sum()) / 2
        one = (int(whole),)
        found.append(
            Instance(kind, one, parts, average) if kind == OVER else Instance(kind, parts, one, average)
        )
    return found
