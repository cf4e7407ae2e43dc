"""Tables of many tracks: named tuples of arrays, a row for each track, so that no track costs a call."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Whole = NDArray[np.int64]
Table = TypeVar("Table", bound=tuple[Any, ...])

#: Points that are kept of a track, for the time when it is lost; frames after which they are renewed.
SAMPLE, RENEW = 48, 10


def some(table: Table, rows: NDArray[Any]) -> Table:
    """The rows (n,) bool, or by number, of a named tuple of arrays."""
    return type(table)(*(column[rows] for column in table))


def longer(table: Table, more: Table) -> Table:
    """The rows of both, one after the other."""
    return type(table)(*(np.concatenate(pair) for pair in zip(table, more, strict=True)))


class Entries(NamedTuple):
    """The tracks of one kind, a row each, in the order of their ids; changed in place. See `tracks.Track`.

    state : number of STATES
    color : (n, 3) levels
    points, pixels, sample : (n, SAMPLE, 3) in the fixed frame, (n, SAMPLE, 2), and how many of each there are
    squares, sampled : at the frame of that number, when they were taken
    """

    id: Whole
    first_seen_ns: Whole
    first_frame: Whole
    parent: Whole
    state: Whole
    label: Whole
    seen: Whole
    last_seen_ns: Whole
    last_frame: Whole
    merged_into: Whole
    color: Array
    points: Array
    pixels: Whole
    sample: Whole
    squares: Array
    sampled: Whole

    @classmethod
    def new(cls, ids: Whole, parent: Whole, stamp_ns: int, frame: int) -> Entries:
        """Tracks that begin in this frame."""
        n = len(ids)
        zero = np.zeros((10, n), np.int64)
        return cls(
            ids, zero[0] + stamp_ns, zero[1] + frame, parent, zero[2], zero[3], zero[4], zero[5], zero[6],
            zero[7], np.full((n, 3), np.nan), np.zeros((n, SAMPLE, 3)), np.zeros((n, SAMPLE, 2), np.int64),
            zero[8], np.zeros(n), zero[9] + frame - RENEW,
        )  # fmt: skip
