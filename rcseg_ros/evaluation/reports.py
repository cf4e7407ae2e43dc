"""Tables on the screen, CSV files and plots of evaluations."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from rcseg_core.evaluation.pooling import Pooled
from rcseg_ros.console import at_least

if TYPE_CHECKING:
    from rcseg_ros.evaluation.evaluate import Report

COLUMNS = {
    "frames": ("n", "d"),
    "truth_planes": ("planes", "d"),
    "machine_planes": ("found", "d"),
    "precision": ("prec", ".3f"),
    "recall": ("recall", ".3f"),
    "f_score": ("F", ".3f"),
    "mean_iou": ("IoU75", ".3f"),
    "panoptic": ("panop", ".3f"),
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
    "whole": ("whole", ".3f"),
    "regions": ("count", ".0f"),
    "labelled": ("labelled", ".3f"),
    "blobs": ("blobs", ".3g"),
    "milliseconds": ("ms", ".0f"),
}
"""What the tables on the screen show, in order: figure, head, format; files hold all figures."""
KINDS = {
    "labels": "truth of regions",
    "parts": "truth of objects",
    "planes": "by the rules of EVOPS",
    "alone": "without truth",
}
TABLE_WIDTH = 130
LEGEND = {
    "n": "frames",
    "share": "correct / truth",
    "IoU75": "mean IoU of the planes that match at .75",
    "panop": "panoptic, IoU75 x F",
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
    "whole": "objects with a best IoU of 80 % and more",
    "count": "machine regions",
    "labelled": "share of the valid pixels with a label",
    "blobs": "surfaces of 100 px and more inside of one that explains them",
}
"""Heads that do not explain themselves."""


def print_report(report: Report, console: Console, tolerance: float) -> None:
    """Tables by frame and pooled, one for each level and kind of truth, and what their heads mean."""
    if not report.frames:
        return
    console = at_least(console, TABLE_WIDTH)
    sections = _sections(report, tolerance)
    for title, frames, pooled in sections:
        console.print(_table(title, frames, pooled))
    shown = {head for _, frames, pooled in sections for head, _ in _columns([*frames, *pooled]).values()}
    legend = "; ".join(f"{head}: {meaning}" for head, meaning in LEGEND.items() if head in shown)
    console.print(f"Pooled: counts are sums, ms the median, the rest means. {legend}")


def page_tables(report: Report, tolerance: float) -> str:
    """The same tables as HTML, frame names linked to their headings."""
    return "\n".join(
        f"<h2>{escape(title)}</h2>{_html_table(frames, pooled)}"
        for title, frames, pooled in _sections(report, tolerance)
    )


def markdown_tables(report: Report, tolerance: float, *, pooled_only: bool = False) -> str:
    """The same tables as Markdown, each under its title in bold; by frame and pooled, or the latter alone."""
    texts = []
    for title, frames, pooled in _sections(report, tolerance):
        rows = pooled if pooled_only else [*frames, *pooled]
        if not rows:
            continue
        columns = _columns(rows)
        heads = ["" if pooled_only else "frame", *(head for head, _ in columns.values())]
        lines = [heads, ["---", *("---:" for _ in columns)]]
        for row in rows:
            name = row["frame"] if "frame" in row else row["name"] if pooled_only else f"**{row['name']}**"
            lines.append([str(name), *_cells(row, columns)])
        table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
        texts.append(f"**{title}**\n\n{table}")
    return "\n\n".join(texts)


Rows = list[dict[str, Any]]


def _sections(report: Report, tolerance: float) -> list[tuple[str, Rows, Rows]]:
    """Title, rows of frames and rows of groups for each level and kind of truth that occurs."""
    frames, pooled = report.frame_rows(tolerance), report.pooled_rows(tolerance)
    sections = []
    for level in report.levels:
        for kind, name in KINDS.items():
            own = [row for row in frames if row["labels"] == level and _kind(row) == kind]
            groups = [row for row in pooled if row["labels"] == level and _kind(row) == kind]
            if own:
                title = f"{level.capitalize()}, {name}"
                sections.append((title + f", overlap {tolerance:g}" * (kind == "labels"), own, groups))
    return sections


def _kind(row: dict[str, Any]) -> str:
    marks = {"truth_regions": "labels", "purity": "parts", "truth_planes": "planes"}
    return next((kind for mark, kind in marks.items() if mark in row), "alone")


def _columns(rows: Rows) -> dict[str, tuple[str, str]]:
    """The columns that some row has a value for."""
    shown = {key: column for key, column in COLUMNS.items() if any(key in row for row in rows)}
    known = [key for key in ("regions", "labelled") if "truth_regions" in shown or "purity" in shown]
    for key in known or (["regions"] if "truth_planes" in shown else []):
        del shown[key]
    return shown


def _cells(row: dict[str, Any], columns: dict[str, tuple[str, str]]) -> list[str]:
    return [format(row[key], form) if key in row else "" for key, (_, form) in columns.items()]


def _table(title: str, frames: Rows, pooled: Rows) -> Table:
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    columns = _columns([*frames, *pooled])
    table.add_column("frame", no_wrap=True, min_width=max(len(str(row["frame"])) for row in frames))
    for head, _ in columns.values():
        table.add_column(head, justify="right", no_wrap=True)
    for row in frames:
        table.add_row(str(row["frame"]), *_cells(row, columns))
    table.add_section()
    for row in pooled:
        table.add_row(str(row["name"]), *_cells(row, columns))
    return table


def _html_table(frames: Rows, pooled: Rows) -> str:
    columns = _columns([*frames, *pooled])
    heads = "".join(f"<th>{escape(head)}</th>" for head in ["frame", *(h for h, _ in columns.values())])
    lines = [(f'<a href="#{escape(row["frame"])}">{escape(row["frame"])}</a>', row) for row in frames] + [
        (f"<b>{escape(row['name'])}, pooled</b>", row) for row in pooled
    ]
    body = "".join(
        f"<tr><td>{name}</td>{''.join(f'<td>{cell}</td>' for cell in _cells(row, columns))}</tr>\n"
        for name, row in lines
    )
    return f"<table><tr>{heads}</tr>\n{body}</table>"


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
    several = len({group.level for group in pooled}) > 1
    for group in pooled:
        if group.counts:
            tolerances = sorted(group.counts)
            name = f"{group.name}, {group.level}" if several else group.name
            axes.plot(tolerances, [group.correct(t) for t in tolerances], marker="o", label=name)
    axes.set(xlabel="overlap tolerance", ylabel="correct detections / truth regions", ylim=(0, 1.02))
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=120)
