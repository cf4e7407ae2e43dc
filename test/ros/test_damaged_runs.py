"""Files of a run that are damaged: planned anew or refused in one line; what `make fuzz` found first."""

import json
import struct
import zlib

import pytest

pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install 'rcseg[test]'")

import pyarrow as pa
import pyarrow.parquet as pq
from fuzzing_results import take_run

from rcseg_core.errors import InputError
from rcseg_ros.batch.inputs import find_inputs
from rcseg_ros.batch.manifest import MANIFEST, read_manifest
from rcseg_ros.batch.options import BATCH, check_same
from rcseg_ros.batch.work import UNIT, Outcome, stored
from rcseg_ros.tables.parquet import check_tables
from rcseg_ros.tables.rows import decode_label_image
from rcseg_ros.tables.schema import TABLES

ENTRY = {"name": "a", "index": 0, "path": "/a.mcap", "size": 1, "mtime_ns": 2, "digest": "d"}
PARTS = [[0, 9, 0]]


@pytest.mark.parametrize(
    "line",
    [
        b"\x80", b"5", b"[]", b"null", b'"parts"', b"[" * 100_000,
        *(json.dumps({**ENTRY, "parts": PARTS, **change}).encode() for change in (
            {"name": "../.."}, {"name": ""}, {"name": 1}, {"index": -1}, {"index": "0"}, {"size": None},
            {"parts": []}, {"parts": [[]], "more": 1}, {"parts": [["a", 0, 0]]}, {"parts": [[0, 10**30, 0]]},
            {"parts": 3}, {"path": None},
        )),
    ],
)  # fmt: skip
def test_a_damaged_line_of_the_manifest_is_none(tmp_path, line):
    good = json.dumps({**ENTRY, "parts": PARTS}).encode()
    (tmp_path / MANIFEST).write_bytes(line + b"\n" + good + b"\n")
    (entry,) = read_manifest(tmp_path).values()
    assert (entry.name, entry.parts[0].end_ns) == ("a", 9)


def test_a_manifest_that_ends_in_bytes_of_no_text_is_gone_on_with():
    take_run(("out/manifest.jsonl", b"{\xff"))


@pytest.mark.parametrize(
    "change",
    [None, [], {"files": []}, {"outcome": 1}, {"outcome": {"unit": 1}}, {"outcome": {"frames": "x"}}],
)
def test_a_unit_that_tells_nothing_of_use_is_not_done(tmp_path, change):
    outcome = {**vars(Outcome("a-00000")), "damage": [], "warnings": []}
    good = {"digest": "d", "files": {}, "outcome": outcome}
    (tmp_path / UNIT).write_text(json.dumps(good))
    assert stored(tmp_path, "d") == Outcome("a-00000")
    changed = change
    if isinstance(change, dict):
        part = next(iter(change))
        inner = {**outcome, **change[part]} if isinstance(change[part], dict) else change[part]
        changed = {**good, part: inner}
    (tmp_path / UNIT).write_text(json.dumps(changed))
    assert stored(tmp_path, "d") is None


@pytest.mark.parametrize("text", ["[]", "1", "{", '"', "[" * 100_000, '{"a": 1}'])
def test_damaged_options_are_one_line(tmp_path, text):
    (tmp_path / BATCH).write_text(text)
    with pytest.raises(InputError, match="cannot be read") as caught:
        check_same(tmp_path, {"a": 1})
    assert "\n" not in str(caught.value)


def test_a_label_image_that_claims_to_be_huge_is_refused():
    head = struct.pack(">IIBBBBB", 2**30, 2**30, 16, 0, 0, 0, 0)
    chunk = b"IHDR" + head
    png = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))
    with pytest.raises(InputError, match="png: expected"):
        decode_label_image(png)


@pytest.mark.parametrize(
    ("content", "words"),
    [(b"\xff\xfe", "codec"), (b"a\0b\n", "no such"), (b"x" * 5000, "too long"), (b"list.txt\n", "circle")],
)
def test_lists_that_are_none_are_one_line(tmp_path, content, words):
    (tmp_path / "list.txt").write_bytes(content)
    with pytest.raises(InputError, match=words) as caught:
        find_inputs([str(tmp_path / "list.txt")])
    assert "\n" not in str(caught.value)


def test_tables_and_lists_that_are_cut_off_are_refused_or_read():
    for name in ("out/tables/recording=a/part=00000/labels.parquet", "list.txt", f"out/{BATCH}"):
        for data in (b"", b"\x00", b"\xff" * 50, b"PAR1" + bytes(40) + b"PAR1"):
            take_run((name, data))


def test_a_table_whose_names_are_no_text_is_not_whole(tmp_path):
    for name in TABLES:
        pq.write_table(pa.table({"columnname": [1]}), tmp_path / f"{name}.parquet")
    file = tmp_path / f"{next(iter(TABLES))}.parquet"
    file.write_bytes(file.read_bytes().replace(b"columnname", b"\xf3olumnname"))
    with pytest.raises(InputError, match=r"not a whole table|not those of this version"):
        check_tables(tmp_path)
