"""Tables and files of `rcseg evaluate --uncertainty`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from rcseg_core.evaluation.uncertainty import LEVELS, ErrorCheck, summarise
from rcseg_ros.console import at_least

TABLE_WIDTH = 130
HEADS = {"all": "", "family": "family", "pixels": "pixels", "depth_m": "depth, m"}
LEGEND = (
    "NEES/dof: normalised error squared over its degrees of freedom, 1 where stated errors are right; "
    "random: by their random part alone; 50 % ... 99 %: share of the truth inside of these intervals "
    "(shapes: joint regions). Shapes that lie on one true surface and were recognised as what it is; "
    "control points by their own standard errors"
)


def print_uncertainty(checks: Sequence[ErrorCheck], console: Console) -> None:
    """One table for each shape and for control points, its rows by family, size and depth."""
    console = at_least(console, TABLE_WIDTH)
    rows = summarise(checks)
    for what in dict.fromkeys(row["what"] for row in rows):
        console.print(_table(what, [row for row in rows if row["what"] == what]))
    console.print(LEGEND if rows else "No shape and no patch has a truth to compare its errors with")


def _table(what: str, rows: Sequence[dict[str, Any]]) -> Table:
    title = f"Stated errors of {what if what.endswith('s') else what + 's'}"
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("by", no_wrap=True)
    for head in ("n", "NEES/dof", "median", "random", *(f"{100 * level:.0f} %" for level in LEVELS)):
        table.add_column(head, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(
            f"{HEADS[row['by']]} {row['class']}".strip() or "all",
            str(row["count"]),
            f"{row['nees']:.2f}",
            f"{row['nees_median']:.2f}",
            f"{row['nees_random']:.2f}",
            *(f"{row[f'held_{100 * level:.0f}']:.3f}" for level in LEVELS),
        )
    return table
