"""What a run works on: the recordings, each with its number, and the parts that long ones are cut into.

A file of lines, one a recording, to which new ones are added; a later line of the same path replaces an
earlier one, which is how a recording that has changed is noted. Recordings that are known, with the size and
the time of change that they had, are not opened again: to add to a thousand costs no more than to list them.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from hashlib import blake2b
from pathlib import Path
from typing import IO, Any

import numpy as np
from mcap.reader import make_reader

from rcseg_core.errors import InputError
from rcseg_ros.batch.inputs import Source, digest, is_url
from rcseg_ros.recordings.bag import Recording
from rcseg_ros.recordings.layout import Metadata, find_files
from rcseg_ros.recordings.storage import ALWAYS
from rcseg_ros.recordings.topics import find_topics

MANIFEST = "manifest.jsonl"


@dataclass(frozen=True)
class Part:
    """A span of the times of recording, from start up to end, and the number of its first range message."""

    start_ns: int = ALWAYS[0]
    end_ns: int = ALWAYS[1]
    first_frame: int = 0


@dataclass(frozen=True)
class Entry:
    """A recording of a run; `index` is its episode_index, `name` that of its folder and rows."""

    name: str
    index: int
    path: str
    size: int
    mtime_ns: int
    digest: str
    parts: tuple[Part, ...]

    def unit(self, part: int) -> str:
        """Name of the unit of work that a part is."""
        return f"{self.name}-{part:05d}"


@dataclass(frozen=True)
class Cutting:
    """How recordings are cut: the length of a part, and which messages are counted."""

    chunk_s: float = 0.0
    topics: tuple[tuple[str, str], ...] = ()
    range_from: str = "auto"


def read_manifest(folder: Path) -> dict[str, Entry]:
    """All entries by path, in the order of their numbers; a line that was not written to its end is none."""
    file = folder / MANIFEST
    if not file.exists():
        return {}
    entries: dict[str, Entry] = {}
    for line in file.read_bytes().splitlines():
        entry = _read(line)
        if entry is not None:
            entries[entry.path] = entry
    return entries


def _read(line: bytes) -> Entry | None:
    """The entry of a line; None where the line is damaged, so that its recording counts as a new one."""
    try:
        values = dict(json.loads(line))
        parts = tuple(Part(*map(_whole, part)) for part in values.pop("parts"))
        entry = Entry(**values, parts=parts)
        texts = entry.name, entry.path, entry.digest
        numbers = _whole(entry.index), _whole(entry.size), _whole(entry.mtime_ns)
        sound = all(isinstance(text, str) for text in texts) and min(numbers) >= 0
        return entry if sound and parts and entry.name == _folder_name(entry.name) else None
    except (ValueError, TypeError, KeyError, RecursionError):
        return None


def _whole(value: Any) -> int:
    """A whole number within the bounds of an int64."""
    if type(value) is not int or not ALWAYS[0] <= value <= ALWAYS[1]:
        raise ValueError(value)
    return value


def plan(folder: Path, sources: Iterable[Source], cutting: Cutting, *, keep: bool = True) -> list[Entry]:
    """The entries of the sources, in their order; new and changed ones are added to the manifest.

    Parameters
    ----------
    keep : False leaves the manifest as it is (and makes no folder)
    """
    sources = list(sources)
    known = read_manifest(folder)
    fresh = [
        _entry(source, known, cutting) for source in sources if not _same(source, known.get(source.path))
    ]
    if fresh and keep:
        with (folder / MANIFEST).open("a+", encoding="utf-8", errors="replace") as stream:
            _lock(stream)  # jobs of an array plan at the same time
            known = read_manifest(folder)
            added = _numbered([one for one in fresh if not _same(_source(one), known.get(one.path))], known)
            _append(stream, added)
            known |= {entry.path: entry for entry in added}
    elif fresh:
        known |= {entry.path: entry for entry in _numbered(fresh, known)}
    return [known[source.path] for source in sources]


def _source(entry: Entry) -> Source:
    return Source(entry.path, entry.name, entry.size, entry.mtime_ns)


def _same(source: Source, entry: Entry | None) -> bool:
    return entry is not None and (entry.size, entry.mtime_ns) == (source.size, source.mtime_ns)


def _entry(source: Source, known: dict[str, Entry], cutting: Cutting) -> Entry:
    """What is to be noted of a source; without a name and a number where it is new."""
    old = known.get(source.path)
    try:
        found = digest(source.path)
    except InputError:
        found = ""  # why is told when it is read
    if old is not None and old.digest == found:  # touched or copied, not changed
        return replace(old, size=source.size, mtime_ns=source.mtime_ns)
    name, index = (source.name, -1) if old is None else (old.name, old.index)
    parts = _parts(source, cutting)
    return Entry(name, index, source.path, source.size, source.mtime_ns, found, parts)


def _numbered(fresh: list[Entry], known: dict[str, Entry]) -> list[Entry]:
    """New entries with a number, and a name that no other has."""
    names = {entry.name for entry in known.values()}
    numbered = []
    for entry in fresh:
        other = known.get(entry.path)
        if other is not None:  # another job was quicker, or it has changed
            entry = replace(entry, name=other.name, index=other.index)
        else:
            entry = replace(entry, name=_free_name(entry, names), index=len(names))
            names.add(entry.name)
        numbered.append(entry)
    return numbered


def _free_name(entry: Entry, taken: set[str]) -> str:
    """A name that is one of a folder everywhere; with a digest of the path where another has it."""
    name = _folder_name(entry.name.replace("/", "__"))
    if name in taken:
        name = f"{name}-{blake2b(entry.path.encode(), digest_size=4).hexdigest()}"
    return name


def _folder_name(name: str) -> str:
    return re.sub(r"[^\w.-]+", "_", name).strip("._") or "recording"


def _lock(stream: IO[str]) -> None:
    with suppress(OSError):  # a file system without locks: lines are appended whole all the same
        fcntl.flock(stream, fcntl.LOCK_EX)


def _append(stream: IO[str], entries: list[Entry]) -> None:
    stream.seek(0, os.SEEK_END)
    end = stream.tell()
    if end:
        stream.seek(end - 1)
        if stream.read(1) != "\n":  # a line whose writer was killed
            stream.write("\n")
    for entry in entries:
        values = asdict(entry) | {"parts": [[*asdict(part).values()] for part in entry.parts]}
        stream.write(json.dumps(values) + "\n")
    stream.flush()
    os.fsync(stream.fileno())


def _parts(source: Source, cutting: Cutting) -> tuple[Part, ...]:
    """The parts of a recording: spans of `chunk_s` where its index allows, else the whole."""
    whole = (Part(),)
    if not cutting.chunk_s or is_url(source.path):
        return whole
    try:
        if _seconds(Path(source.path)) <= cutting.chunk_s:
            return whole
        with Recording(Path(source.path)) as recording:
            if not recording.has_index or recording.damage:
                return whole
            inputs = find_topics(recording, dict(cutting.topics), cutting.range_from, lambda line: None)
            times = recording.times(inputs.range)
    except InputError:
        return whole  # why is told when it is read
    return cut(times, round(cutting.chunk_s * 1e9))


def cut(times: np.ndarray, chunk_ns: int) -> tuple[Part, ...]:
    """Parts of equal length whose borders are messages; those without a message are none.

    Parameters
    ----------
    times : (n,) int64, rising, of the range messages
    """
    if not len(times):
        return (Part(),)
    number = (times - times[0]) // chunk_ns
    first = np.flatnonzero(np.diff(number, prepend=-1))
    starts = [ALWAYS[0], *times[first[1:]].tolist()]
    ends = [*starts[1:], ALWAYS[1]]
    return tuple(Part(*part) for part in zip(starts, ends, first.tolist(), strict=True))


def _seconds(path: Path) -> float:
    """Length of a recording by the indices of its files; 0 where one has none."""
    spans = []
    for file in find_files(path, Metadata()):  # what metadata.yaml says takes longer to read than all this
        try:
            with file.open("rb") as stream:
                summary = make_reader(stream).get_summary()
        except Exception:  # no mcap, or a damaged one
            return 0.0
        if summary is None or summary.statistics is None:
            return 0.0
        spans.append((summary.statistics.message_start_time, summary.statistics.message_end_time))
    return (max(end for _, end in spans) - min(start for start, _ in spans)) / 1e9
