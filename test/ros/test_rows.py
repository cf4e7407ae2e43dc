"""Rows of figures on disk: as a list of dictionaries, in little memory, and as JSON that any reader takes."""

from __future__ import annotations

import io
import json
import tracemalloc

from rcseg_ros.recordings import rows as module
from rcseg_ros.recordings.rows import Rows, write_document


def row(number):
    return {
        "number": number,
        "share": number / 3,
        "stages_ms": {"a": float(number), "b": None},
        "id": "\u00e9",
    }


def filled(count):
    rows = Rows()
    for number in range(count):
        rows.append(row(number))
    return rows


def test_they_are_a_sequence(monkeypatch):
    monkeypatch.setattr(module, "IN_MEMORY_BYTES", 200)
    rows, wanted = filled(20), [row(number) for number in range(20)]
    assert list(rows) == wanted and rows[-1] == wanted[-1] and rows[3:7:2] == wanted[3:7:2]
    rows.append(row(20))  # after reading
    assert len(rows) == 21 and rows[20] == row(20) and rows[0] == wanted[0]
    assert not Rows() and list(Rows()) == []


def test_the_document_is_what_json_writes():
    for count in (0, 1, 3):
        stream, document = io.StringIO(), {"a": {"b": [1, 2]}, "c": "}"}
        write_document(stream, document, "frames", filled(count))
        whole = document | {"frames": [row(number) for number in range(count)]}
        assert stream.getvalue() == json.dumps(whole, indent=1) + "\n"


def test_many_take_little_memory(monkeypatch):
    monkeypatch.setattr(module, "IN_MEMORY_BYTES", 50_000)
    tracemalloc.start()
    rows = filled(5000)
    grown, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(rows) == 5000 and grown < 5000 * 16 + 100_000
