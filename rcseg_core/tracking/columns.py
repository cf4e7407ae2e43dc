"""Tables of many tracks: named tuples of arrays, a row for each track, so that no track costs a call."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Table = TypeVar("Table", bound=tuple[Any, ...])


def some(table: Table, rows: NDArray[Any]) -> Table:
    """The rows (n,) bool, or by number, of a named tuple of arrays."""
    return type(table)(*(column[rows] for column in table))


def longer(table: Table, more: Table) -> Table:
    """The rows of both, one after the other."""
    return type(table)(*(np.concatenate(pair) for pair in zip(table, more, strict=True)))
