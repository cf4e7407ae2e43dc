"""Pictures of an evaluation: one sheet a frame, one overview of all frames, and a page that shows them.

The page is plain HTML beside the pictures: it opens from the disk in any browser.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from rcseg_core import RangeColorFrame, Segmentation
from rcseg_core.evaluation.blobs import Blob
from rcseg_core.evaluation.metrics import SceneMetrics
from rcseg_core.evaluation.plane_evaluation import PLANES
from rcseg_core.result.drawing import (
    Image,
    contact_sheet,
    depth_picture,
    edges_picture,
    kinds_picture,
    labels_picture,
    overlay,
    write_png,
)
from rcseg_ros.evaluation.reports import page_tables

if TYPE_CHECKING:
    from rcseg_ros.evaluation.evaluate import Case, Report

OVERVIEW = "overview.png"
PAGE = "index.html"
MOST_IN_OVERVIEW = 100
OVERVIEW_WIDTH_PX = 320
BLOB_COLOR = (255, 255, 255)
STYLE = (
    "body{font-family:sans-serif;background:#181818;color:#eee;margin:1em}a{color:#9cf}"
    "table{border-collapse:collapse;margin:1em 0}td,th{padding:.15em .6em;text-align:right}"
    "td:first-child,th:first-child{text-align:left}tr:nth-child(even){background:#262626}img{width:100%}"
)


class Album:
    """The pictures of one run; every sheet is written at once, overview and page at the end.

    Parameters
    ----------
    folder : that of the report; sheets go to its folder `pictures`
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        (folder / "pictures").mkdir()
        self._tiles: list[tuple[str, Image]] = []
        self._sheets: list[tuple[str, str]] = []

    def add(
        self, case: Case, result: Segmentation, metrics: Sequence[SceneMetrics], tolerance: float
    ) -> None:
        """Write the sheet of a frame."""
        path = f"pictures/{case.name.replace('/', '_')}.png"
        write_png(self._folder / path, frame_picture(case, result, metrics, tolerance))
        self._sheets.append((case.name, path))
        if len(self._tiles) < MOST_IN_OVERVIEW:
            picture = overlay(case.frame.color, result.surface_labels)
            height = max(1, round(picture.shape[0] * OVERVIEW_WIDTH_PX / picture.shape[1]))
            small = cv2.resize(picture, (OVERVIEW_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
            self._tiles.append((case.name, np.asarray(small, np.uint8)))

    def finish(self, report: Report, tolerance: float) -> None:
        """Write the overview, its tiles the surfaces of the first 100 frames, and the page."""
        if not self._tiles:
            return
        sheet = contact_sheet(self._tiles, columns=4, panel_width=OVERVIEW_WIDTH_PX)
        write_png(self._folder / OVERVIEW, sheet)
        frames = "\n".join(
            f'<h2 id="{escape(name)}">{escape(name)}</h2><a href="{escape(path)}">'
            f'<img loading="lazy" src="{escape(path)}" alt="{escape(name)}"></a>'
            for name, path in self._sheets
        )
        page = (
            f'<!DOCTYPE html><html lang="en"><meta charset="utf-8"><title>rcseg evaluate</title>'
            f"<style>{STYLE}</style>\n<h1>rcseg evaluate</h1>\n{page_tables(report, tolerance)}\n"
            f'<h2>Surfaces</h2><img src="{OVERVIEW}" alt="surfaces of all frames">\n{frames}\n</html>\n'
        )
        (self._folder / PAGE).write_text(page, "utf-8")


def frame_picture(
    case: Case, result: Segmentation, metrics: Sequence[SceneMetrics], tolerance: float
) -> Image:
    """Image, depth, edges, regions, surfaces, primitives, reconstruction and truth side by side, RGB."""
    points, color = result.reconstruct()
    kinds = [surface.primitive.kind for surface in result.surfaces]
    by_level = {m.level: m for m in metrics}
    range_name = "depth" if case.frame.camera is not None else "distance"
    distance = _distance(case.frame, case.frame.points)
    shown = distance[case.frame.valid]
    limits = {"low_m": float(np.percentile(shown, 2)), "high_m": float(np.percentile(shown, 98))}
    span = f"{limits['low_m']:.2f} to {limits['high_m']:.2f} m"
    blobs = by_level["surfaces"].blobs or () if "surfaces" in by_level else ()
    surfaces = f"surfaces: {int(result.surface_labels.max())}{_summary(by_level.get('surfaces'), tolerance)}"
    regions = f"regions: {len(result.regions)}{_summary(by_level.get('regions'), tolerance)}"
    panels = [
        (case.name + ("" if case.has_color else ": no colour"), case.frame.color),
        (f"{range_name}, {span}", depth_picture(distance, **limits)),
        ("edges: depth red, orientation green, colour blue", edges_picture(result.edges)),
        ("surfaces on the image", overlay(case.frame.color, result.surface_labels)),
        (regions, labels_picture(result.labels)),
        (surfaces, _with_blobs(labels_picture(result.surface_labels), blobs)),
        (_count_kinds(kinds), kinds_picture(result.surface_labels, kinds)),
        ("reconstructed colour", color),
        (f"reconstructed {range_name}", depth_picture(_distance(case.frame, points), **limits)),
    ]
    seen = dict.fromkeys("surfaces" if level == PLANES else level for level in by_level)
    truth = {f"truth of {level}": case.truth.get(level) for level in seen}
    known = [(title, labels) for title, labels in truth.items() if labels is not None]
    if len(known) == 2 and known[0][1] is known[1][1]:
        known = [("truth", known[0][1])]
    if "objects" in by_level:
        panels.append((f"objects: {len(result.objects)}", overlay(case.frame.color, result.object_labels)))
    panels += [(title, labels_picture(labels)) for title, labels in known]
    return contact_sheet(panels, columns=5)


def _count_kinds(kinds: Sequence[str]) -> str:
    """How many surfaces are which primitive: plane blue, sphere green, cylinder orange, none grey."""
    return "primitives: " + ", ".join(f"{count} {kind}" for kind, count in Counter(kinds).most_common())


def _distance(frame: RangeColorFrame, points: Any) -> Any:
    """Depth of a camera's points; distance from the scanner of others."""
    return points[..., 2] if frame.camera is not None else np.linalg.norm(points, axis=2)


def _with_blobs(picture: Image, blobs: Sequence[Blob]) -> Image:
    """A white frame round every false blob."""
    for blob in blobs:
        row_min, col_min, row_max, col_max = blob.box
        cv2.rectangle(picture, (col_min - 4, row_min - 4), (col_max + 4, row_max + 4), BLOB_COLOR, 2)
    return picture


def _summary(metrics: SceneMetrics | None, tolerance: float) -> str:
    if metrics is None:
        return ""
    text = ""
    if metrics.labels is not None:
        result = metrics.labels.at(tolerance)
        text = f", {result.correct} of {result.truth_regions} correct, {result.noise} noise"
    elif metrics.parts is not None:
        text = f", {metrics.parts.parts_per_object:.1f} parts, IoU {metrics.parts.best_iou:.2f}"
    return text + (f", {len(metrics.blobs)} blobs" if metrics.blobs else "")
