"""Figures that say how good a segmentation is: Hoover's classes, information, overlap, parts, reconstruction.

All label figures come from one contingency table of truth and machine regions, so a frame costs
milliseconds. Three conventions hold everywhere:

- pixels that are invalid in the input are nobody's: they count for no region (an algorithm is not asked
  about them);
- truth regions smaller than 100 px at 640 x 480 (the same share of other sizes) after that are ignored
  together with their pixels: a sliver may be absorbed or found, neither is punished;
- machine regions smaller than that are crumbs. For Hoover's classes their pixels count as unlabelled: taken
  literally, one stray pixel with a label of its own turns the region round it from correct into over-
  segmented, because the pair of them explains one pixel more. They are counted and shown beside the noise,
  and all other figures see them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rcseg_core.datasets import REGIONS
from rcseg_core.errors import InputError
from rcseg_core.evaluation import agreement
from rcseg_core.evaluation.blobs import find_blobs
from rcseg_core.evaluation.hoover import TOLERANCES, contingency, sweep
from rcseg_core.evaluation.metrics import (
    REPORT_TOLERANCE,
    LabelMetrics,
    PartMetrics,
    ReconstructionMetrics,
    SceneMetrics,
)

if TYPE_CHECKING:
    from rcseg_core.datasets import LabelledFrame
    from rcseg_core.evaluation.blobs import Blob
    from rcseg_core.frame import RangeColorFrame
    from rcseg_core.synthetic import SyntheticScene

LEAST_AREA_SHARE = 100 / (640 * 480)
LEAST_BLOB_PX = 25
"""In small images fewer pixels make no blob: too few to say whether a model explains them."""


class HasLabels(Protocol):
    """What is judged: a `Segmentation`, or anything with its label images."""

    @property
    def labels(self) -> NDArray[np.int32]: ...
    @property
    def surface_labels(self) -> NDArray[np.int32]: ...


def object_labels(result: Any) -> NDArray[np.int32]:
    """The objects of a result, and all surfaces that are part of none (floor, walls, support) as one more."""
    labels = np.asarray(result.object_labels, np.int32)
    rest = (labels == 0) & (result.surface_labels > 0)
    return np.where(rest, labels.max(initial=0) + 1, labels).astype(np.int32)


def one_background(truth: NDArray[Any], background: Iterable[int]) -> tuple[NDArray[Any], tuple[int, ...]]:
    """The truth of objects with all that is background under one label, and that label."""
    labels = tuple(background)
    if not labels:
        return truth, ()
    return np.where(np.isin(truth, labels), labels[0], truth), labels[:1]


def least_area(shape: tuple[int, ...]) -> float:
    """Pixels below which a truth region of an image (H, W) is ignored."""
    return LEAST_AREA_SHARE * shape[0] * shape[1]


def without_slivers(
    truth: NDArray[Any], mask: NDArray[np.bool_], minimum_area: float | None = None
) -> NDArray[np.bool_]:
    """`mask` (H, W) without the pixels of truth regions that are too small to count."""
    minimum_area = least_area(truth.shape) if minimum_area is None else minimum_area
    sizes = np.bincount(truth[mask])
    small = sizes < minimum_area
    if len(small):
        small[0] = False
    small = np.append(small, np.zeros(int(truth.max()) + 1 - len(small), bool))
    return np.asarray(mask & ~small[truth])


def evaluate_labels(
    truth: NDArray[Any],
    machine: NDArray[Any],
    *,
    mask: NDArray[np.bool_] | None = None,
    tolerances: Sequence[float] = TOLERANCES,
    minimum_area: float | None = None,
) -> LabelMetrics:
    """Compare two label images.

    Parameters
    ----------
    truth, machine : (H, W) integer, 0 for none
    mask : (H, W) bool, optional
        Pixels that are valid in the input.
    tolerances : shares in (.5, 1]
    minimum_area : float, pixels, optional
        By default 100 px at 640 x 480, scaled by the area of the image.

    Raises
    ------
    InputError
        Shapes differ, labels are not integers, a tolerance is out of range, or no truth region is left.
    """
    mask = np.ones(truth.shape, bool) if mask is None else mask
    minimum_area = least_area(truth.shape) if minimum_area is None else minimum_area
    table = contingency(truth, machine, without_slivers(truth, mask, minimum_area))
    if not len(table.truth_ids):
        raise InputError(
            f"truth: no region of at least {minimum_area:.0f} valid pixels; there is nothing to compare with"
        )
    solid = table.without_crumbs(minimum_area)
    split, merge = agreement.conditional_entropies(table.counts[1:])
    rand, adjusted = agreement.rand_indices(table.counts[1:])
    return LabelMetrics(
        hoover=sweep(solid, tolerances),
        voi_bits=split + merge,
        voi_split_bits=split,
        voi_merge_bits=merge,
        rand=rand,
        adjusted_rand=adjusted,
        covering=agreement.covering(table),
        coverage=agreement.coverage(table),
        truth_regions=len(table.truth_ids),
        machine_regions=len(table.machine_ids),
        crumbs=len(table.machine_ids) - len(solid.machine_ids),
    )


def evaluate_parts(
    truth: NDArray[Any],
    machine: NDArray[Any],
    *,
    mask: NDArray[np.bool_] | None = None,
    background: Iterable[int] = (),
    minimum_area: float | None = None,
) -> PartMetrics:
    """Compare machine regions with whole objects; see `PartMetrics`.

    Parameters
    ----------
    background : labels of the truth, optional
        Support and background: they count for purity, borders and coverage, but are no objects.

    Raises
    ------
    InputError
        As `evaluate_labels`, or when no object is left.
    """
    mask = np.ones(truth.shape, bool) if mask is None else mask
    judged = without_slivers(truth, mask, minimum_area)
    table = contingency(truth, machine, judged)
    objects = ~np.isin(table.truth_ids, list(background))
    if not objects.any():
        raise InputError("truth: no object of sufficient size; there is nothing to compare with")
    best = agreement.intersection_over_union(table).max(axis=1, initial=0.0)
    raw, parts = agreement.count_parts(table, 0.5 * least_area(truth.shape))
    labelled = table.overlap.sum()
    return PartMetrics(
        purity=float(table.overlap.max(axis=0, initial=0).sum() / labelled) if labelled else 0.0,
        boundary_recall=agreement.boundary_recall(truth, machine, mask),
        coverage=agreement.coverage(table),
        parts_per_object=float(parts[objects].mean()),
        raw_parts_per_object=float(raw[objects].mean()),
        best_iou=float(best[objects].mean()),
        whole=float((best[objects] >= REPORT_TOLERANCE).mean()),
        objects=int(objects.sum()),
    )


def evaluate_reconstruction(
    points: NDArray[Any], color: NDArray[np.uint8], scene: SyntheticScene
) -> ReconstructionMetrics:
    """Compare a reconstruction, (H, W, 3) metres and levels, with the scene's clean data."""
    wanted = scene.frame.valid & (scene.labels > 0)
    made = wanted & np.isfinite(points).all(axis=2) & points.any(axis=2)
    if not made.any():
        return ReconstructionMetrics(float("nan"), float("nan"), float("nan"), 0.0)
    error = np.abs(points[made, 2] - scene.clean_points[made, 2]) / scene.sigma_range[made]
    levels = np.abs(color[made].astype(float) - scene.clean_color[made]).max(axis=1)
    return ReconstructionMetrics(
        depth_error_sigmas=float(np.median(error)),
        depth_rms_sigmas=float(np.sqrt(np.mean(error**2))),
        color_error_levels=float(np.median(levels)),
        completeness=float(made.sum() / wanted.sum()),
    )


def evaluate_scene(
    scene: SyntheticScene,
    result: HasLabels,
    *,
    level: str = "regions",
    tolerances: Sequence[float] = TOLERANCES,
    minimum_area: float | None = None,
) -> SceneMetrics:
    """All figures of one synthetic scene.

    Parameters
    ----------
    result : Segmentation
        Its `reconstruct()` is judged too where it has one.
    level : "regions", "surfaces" or "objects"
        Compare `labels` with surface x albedo, `surface_labels` with surfaces, or objects with solids.

    Raises
    ------
    InputError
        Unknown level, or as `evaluate_labels`.
    """
    machine = choose_labels(result, level)
    valid, labels, parts = scene.frame.valid, None, None
    if level == "objects":
        truth, background = one_background(scene.object_labels, scene.background)
        parts = evaluate_parts(truth, machine, mask=valid, background=background, minimum_area=minimum_area)
    else:
        truth = scene.labels if level == "regions" else scene.surface_labels
        labels = evaluate_labels(truth, machine, mask=valid, tolerances=tolerances, minimum_area=minimum_area)
    reconstruction = None
    if hasattr(result, "reconstruct"):
        points, color = result.reconstruct()
        reconstruction = evaluate_reconstruction(points, color, scene)
    return SceneMetrics(
        name=f"{scene.family}_{scene.seed:03d}",
        regions=int(np.count_nonzero(np.bincount(machine.ravel())[1:])),
        labelled=float(np.mean(machine[valid] > 0)),
        level=level,
        blobs=_blobs(machine, scene.frame, level),
        labels=labels,
        parts=parts,
        reconstruction=reconstruction,
    )


def evaluate_frame(
    frame: LabelledFrame,
    result: HasLabels,
    *,
    level: str = "surfaces",
    tolerances: Sequence[float] = TOLERANCES,
    minimum_area: float | None = None,
) -> SceneMetrics:
    """The figures that the truth of a recorded frame allows: Hoover's for regions, parts for objects.

    Without truth the number of regions, the labelled share and, of surfaces, the false blobs are given.

    Raises
    ------
    InputError
        Unknown level, or as `evaluate_labels` and `evaluate_parts`.
    """
    machine, truth = choose_labels(result, level), frame.truth_of(level)
    valid, labels, parts = frame.frame.valid, None, None
    if truth is not None and frame.kind == REGIONS and level != "objects":
        labels = evaluate_labels(truth, machine, mask=valid, tolerances=tolerances, minimum_area=minimum_area)
    elif truth is not None and frame.kind != REGIONS:
        background = frame.background
        if level == "objects":
            truth, background = one_background(truth, background)
        parts = evaluate_parts(truth, machine, mask=valid, background=background, minimum_area=minimum_area)
    return SceneMetrics(
        name=frame.name,
        regions=int(np.count_nonzero(np.bincount(machine.ravel())[1:])),
        labelled=float(np.mean(machine[valid] > 0)),
        level=level,
        blobs=_blobs(machine, frame.frame, level),
        labels=labels,
        parts=parts,
    )


def _blobs(machine: NDArray[np.int32], frame: RangeColorFrame, level: str) -> tuple[Blob, ...] | None:
    """False blobs among surfaces; regions are split by colour, so theirs would say nothing."""
    least = max(least_area(machine.shape), LEAST_BLOB_PX)
    return find_blobs(machine, frame, least) if level == "surfaces" else None


def choose_labels(result: HasLabels, level: str) -> NDArray[np.int32]:
    """`labels`, `surface_labels` or the objects (`object_labels`) of a result.

    Raises
    ------
    InputError
        Unless level is "regions", "surfaces" or "objects".
    """
    if level not in ("regions", "surfaces", "objects"):
        raise InputError(f"level: expected 'regions', 'surfaces' or 'objects', got {level!r}")
    if level == "objects":
        return object_labels(result)
    return result.labels if level == "regions" else result.surface_labels
