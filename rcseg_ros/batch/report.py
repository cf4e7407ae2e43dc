"""What `rcseg batch` shows: progress over all units, a table of what failed, the words at the end."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from time import perf_counter

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from rcseg_ros.batch.run import BatchPlan, BatchRequest, BatchSummary, plan_batch, run_batch
from rcseg_ros.batch.runners import LocalRunner, Runner
from rcseg_ros.batch.work import Outcome, Task
from rcseg_ros.console import at_least
from rcseg_ros.tables.parquet import FOLDER
from rcseg_ros.warmup import warm_up

SOME_FAILED = 3  # exit code
FAULTS_WIDTH = 200
LOG_EVERY_S = 30.0  # a line where there is no terminal
_OUT = Console(highlight=False)
_PROGRESS = Console(stderr=True, highlight=False)


@dataclass(frozen=True)
class Runners:
    """Which runner is wanted, and its parameters."""

    kind: str = "local"
    address: str = ""
    workers: int = 0
    cpus: float = 1.0
    memory_mb: int = 2000

    def make(self, tasks: int, on_frame: Callable[[], None]) -> Runner:
        """Start it, with no more workers than there are tasks."""
        if self.kind == "ray":
            from rcseg_ros.batch.ray_runner import RayRunner

            return RayRunner(self.address, self.workers, self.cpus, self.memory_mb)
        from rcseg_core.compute.parallel import cores

        return LocalRunner(min(self.workers or cores(), tasks), self.memory_mb, on_frame)


def run_batch_command(request: BatchRequest, runners: Runners, dry_run: bool) -> int:
    """Plan, run, and say what became of it; return the exit code."""
    start = perf_counter()
    plan = plan_batch(request, keep=not dry_run)
    todo = plan.missing
    _OUT.print(_what_there_is(plan, perf_counter() - start), soft_wrap=True)
    if dry_run:
        for task in todo:
            _OUT.print(f"{task.unit}  {task.path}", soft_wrap=True, markup=False)
        return 0
    if not todo:
        return _conclude(request, BatchSummary(dict(plan.done)))
    if runners.kind == "local":  # once, and not in each worker at the same time
        warm_up(request.options.config, lambda text: _OUT.print(text))
    with _bar(todo) as bar:
        runner = runners.make(len(todo), bar.on_frame)
        try:
            summary = run_batch(request, plan, runner, bar.on_outcome)
        finally:
            runner.close()
    return _conclude(request, summary)


def _what_there_is(plan: BatchPlan, seconds: float) -> str:
    megabytes = sum(task.size for task in plan.missing) / 1e6
    return (
        f"{plan.recordings} recordings, {len(plan.tasks)} units, {len(plan.done)} of them done; "
        f"{len(plan.missing)} to do, {megabytes:.0f} MB (planned in {seconds:.1f} s)"
    )


def _conclude(request: BatchRequest, summary: BatchSummary) -> int:
    for one in summary.outcomes.values():
        if one.unit in summary.new:
            for warning in one.warnings:
                print(f"rcseg: warning: {warning}", file=sys.stderr)
    if summary.new:
        _OUT.print(_figures(summary), soft_wrap=True)
    _OUT.print(f"tables in {request.output / FOLDER}", soft_wrap=True, markup=False)
    if not summary.faulty:
        return 0
    at_least(_OUT, FAULTS_WIDTH).print(_faults(summary))
    return SOME_FAILED


def _figures(summary: BatchSummary) -> str:
    new = [summary.outcomes[name] for name in summary.new]
    good = [one for one in new if not one.reason]
    rejected = sum(sum(one.rejected.values()) for one in good)
    lines = [
        f"{len(good)} units done, {len(new) - len(good)} failed: {summary.frames} frames in "
        f"{summary.seconds:.1f} s, {summary.frames / max(summary.seconds, 1e-9):.1f} frames/s"
    ]
    if rejected:
        lines.append(f"{rejected} frames were rejected; the table frames says why")
    if good:
        overhead = sorted(one.overhead_s for one in good)[len(good) // 2]
        lines.append(
            f"a worker held {max(one.peak_mb for one in good):.0f} MB at most; a unit took "
            f"{1e3 * overhead:.0f} ms beside its frames (median)"
        )
    return "\n".join(lines)


def _faults(summary: BatchSummary) -> Table:
    table = Table(title="failed or damaged", title_justify="left", show_lines=False)
    table.add_column("unit", no_wrap=True)
    table.add_column("tries", justify="right")
    table.add_column("frames", justify="right")
    table.add_column("why", overflow="fold")
    for one in sorted(summary.faulty, key=lambda one: one.unit):
        table.add_row(one.unit, str(one.attempt), str(one.frames), one.reason or "; ".join(one.damage))
    return table


class _Bar:
    """Bytes of input that are done, for the time left; frames a second; units that are done and failed."""

    def __init__(self, tasks: list[Task], tell: Callable[[int, str], None]) -> None:
        self._tell, self._all = tell, len(tasks)
        self._start, self._bytes, self._done, self._failed = perf_counter(), 0, 0, 0
        self._seen = self._counted = 0

    def on_frame(self) -> None:
        """A worker has done a frame; not every runner says so."""
        self._seen += 1
        self._say()

    def on_outcome(self, task: Task, outcome: Outcome) -> None:
        self._bytes += task.size
        self._done += 1
        self._failed += bool(outcome.reason)
        self._counted += outcome.frames
        self._say()

    def _say(self) -> None:
        rate = max(self._seen, self._counted) / max(perf_counter() - self._start, 1e-9)
        failed = f", {self._failed} failed" if self._failed else ""
        self._tell(self._bytes, f"{self._done}/{self._all} units{failed}, {rate:.1f} frames/s")


@contextmanager
def _bar(tasks: list[Task]) -> Iterator[_Bar]:
    if not _PROGRESS.is_terminal:
        said = perf_counter()
        start, total = said, max(sum(task.size for task in tasks), 1)

        def tell(done: int, text: str) -> None:
            nonlocal said
            now = perf_counter()
            if now - said >= LOG_EVERY_S:
                said = now
                left = (now - start) * (total - done) / done if done else 0.0
                _PROGRESS.print(f"{text}, {left:.0f} s left" if done else text, soft_wrap=True)

        yield _Bar(tasks, tell)
        return
    with Progress(
        BarColumn(), TextColumn("{task.description}, left"), TimeRemainingColumn(), console=_PROGRESS,
        transient=True,
    ) as progress:  # fmt: skip
        line = progress.add_task("", total=sum(task.size for task in tasks))
        yield _Bar(tasks, lambda done, text: progress.update(line, completed=done, description=text))
