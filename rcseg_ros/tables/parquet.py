"""Tables of one recording, or of a part of it, as Parquet files in one folder; and how they are read again.

Frames come from workers out of the order in which their messages were recorded, and some messages give none;
rows wait until all before them are there, so that the tables are in the order of `frame_index`. They are
written in groups of frames, which bounds the memory that a long recording takes.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq
from numpy.typing import NDArray

from rcseg_core.errors import InputError
from rcseg_ros.tables.rows import Rows, decode_label_image
from rcseg_ros.tables.schema import KEYS, TABLES, arrow_schema

#: Folder of the tables in a result, and names of the folders below it, one a recording and one a part of it.
FOLDER = "tables"
#: Rows are written when so many bytes of them have gathered, or so many frames.
GROUP_BYTES, GROUP_FRAMES = 16 * 2**20, 512


def part_folder(recording: str, part: int = 0) -> str:
    """Where the tables of a part of a recording lie below FOLDER."""
    return f"recording={recording}/part={part:05d}"


@dataclass(frozen=True)
class Episode:
    """What the rows of a recording have in common.

    name, index : of the recording among those of a run
    origin_ns : stamp of its first range message, from which timestamps count
    first_frame : number of the first range message that belongs to this part
    """

    name: str
    index: int = 0
    origin_ns: int = 0
    first_frame: int = 0


class TableWriter:
    """Parquet files of all tables in a folder, one each; a file is there even if it has no rows.

    Parameters
    ----------
    folder : is made with the first rows
    """

    def __init__(self, folder: Path, episode: Episode) -> None:
        self._folder = folder
        self._episode = episode
        self._files = {name: folder / f"{name}.parquet" for name in TABLES}
        self._writers: dict[str, pq.ParquetWriter] = {}
        self._waiting: dict[int, tuple[int, Rows]] = {}  # by number: stamp and rows
        self._next = episode.first_frame
        self._ready: list[tuple[int, int, Rows]] = []
        self._bytes = 0
        self.rows = dict.fromkeys(TABLES, 0)

    def add(self, frame_index: int, stamp_ns: int, rows: Rows) -> None:
        """Take in the rows of one range message, in any order of the messages."""
        self._waiting[frame_index] = stamp_ns, rows
        while self._next in self._waiting:
            self._take(self._next)
        if self._bytes > GROUP_BYTES or len(self._ready) >= GROUP_FRAMES:
            self._write()

    def close(self) -> None:
        """Write what is left, and finish the files; they are on the disk when this returns."""
        for frame_index in sorted(self._waiting):  # messages between them were never read to the end
            self._take(frame_index)
        self._write()
        for name, writer in self._writers.items():
            writer.close()
            _to_disk(self._files[name])

    def abandon(self) -> None:
        """Close the files as they are, which makes nothing whole of them."""
        for writer in self._writers.values():
            writer.close()

    def _take(self, frame_index: int) -> None:
        stamp_ns, rows = self._waiting.pop(frame_index)
        self._ready.append((frame_index, stamp_ns, rows))
        self._bytes += sum(batch.nbytes for batch in rows.values())
        self._next = frame_index + 1

    def _write(self) -> None:
        if not self._writers:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._writers = {name: _open(file, name) for name, file in self._files.items()}
        for name, writer in self._writers.items():
            mine = [(index, stamp, rows[name]) for index, stamp, rows in self._ready if name in rows]
            batches = [batch for _, _, batch in mine if batch.num_rows]
            if batches:
                sizes = [batch.num_rows for _, _, batch in mine]
                table = pa.Table.from_batches(batches).combine_chunks()
                keys = self._keys(np.repeat([[i, s] for i, s, _ in mine], sizes, axis=0))
                whole = pa.Table.from_arrays([*keys, *table.columns], schema=arrow_schema(name))
                writer.write_table(whole)
                self.rows[name] += whole.num_rows
        self._ready.clear()
        self._bytes = 0

    def _keys(self, frames: NDArray[np.int64]) -> list[pa.Array]:
        episode, count = self._episode, len(frames)
        values: dict[str, Any] = {
            "recording": pa.repeat(episode.name, count),
            "episode_index": np.full(count, episode.index, np.int64),
            "frame_index": frames[:, 0],
            "timestamp": (frames[:, 1] - episode.origin_ns) / 1e9,
            "stamp_ns": frames[:, 1],
        }
        return [pa.array(values[column.name], column.type) for column in KEYS]


#: Columns of few different words; numbers are not worth a dictionary, and cost time to look for one.
_WORDS = ["recording", "rejected", "frame_id", "up_source", "camera", "noise_source", "range_unit",
          "category", "kind", "range_kind", "color_kind"]  # fmt: skip


def _open(file: Path, table: str) -> pq.ParquetWriter:
    schema = arrow_schema(table)
    words = [name for name in _WORDS if name in schema.names]
    return pq.ParquetWriter(file, schema, compression="zstd", use_dictionary=words)


def _to_disk(file: Path) -> None:
    """Wait until the file would outlast a loss of power."""
    handle = os.open(file, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def check_tables(folder: Path) -> dict[str, int]:
    """Rows of each table in a folder of one part, as their files say.

    Raises
    ------
    InputError
        If one is missing, is not whole, or is not of this version.
    """
    rows = {}
    for name in TABLES:
        file = folder / f"{name}.parquet"
        try:
            about = pq.ParquetFile(file)
            rows[name] = about.metadata.num_rows
            same = about.schema_arrow.equals(arrow_schema(name))
        except (OSError, pa.ArrowException, ValueError) as error:  # names that are no text, too
            raise InputError(f"{file}: not a whole table: {' '.join(str(error).split())}") from None
        if not same:
            raise InputError(f"{file}: its columns are not those of this version of rcseg")
    return rows


def open_table(result: Path, table: str) -> ds.Dataset:
    """A table of all recordings of a run, or of one replay, as a pyarrow dataset; nothing is read yet.

    Parameters
    ----------
    result : folder that `rcseg batch` or `rcseg replay --tables` wrote
    table : frames, surfaces, objects, regions or labels

    Raises
    ------
    InputError
        If there is no such table.
    """
    if table not in TABLES:
        raise InputError(f"{table}: no table; expected one of {', '.join(TABLES)}")
    files = sorted((result / FOLDER).glob(f"*/*/{table}.parquet"))
    if not files:
        raise InputError(f"{result}: no tables here; make them with `rcseg batch` or `rcseg replay --tables`")
    return ds.dataset(files, schema=arrow_schema(table))


def read_labels(
    result: Path, recording: str | None = None, kind: str = "labels"
) -> Iterator[tuple[str, int, NDArray[np.uint16]]]:
    """Label images of a run, one after another: name of the recording, frame_index, (H, W) uint16.

    Parameters
    ----------
    recording : only of this one; None: of all
    kind : labels (regions), surface_labels or object_labels

    Raises
    ------
    InputError
        If there are no tables, or they are damaged.
    """
    wanted = ds.field("kind") == kind
    if recording is not None:
        wanted &= ds.field("recording") == recording
    names = ["recording", "frame_index", "png"]
    try:
        for batch in open_table(result, "labels").to_batches(columns=names, filter=wanted, batch_size=64):
            for row in batch.to_pylist():
                yield row["recording"], row["frame_index"], decode_label_image(row["png"])
    except InputError:
        raise
    except (OSError, ValueError, pa.ArrowException) as error:
        raise InputError(
            f"{result}: the table labels cannot be read: {' '.join(str(error).split())}; make it anew"
        ) from None
