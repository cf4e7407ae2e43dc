"""The rules of EVOPS: how well recognised planes match the planes of the truth.

A. Kornilova et al., "EVOPS Benchmark: Evaluation of Plane Segmentation from RGBD and LiDAR Data", IROS 2022.
A machine plane is right when its intersection over union with a plane of the truth is .75 or more, which at
most one of each can reach. Whatever was not recognised as a plane, and whatever is none in the truth, counts
as unsegmented there. Of the house's conventions (see `evaluation`) two hold here too: invalid pixels are
nobody's, and slivers of the truth are ignored with their pixels. Small machine planes count like all others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rcseg_core.evaluation.agreement import intersection_over_union
from rcseg_core.evaluation.hoover import contingency

FULL_IOU = 0.75
"""A plane that overlaps one of the truth by so much is found."""
PART_IOU = 0.2
"""Planes that overlap by so much have to do with each other."""
FIGURES = ("precision", "recall", "f_score", "mean_iou", "panoptic", "over_ratio", "under_ratio")
FLAT = 1e-6
"""Mean squares of exact unit normals across their mean that rounding explains."""


class HasPrimitive(Protocol):
    """A `Surface`, or anything with its label and shape."""

    @property
    def label(self) -> int: ...
    @property
    def primitive(self) -> Any: ...


@dataclass(frozen=True)
class PlaneMetrics:
    """How well machine planes match the planes of the truth.

    Attributes
    ----------
    truth_planes, machine_planes : int
    matched : int
        Pairs with an intersection over union of `FULL_IOU` and more.
    over, under : int
        Truth planes that `PART_IOU` and more connects with two or more machine planes, and the reverse.
    missed, noise : int
        Truth and machine planes that are neither matched, nor part of a case of over or under.
    mean_iou : float
        Mean intersection over union of the matched pairs; 0 without any.
    """

    truth_planes: int
    machine_planes: int
    matched: int
    over: int
    under: int
    missed: int
    noise: int
    mean_iou: float

    @property
    def precision(self) -> float:
        """Matched over machine planes; 0 without any."""
        return self.matched / self.machine_planes if self.machine_planes else 0.0

    @property
    def recall(self) -> float:
        """Matched over truth planes; 0 without any."""
        return self.matched / self.truth_planes if self.truth_planes else 0.0

    @property
    def f_score(self) -> float:
        """Harmonic mean of precision and recall; 0 without a match."""
        total = self.machine_planes + self.truth_planes
        return 2.0 * self.matched / total if total else 0.0

    @property
    def panoptic(self) -> float:
        """`mean_iou` times `f_score`."""
        return self.mean_iou * self.f_score

    @property
    def over_ratio(self) -> float:
        """Share of the truth planes that are over-segmented."""
        return self.over / self.truth_planes if self.truth_planes else 0.0

    @property
    def under_ratio(self) -> float:
        """Share of the machine planes that are under-segmented."""
        return self.under / self.machine_planes if self.machine_planes else 0.0

    def counts(self) -> dict[str, int]:
        """What is summed over frames, by name."""
        keys = ("truth_planes", "machine_planes", "matched", "over", "under", "missed", "noise")
        return {key: int(getattr(self, key)) for key in keys}

    def figures(self) -> dict[str, float]:
        """What is averaged over frames, by name; NaN where there is no plane and none was found."""
        if not self.truth_planes + self.machine_planes:
            return dict.fromkeys(FIGURES, float("nan"))
        return {key: float(getattr(self, key)) for key in FIGURES}


def plane_labels(surface_labels: NDArray[np.integer], surfaces: Sequence[HasPrimitive]) -> NDArray[np.int32]:
    """(H, W) int32, the surfaces that were recognised as planes; 0 elsewhere."""
    number = np.zeros(int(surface_labels.max(initial=0)) + 1, np.int32)
    for surface in surfaces:
        if surface.primitive.kind == "plane":
            number[surface.label] = surface.label
    return np.asarray(number[surface_labels])


def flat_labels(labels: NDArray[np.integer], normals: NDArray[np.floating]) -> NDArray[np.int32]:
    """Those of the truth's labels whose exact unit normals (H, W, 3) are all one direction; 0 elsewhere.

    A label without a normal (NaN) is no plane.
    """
    flat, many = labels.ravel(), normals.reshape(-1, 3).astype(np.float64)
    known = np.isfinite(many).all(axis=1) & (flat > 0)
    flat, many = flat[known], many[known]
    size = int(labels.max(initial=0)) + 1
    count = np.maximum(np.bincount(flat, minlength=size), 1)
    square = np.zeros((size, 3, 3))
    for i in range(3):
        for j in range(i + 1):
            square[:, i, j] = square[:, j, i] = np.bincount(flat, many[:, i] * many[:, j], size) / count
    values = np.linalg.eigvalsh(square)
    number = np.arange(size, dtype=np.int32)
    number[(values[:, 1] > FLAT) | (values[:, 2] < 0.5)] = 0
    return np.asarray(number[labels])


def evaluate_planes(
    truth: NDArray[Any], machine: NDArray[Any], mask: NDArray[np.bool_] | None = None
) -> PlaneMetrics:
    """Compare two label images of planes.

    Parameters
    ----------
    truth, machine : (H, W) integer, 0 where there is no plane
    mask : (H, W) bool, optional
        Pixels that count.

    Raises
    ------
    InputError
        As `hoover.contingency`.
    """
    table = contingency(truth, machine, mask)
    iou = intersection_over_union(table)
    full, part = iou >= FULL_IOU, iou >= PART_IOU
    parts_of_truth, parts_of_machine = part.sum(axis=1), part.sum(axis=0)
    # a single partner by part only is none, unless that partner is shared with others
    shared = part & ((parts_of_machine[None, :] > 1) | (parts_of_truth[:, None] > 1))
    return PlaneMetrics(
        truth_planes=len(table.truth_ids),
        machine_planes=len(table.machine_ids),
        matched=int(full.sum()),
        over=int((parts_of_truth > 1).sum()),
        under=int((parts_of_machine > 1).sum()),
        missed=int((~(full | shared).any(axis=1)).sum()),
        noise=int((~(full | shared).any(axis=0)).sum()),
        mean_iou=float(iou[full].mean()) if full.any() else 0.0,
    )
