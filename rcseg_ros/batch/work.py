"""One unit of work: a part of a recording becomes a folder of tables, which is whole or absent.

The folder is written under another name, checked, and moved to its place in one step; `unit.json` in it tells
its files and what the work cost. Tasks and outcomes are plain values: paths go to a worker, a row of figures
comes back.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import socket
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

from rcseg_core.errors import InputError
from rcseg_ros.batch.inputs import digest, local_copy
from rcseg_ros.batch.manifest import Part
from rcseg_ros.batch.options import BatchOptions
from rcseg_ros.commands.replay import (
    ReplayRequest,
    ReplaySummary,
    first_stamp,
    segment_recording,
    why_nothing,
)
from rcseg_ros.recordings.bag import RawMessage, Recording, Topic
from rcseg_ros.recordings.result_bag import NAMESPACE, BagWriter
from rcseg_ros.recordings.segmenting import FrameResult
from rcseg_ros.recordings.topics import find_topics
from rcseg_ros.tables.parquet import FOLDER, Episode, check_tables, part_folder
from rcseg_ros.tables.sink import TableSink

UNIT, WORK, BAG = "unit.json", ".work", "bag"
OUT_OF_MEMORY = "out of memory"


@dataclass(frozen=True)
class Task:
    """What a worker is given; nothing but paths and settings.

    unit : name of the unit
    output : folder of the run
    recording, index, path, digest : of the recording, as in the manifest
    part, parts, span : which part of it, of how many
    size : bytes of input that the part stands for, for progress
    attempt : 1 for the first
    """

    unit: str
    output: str
    recording: str
    index: int
    path: str
    digest: str
    part: int
    parts: int
    span: Part
    size: int
    options: BatchOptions
    attempt: int = 1

    @property
    def folder(self) -> Path:
        """Where the unit's tables will be."""
        return Path(self.output) / FOLDER / part_folder(self.recording, self.part)


@dataclass(frozen=True)
class Outcome:
    """What became of a task: a row of figures.

    reason : why it failed, in a line; empty where it did not
    damage : what is wrong with the recording, though all frames that can be read are in the tables
    overhead_s : wall time beside reading and segmenting frames: opening, checking, moving
    peak_mb : largest memory that the worker's process ever held
    """

    unit: str
    reason: str = ""
    damage: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    frames: int = 0
    rejected: dict[str, int] = field(default_factory=dict)
    rows: dict[str, int] = field(default_factory=dict)
    seconds: float = 0.0
    cpu_s: float = 0.0
    segment_cpu_s: float = 0.0
    overhead_s: float = 0.0
    peak_mb: float = 0.0
    attempt: int = 1
    host: str = ""
    process: int = 0


#: What JSON may hold for the fields of an outcome, by their annotation.
_KINDS: dict[Any, Any] = {
    "str": str, "int": int, "float": (int, float), "dict[str, int]": dict, "tuple[str, ...]": tuple,
}  # fmt: skip


def run_unit(task: Task, on_frame: Callable[[], None] = lambda: None) -> Outcome:
    """Do a task; whatever goes wrong is told in the outcome, and leaves nothing behind.

    on_frame : called after each frame
    """
    start, cpu = perf_counter(), process_time()
    outcome = Outcome(task.unit, attempt=task.attempt, host=socket.gethostname(), process=os.getpid())
    stage: Path | None = None
    try:
        work = Path(task.output) / WORK
        work.mkdir(exist_ok=True)
        # Whose it is can be told from the name, so that a later run removes what a killed one left.
        stage = Path(tempfile.mkdtemp(prefix=f"{outcome.host}.{outcome.process}.", dir=work))
        with local_copy(task.path) as path:
            if digest(task.path) != task.digest:
                raise InputError(f"{task.path}: has changed since the run was planned; start the run again")
            try:
                outcome = _segment(task, path, stage / "unit", outcome, on_frame)
            except InputError as error:
                raise InputError(_of(task, str(error), path)) from None
        outcome = replace(
            outcome, seconds=perf_counter() - start, cpu_s=process_time() - cpu, peak_mb=peak_mb()
        )
        outcome = replace(outcome, overhead_s=outcome.seconds - outcome.overhead_s)
        _publish(task, stage / "unit", outcome)
    except Exception as error:
        outcome = replace(outcome, reason=_in_a_line(error), seconds=perf_counter() - start)
    finally:
        if stage is not None:
            shutil.rmtree(stage, ignore_errors=True)
    return outcome


def _segment(task: Task, path: Path, folder: Path, outcome: Outcome, on_frame: Callable[[], None]) -> Outcome:
    """Write the tables of a part into a folder; `overhead_s` holds the time of the frames for now."""
    span = (task.span.start_ns, task.span.end_ns)
    request = task.options.request(path, folder, span)
    with Recording(path) as recording:
        inputs = find_topics(recording, request.topics, request.range_from, lambda line: None)
        summary = ReplaySummary(inputs, workers=1, warnings=recording.warnings)
        episode = Episode(
            task.recording, task.index, first_stamp(recording, inputs.range), task.span.first_frame
        )
        sink = _UnitSink(folder, episode, task.options)
        start = perf_counter()
        try:
            segment_recording(recording, request, summary, sink, lambda done, total: on_frame())
            frames_s = perf_counter() - start
            _check(task, request, summary, recording)
            sink.close()
        finally:
            sink.abandon()
        return replace(
            outcome,
            damage=tuple(_of(task, line, path) for line in recording.damage),
            warnings=tuple(_of(task, line, path) for line in recording.warnings),
            frames=len(summary.frames),
            rejected=dict(summary.rejected),
            rows=dict(sink.rows),
            segment_cpu_s=sum(row["segment_cpu_ms"] for row in summary.frames) / 1e3,
            overhead_s=frames_s,
        )


def _check(task: Task, request: ReplayRequest, summary: ReplaySummary, recording: Recording) -> None:
    """Refuse a part that was not read to its end, and a whole recording without one frame."""
    if summary.interrupted:
        raise InputError(f"{task.path}: interrupted")
    if not summary.frames and task.parts == 1:
        summary.damage = recording.damage
        raise InputError(why_nothing(replace(request, bag=Path(task.path)), summary))


def _of(task: Task, line: str, path: Path) -> str:
    """Words about a local copy as words about the recording."""
    return line.replace(str(path), task.path)


class _UnitSink:
    """Tables of a unit and, where wanted, its result bag."""

    def __init__(self, folder: Path, episode: Episode, options: BatchOptions) -> None:
        folder.mkdir()
        self._tables = TableSink(folder, episode)
        self._bag = BagWriter(folder / BAG) if options.bags else None
        self.expect, self.lose = self._tables.expect, self._tables.lose

    @property
    def rows(self) -> dict[str, int]:
        return self._tables.rows

    def transform(self, topic: Topic, raw: RawMessage) -> None:
        if self._bag is not None:
            self._bag.write(topic.name, topic.type, raw.data, raw.log_ns, topic.qos)

    def add(self, result: FrameResult) -> None:
        self._tables.add(result)
        if self._bag is not None:
            for output in result.outputs:
                self._bag.write(f"{NAMESPACE}/{output.topic}", output.type, output.data, result.raw.log_ns)

    def close(self) -> None:
        self._tables.close()

    def abandon(self) -> None:
        """Let go of all files, finished or not."""
        self._tables.abandon()
        if self._bag is not None:
            self._bag.close()
            self._bag = None


def _publish(task: Task, folder: Path, outcome: Outcome) -> None:
    """Check what was written, note it in unit.json, and move it to its place."""
    if check_tables(folder) != outcome.rows:
        raise InputError(f"{folder}: the tables do not hold what was written to them")
    files = {
        file.relative_to(folder).as_posix(): file.stat().st_size
        for file in folder.rglob("*")
        if file.is_file()
    }
    document = {"digest": task.digest, "files": files, "outcome": asdict(outcome)}
    with (folder / UNIT).open("w", encoding="utf-8") as stream:
        json.dump(document, stream, indent=1)
        stream.flush()
        os.fsync(stream.fileno())
    target = task.folder
    target.parent.mkdir(parents=True, exist_ok=True)
    while not _moved(folder, target):
        if stored(target, task.digest) is not None:  # somebody else was quicker with the same
            return
        shutil.rmtree(target)
    handle = os.open(target.parent, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _moved(folder: Path, target: Path) -> bool:
    try:
        folder.rename(target)
    except OSError:
        if target.exists():
            return False
        raise
    return True


def stored(folder: Path, digest_: str) -> Outcome | None:
    """The outcome of a unit whose folder is whole and of an input with this digest; else None."""
    try:
        document = json.loads((folder / UNIT).read_text("utf-8"))
        values = document["outcome"] | {
            name: tuple(document["outcome"][name]) for name in ("damage", "warnings")
        }
        outcome = Outcome(**values)
        plain = all(isinstance(getattr(outcome, one.name), _KINDS[one.type]) for one in fields(Outcome))
        whole = plain and all(
            (folder / name).stat().st_size == size for name, size in document["files"].items()
        )
        return outcome if whole and document["digest"] == digest_ else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None


def remove_leftovers(output: Path) -> None:
    """Remove unfinished work of processes of this machine that are gone."""
    host = socket.gethostname()
    for folder in (output / WORK).glob(f"{host}.*"):
        number = folder.name.removeprefix(f"{host}.").partition(".")[0]
        if number.isdigit() and not _is_running(int(number)):
            shutil.rmtree(folder, ignore_errors=True)


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        pass
    return True


def peak_mb() -> float:
    """Largest resident memory of this process so far, MB."""
    scale = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * scale / 1e6


def _in_a_line(error: Exception) -> str:
    if isinstance(error, InputError):
        return " ".join(str(error).split())
    if isinstance(error, MemoryError):
        return f"{OUT_OF_MEMORY}: give each worker more (--memory), or let units be shorter (--chunk)"
    text: Any = error
    return f"{type(error).__name__}: {' '.join(str(text).split())}"
