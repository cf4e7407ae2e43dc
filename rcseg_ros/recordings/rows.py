"""Rows of figures, one for each frame of a recording of any length, whose memory stays small."""

from __future__ import annotations

import json
import tempfile
from array import array
from collections.abc import Sequence
from typing import Any, TextIO, overload

IN_MEMORY_BYTES = 4 << 20  # a few thousand frames; beyond, the rows lie in a temporary file


class Rows(Sequence[dict[str, Any]]):
    """A sequence of dictionaries that JSON can hold; each is read anew when it is asked for.

    A row takes some kilobytes as Python objects: a day at 30 Hz would take gigabytes.
    """

    def __init__(self) -> None:
        self._file = tempfile.SpooledTemporaryFile(IN_MEMORY_BYTES)  # noqa: SIM115  as long as the rows
        self._starts = array("q", [0])

    def append(self, row: dict[str, Any]) -> None:
        self._file.seek(self._starts[-1])
        data = json.dumps(row).encode()
        self._file.write(data)
        self._starts.append(self._starts[-1] + len(data))

    def __len__(self) -> int:
        return len(self._starts) - 1

    @overload
    def __getitem__(self, index: int) -> dict[str, Any]: ...
    @overload
    def __getitem__(self, index: slice) -> list[dict[str, Any]]: ...
    def __getitem__(self, index: int | slice) -> dict[str, Any] | list[dict[str, Any]]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        number = range(len(self))[index]
        self._file.seek(self._starts[number])
        row: dict[str, Any] = json.loads(self._file.read(self._starts[number + 1] - self._starts[number]))
        return row


def write_document(stream: TextIO, document: dict[str, Any], name: str, rows: Rows) -> None:
    """Write a document as JSON with the rows as its last entry `name`, one after another."""
    stream.write(json.dumps(document, indent=1).removesuffix("\n}") + f',\n "{name}": [')
    for number, row in enumerate(rows):
        lines = json.dumps(row, indent=1).replace("\n", "\n  ")
        stream.write(("," if number else "") + "\n  " + lines)
    stream.write("\n ]\n}\n" if len(rows) else "]\n}\n")
