"""A console that is wide enough for a table."""

from __future__ import annotations

from rich.console import Console


def at_least(console: Console, width: int) -> Console:
    """The console, or where it is a pipe or a narrow window one of `width` columns that writes to its file.

    Long lines are better than cut figures.
    """
    return console if console.width >= width else Console(file=console.file, width=width, highlight=False)
