"""What an evaluation reports about one frame; each figure is defined here, in its field's description."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from rcseg_core.errors import InputError
from rcseg_core.evaluation.blobs import Blob
from rcseg_core.evaluation.hoover import HooverResult
from rcseg_core.evaluation.plane_metrics import PlaneMetrics

REPORT_TOLERANCE = 0.8
"""The overlap at which a region counts as found in tables and targets."""


@dataclass(frozen=True)
class LabelMetrics:
    """How well machine regions match truth regions.

    Attributes
    ----------
    hoover : tuple of HooverResult
        One for each tolerance of the sweep.
    voi_bits : float
        Variation of information H(truth | machine) + H(machine | truth), base 2; 0 is perfect. Unlabelled
        pixels form one machine region of their own.
    voi_split_bits, voi_merge_bits : float
        Its two terms: H(machine | truth) grows with over-, H(truth | machine) with under-segmentation.
    rand, adjusted_rand : float
        Share of pixel pairs on which both agree; the same corrected for chance. Unlabelled as for `voi_bits`.
    covering : float
        Mean over truth pixels of the best intersection over union of their region with a machine region.
    coverage : float
        Share of truth pixels that carry a machine label.
    truth_regions, machine_regions : int
    crumbs : int
        Machine regions below the minimum area.
    """

    hoover: tuple[HooverResult, ...]
    voi_bits: float
    voi_split_bits: float
    voi_merge_bits: float
    rand: float
    adjusted_rand: float
    covering: float
    coverage: float
    truth_regions: int
    machine_regions: int
    crumbs: int

    def at(self, tolerance: float = REPORT_TOLERANCE) -> HooverResult:
        """The classification at one tolerance of the sweep.

        Raises
        ------
        InputError
            When the sweep does not hold this tolerance.
        """
        for result in self.hoover:
            if abs(result.tolerance - tolerance) < 1e-9:
                return result
        known = ", ".join(f"{r.tolerance:g}" for r in self.hoover)
        raise InputError(f"tolerance {tolerance:g} was not evaluated; the sweep holds {known}")


@dataclass(frozen=True)
class PartMetrics:
    """Figures for truth that labels whole objects, of which a machine region may be a part.

    Attributes
    ----------
    purity : float
        Share of labelled truth pixels that lie in the truth object which holds most of their machine region.
    boundary_recall : float
        Share of the pixels on a border of two truth objects that have a machine border within 2 px
        (Euclidean). NaN when no two truth objects touch.
    coverage : float
        Share of truth pixels that carry a machine label.
    parts_per_object : float
        Mean over objects. A machine region is a part of the object that holds most of it. It counts
        min(1, pixels / s) with s the larger of 50 px (at 640 x 480) and 1 % of the object; each unlabelled
        pixel of the object counts 1 / s. So crumbs count by their area: neither breaking a region into
        crumbs nor leaving pixels unlabelled ever lowers the figure. An object without any part counts as 1.
    raw_parts_per_object : float
        The plain number of machine regions, of any size, that lie mainly in the object.
    best_iou : float
        Mean over objects of the largest intersection over union with a single machine region.
    objects : int
    whole : float
        Share of the objects of which that is 80 % or more.
    """

    purity: float
    boundary_recall: float
    coverage: float
    parts_per_object: float
    raw_parts_per_object: float
    best_iou: float
    objects: int
    whole: float = float("nan")


@dataclass(frozen=True)
class ReconstructionMetrics:
    """Error of the reconstruction against the noise-free scene, over valid pixels that were reconstructed.

    Attributes
    ----------
    depth_error_sigmas : float
        Median of |z - z_true| / sigma_z, sigma_z the sensor's own noise at the pixel.
    depth_rms_sigmas : float
        Root mean square of the same.
    color_error_levels : float
        Median over pixels of the largest channel's |error|, 0-255 levels.
    completeness : float
        Share of the valid truth pixels that were reconstructed.
    """

    depth_error_sigmas: float
    depth_rms_sigmas: float
    color_error_levels: float
    completeness: float


@dataclass(frozen=True)
class SceneMetrics:
    """All figures of one frame; None where its truth does not allow them.

    `level`: what was judged, "regions", "surfaces", "objects" or "planes"; `regions`: machine regions
    of that level; `labelled`: share of the valid pixels that carry a label; `blobs`: surfaces inside of
    larger ones that explain them (`find_blobs`), judged on surfaces only.
    """

    name: str
    regions: int
    labelled: float
    level: str = "regions"
    blobs: tuple[Blob, ...] | None = None
    labels: LabelMetrics | None = None
    parts: PartMetrics | None = None
    reconstruction: ReconstructionMetrics | None = None
    planes: PlaneMetrics | None = None

    def figures(self) -> dict[str, float]:
        """All figures but Hoover's classes, by name."""
        found = {"regions": float(self.regions), "labelled": self.labelled}
        if self.blobs is not None:
            found |= {
                "blobs": float(len(self.blobs)),
                "blob_px": float(sum(b.pixel_count for b in self.blobs)),
            }
        if self.labels is not None:
            keys = ("crumbs", "voi_bits", "rand", "adjusted_rand", "covering", "coverage")
            found |= {key: float(getattr(self.labels, key)) for key in keys}
        if self.planes is not None:
            found |= self.planes.figures()
        for group in (self.parts, self.reconstruction):
            if group is not None:
                found |= asdict(group)
        return found

    def row(self, tolerance: float = REPORT_TOLERANCE) -> dict[str, Any]:
        """Flat name -> number for tables and CSV files, with Hoover's classes at one tolerance."""
        row: dict[str, Any] = {"frame": self.name, "labels": self.level}
        if self.labels is not None:
            row |= self.labels.at(tolerance).counts()
        if self.planes is not None:
            row |= self.planes.counts()
        return row | self.figures()
