"""What `rcseg evaluate --planes` says about a frame: recognised planes against those of its truth."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rcseg_core.datasets import REGIONS
from rcseg_core.evaluation.frames import without_slivers
from rcseg_core.evaluation.metrics import SceneMetrics
from rcseg_core.evaluation.plane_metrics import evaluate_planes, flat_labels, plane_labels

if TYPE_CHECKING:
    from rcseg_core.datasets import LabelledFrame
    from rcseg_core.result.segmentation import Segmentation
    from rcseg_core.synthetic import SyntheticScene

PLANES = "planes"
"""The level of `SceneMetrics` that recognised planes are judged on."""


def planes_of_scene(scene: SyntheticScene, result: Segmentation) -> SceneMetrics:
    """Recognised planes against the flat surfaces of a synthetic scene; balls and cylinders are no planes."""
    truth = scene.surface_labels
    judged = without_slivers(truth, scene.frame.valid)
    name = f"{scene.family}_{scene.seed:03d}"
    return _compared(name, flat_labels(truth, scene.normals), result, judged, scene.frame.valid)


def planes_of_frame(frame: LabelledFrame, result: Segmentation) -> SceneMetrics:
    """Recognised planes against the regions of a recorded frame's truth, all of which count as planes.

    Where the truth is of objects, or missing, the number of planes and their share of the pixels is all.
    """
    valid = frame.frame.valid
    truth = frame.truth_of("surfaces") if frame.kind == REGIONS else None
    judged = valid if truth is None else without_slivers(truth, valid)
    return _compared(frame.name, truth, result, judged, valid)


def _compared(
    name: str,
    truth: NDArray[np.int32] | None,
    result: Segmentation,
    judged: NDArray[np.bool_],
    valid: NDArray[np.bool_],
) -> SceneMetrics:
    machine = plane_labels(result.surface_labels, result.surfaces)
    return SceneMetrics(
        name=name,
        regions=int(np.count_nonzero(np.bincount(machine.ravel())[1:])),
        labelled=float(np.mean(machine[valid] > 0)),
        level=PLANES,
        planes=None if truth is None else evaluate_planes(truth, machine, judged),
    )
