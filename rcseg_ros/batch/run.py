"""`rcseg batch`: plan, share out what is missing, try again what failed, tell what became of it."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Any

from rcseg_core.errors import InputError
from rcseg_ros.batch.inputs import find_inputs
from rcseg_ros.batch.manifest import Entry, plan
from rcseg_ros.batch.options import BATCH, BatchOptions, check_same, digest_of
from rcseg_ros.batch.runners import Runner
from rcseg_ros.batch.work import UNIT, Outcome, Task, remove_leftovers, stored
from rcseg_ros.settings import config_yaml
from rcseg_ros.tables.extras import need_pyarrow
from rcseg_ros.tables.parquet import FOLDER, part_folder

FAILED = "failed"


@dataclass(frozen=True)
class BatchRequest:
    """What to run; the options of `rcseg batch`.

    Attributes
    ----------
    retries : how often a unit that failed is tried again
    shard : (i, n): only every n-th unit, the i-th of them, from 1; for jobs that know nothing of each other
    """

    inputs: tuple[str, ...]
    output: Path
    options: BatchOptions = field(default_factory=BatchOptions)
    retries: int = 1
    shard: tuple[int, int] = (1, 1)


@dataclass
class BatchPlan:
    """What there is to do: all tasks of this shard, and the outcomes of those that are done."""

    tasks: list[Task]
    done: dict[str, Outcome]
    recordings: int

    @property
    def missing(self) -> list[Task]:
        return [task for task in self.tasks if task.unit not in self.done]


@dataclass
class BatchSummary:
    """What became of a run.

    outcomes : of all units of this shard by name, those of earlier runs too
    new : names of those that were worked on now
    """

    outcomes: dict[str, Outcome] = field(default_factory=dict)
    new: set[str] = field(default_factory=set)
    seconds: float = 0.0

    @property
    def faulty(self) -> list[Outcome]:
        """Units that failed, or whose recording is damaged."""
        return [one for one in self.outcomes.values() if one.reason or one.damage]

    @property
    def frames(self) -> int:
        """Frames that were segmented now."""
        return sum(self.outcomes[name].frames for name in self.new)


def plan_batch(request: BatchRequest, *, keep: bool = True) -> BatchPlan:
    """Find the inputs and what is done of them.

    Parameters
    ----------
    keep : False writes nothing at all

    Raises
    ------
    InputError
        Inputs that name nothing, or a folder that holds something else.
    """
    need_pyarrow()
    output = request.output
    document = request.options.document()
    known = check_same(output, document)
    sources = find_inputs(request.inputs)
    if keep:
        _prepare(output, request.options, document, known)
    entries = plan(output, sources, request.options.cutting, keep=keep)
    tasks = [task for entry in entries for task in _tasks(entry, request)]
    first, step = request.shard
    tasks = tasks[first - 1 :: step]
    done = {task.unit: found for task in tasks if (found := stored(task.folder, task.digest)) is not None}
    return BatchPlan(tasks, done, len(entries))


def run_batch(
    request: BatchRequest,
    plan_: BatchPlan,
    runner: Runner,
    on_outcome: Callable[[Task, Outcome], None] = lambda task, outcome: None,
) -> BatchSummary:
    """Do what is missing.

    Parameters
    ----------
    on_outcome : called whenever a unit is finished, or has failed for the last time
    """
    summary = BatchSummary(dict(plan_.done))
    start = perf_counter()
    remove_leftovers(request.output)
    _remove_outdated(request.output, plan_.tasks)
    waiting, in_work = deque(plan_.missing), {}
    while waiting or in_work:
        while waiting and len(in_work) < runner.slots:
            task = waiting.popleft()
            in_work[task.unit] = task
            runner.submit(task)
        outcome = runner.wait()
        task = in_work.pop(outcome.unit)
        if outcome.reason and task.attempt <= request.retries:
            waiting.append(replace(task, attempt=task.attempt + 1))
            continue
        _note(request.output, outcome)
        summary.outcomes[task.unit] = outcome
        summary.new.add(task.unit)
        summary.seconds = perf_counter() - start
        on_outcome(task, outcome)
    return summary


def _prepare(output: Path, options: BatchOptions, document: dict[str, Any], known: bool) -> None:
    """Make the folder and say in it what it is of; of several jobs that do so at once one wins."""
    try:
        output.mkdir(parents=True, exist_ok=True)
        if not known:
            text = json.dumps({**document, "digest": digest_of(document)}, indent=1) + "\n"
            _write_whole(output / "config.yaml", config_yaml(options.config))
            _write_whole(output / BATCH, text, replace_old=False)
    except OSError as error:
        raise InputError(f"{output}: cannot write there: {error.strerror or error}") from None
    check_same(output, document)


def _write_whole(file: Path, text: str, *, replace_old: bool = True) -> None:
    """Write a file that is there whole or not at all."""
    handle, name = tempfile.mkstemp(prefix=f".{file.name}.", dir=file.parent)
    with os.fdopen(handle, "w", encoding="utf-8") as stream:
        stream.write(text)
    scratch = Path(name)
    scratch.chmod(0o644)
    if replace_old:
        scratch.replace(file)
        return
    try:
        os.link(scratch, file)
    except FileExistsError:
        pass
    finally:
        scratch.unlink()


def _tasks(entry: Entry, request: BatchRequest) -> Iterable[Task]:
    count = len(entry.parts)
    for number, part in enumerate(entry.parts):
        yield Task(
            entry.unit(number),
            str(request.output.absolute()),
            entry.name,
            entry.index,
            entry.path,
            entry.digest,
            number,
            count,
            part,
            entry.size // count,
            request.options,
        )


def _remove_outdated(output: Path, tasks: Iterable[Task]) -> None:
    """Remove parts of recordings that have changed since."""
    digests = {(task.recording, task.digest) for task in tasks}
    for recording in {task.recording for task in tasks}:
        for file in (output / FOLDER / part_folder(recording)).parent.glob(f"*/{UNIT}"):
            try:
                found = json.loads(file.read_text("utf-8"))["digest"]
            except (OSError, ValueError, KeyError):
                found = None
            if (recording, found) not in digests:
                shutil.rmtree(file.parent, ignore_errors=True)


def _note(output: Path, outcome: Outcome) -> None:
    """Keep what is known of a failure until the unit is done."""
    file = output / FAILED / f"{outcome.unit}.json"
    if outcome.reason:
        file.parent.mkdir(exist_ok=True)
        _write_whole(file, json.dumps(asdict(outcome), indent=1) + "\n")
    else:
        file.unlink(missing_ok=True)
