"""Figures of several frames together: the numbers that targets are set on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rcseg_core.evaluation.metrics import REPORT_TOLERANCE, SceneMetrics


@dataclass(frozen=True)
class Pooled:
    """Figures of several frames together: regions and objects are summed, the rest is averaged over frames.

    `counts` holds, for each tolerance, the sums of truth regions, correct, over, under, missed and noise,
    `planes` the sums of what `PlaneMetrics.counts` gives, empty unless planes were judged;
    `means` the average of every other figure over the frames that have it (NaN left out), per-object
    figures weighted by objects. `level` is what was judged, "regions", "surfaces" or "objects".
    """

    name: str
    level: str
    frames: int
    counts: dict[float, dict[str, int]]
    means: dict[str, float]
    planes: dict[str, int] = field(default_factory=dict)

    def correct(self, tolerance: float = REPORT_TOLERANCE) -> float:
        """Correct detections over truth regions, both summed over all frames; NaN without region truth."""
        counts = self.counts.get(tolerance)
        return counts["correct"] / counts["truth_regions"] if counts else float("nan")

    def row(self, tolerance: float = REPORT_TOLERANCE) -> dict[str, Any]:
        row: dict[str, Any] = {"name": self.name, "labels": self.level, "frames": self.frames}
        if tolerance in self.counts:
            row |= {"correct_share": self.correct(tolerance), **self.counts[tolerance]}
        return row | self.planes | self.means


_PER_OBJECT = ("parts_per_object", "raw_parts_per_object", "best_iou", "whole")


def pool(name: str, scenes: Sequence[SceneMetrics]) -> Pooled:
    """Pool the figures of frames that were judged on the same level; see `Pooled`."""
    counts: dict[float, dict[str, int]] = {}
    for scene in scenes:
        for result in scene.labels.hoover if scene.labels else ():
            sums = counts.setdefault(result.tolerance, {})
            for key, number in result.counts().items():
                sums[key] = sums.get(key, 0) + number
    planes = [scene.planes.counts() for scene in scenes if scene.planes is not None]
    plane_sums = {key: sum(row[key] for row in planes) for key in planes[0]} if planes else {}
    values: dict[str, list[tuple[float, float]]] = {}
    for scene in scenes:
        row = scene.figures()
        for key, value in row.items():
            if key != "objects" and np.isfinite(value):
                weight = row["objects"] if key in _PER_OBJECT else 1.0
                values.setdefault(key, []).append((value, weight))
    means = {
        key: float(np.average([v for v, _ in pairs], weights=[w for _, w in pairs]))
        for key, pairs in values.items()
    }
    return Pooled(name, scenes[0].level if scenes else "", len(scenes), counts, means, plane_sums)
