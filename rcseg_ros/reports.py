"""Tables on the screen, CSV files and plots of evaluations."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from rcseg_core.pooling import Pooled

if TYPE_CHECKING:
    from rcseg_ros.evaluate import Report

COLUMNS = {
    "frames": ("n", "d"),
    "correct_share": ("share", ".3f"),
    "truth_regions": ("truth", "d"),
    "correct": ("corr", "d"),
    "over": ("over", "d"),
    "under": ("under", "d"),
    "missed": ("miss", "d"),
    "noise": ("noise", "d"),
    "matched": ("match", "d"),
    "crumbs": ("crumb", ".1f"),
    "voi_bits": ("VoI", ".3f"),
    "rand": ("Rand", ".3f"),
    "covering": ("cover", ".3f"),
    "depth_error_sigmas": ("depth", ".3f"),
    "objects": ("objects", ".0f"),
    "purity": ("purity", ".4f"),
    "boundary_recall": ("bound", ".3f"),
    "coverage": ("cov", ".3f"),
    "parts_per_object": ("parts", ".2f"),
    "raw_parts_per_object": ("raw", ".1f"),
    "best_iou": ("IoU", ".3f"),
    "regions": ("regions", ".0f"),
    "ms": ("ms", ".0f"),
}
"""What the tables on the screen show, in order: figure, head, format; files hold all figures."""
TABLE_WIDTH = 130
LEGEND = {
    "n": "frames",
    "share": "correct / truth",
    "match": "truth regions with a partner, correct or not",
    "crumb": "machine regions below the least area",
    "VoI": "variation of information, bits",
    "cover": "segmentation covering",
    "cov": "share of the truth's pixels with a label",
    "depth": "median depth error of the reconstruction / sigma",
    "bound": "boundary recall within 2 px",
    "parts": "parts per object, crumbs by area",
    "raw": "regions per object",
    "IoU": "best IoU per object",
}
"""Heads that do not explain themselves."""


def print_report(report: Report, console: Console, tolerance: float) -> None:
    """The table by frame, the pooled one, and what their heads mean."""
    if not report.frames:
        return
    if console.width < TABLE_WIDTH:  # a pipe or a narrow window: long lines are better than cut figures
        console = Console(file=console.file, width=TABLE_WIDTH, highlight=False)
    rows = [
        {**metrics.row(tolerance), "ms": 1e3 * seconds}
        for metrics, seconds in zip(report.frames, report.seconds, strict=True)
    ]
    pooled = [
        {**group.row(tolerance), "ms": float(np.median(report.milliseconds(group.name)))}
        for group in report.pooled
    ]
    title = f"Pooled, overlap {tolerance:g}: counts are sums, ms the median, the rest means"
    by_frame = _table(f"By frame, overlap {tolerance:g}", rows, "frame")
    for table in (by_frame, _table(title, pooled, "name")):
        console.print(table)
    shown = {head for key, (head, _) in COLUMNS.items() if any(key in row for row in [*rows, *pooled])}
    console.print("; ".join(f"{head}: {meaning}" for head, meaning in LEGEND.items() if head in shown))


def _table(title: str, rows: Sequence[dict[str, Any]], name: str) -> Table:
    """A table of the columns that some row has a value for."""
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    shown = {key: column for key, column in COLUMNS.items() if any(key in row for row in rows)}
    if "truth_regions" in shown or "purity" in shown:
        del shown["regions"]
    table.add_column(name, no_wrap=True)
    for head, _ in shown.values():
        table.add_column(head, justify="right", no_wrap=True)
    for row in rows:
        cells = [format(row[key], form) if key in row else "" for key, (_, form) in shown.items()]
        table.add_row(str(row[name]), *cells)
    return table


def write_csv(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """One line a row; the columns are those of all rows, in the order of first appearance."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)


def plot_correct(path: Path, pooled: Sequence[Pooled]) -> None:
    """Correct detections over the tolerance, one line a group, as in Hoover's paper."""
    # The plain figure class needs no display and leaves the user's matplotlib backend alone.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    for group in pooled:
        if group.counts:
            tolerances = sorted(group.counts)
            axes.plot(tolerances, [group.correct(t) for t in tolerances], marker="o", label=group.name)
    axes.set(xlabel="overlap tolerance", ylabel="correct detections / truth regions", ylim=(0, 1.02))
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=120)
