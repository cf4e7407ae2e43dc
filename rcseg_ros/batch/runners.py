"""Who does the units of work: a few calls that processes of this machine, or a cluster, answer.

A runner takes tasks while it has a slot free, and gives an outcome for each, in any order; it never raises
because of a task. Trying again is not its matter.
"""

from __future__ import annotations

import multiprocessing
import os
import resource
import signal
import threading
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from typing import Any, Protocol

from rcseg_core.compute.parallel import cores, set_threads
from rcseg_ros.batch.work import OUT_OF_MEMORY, Outcome, Task, run_unit

#: Memory of a worker, MB, that is not asked for otherwise. Kernels and libraries take 300 of it.
DEFAULT_MEMORY_MB = 2000


class Runner(Protocol):
    """What a run needs of those who do the work."""

    @property
    def slots(self) -> int:
        """Tasks that are worked on at the same time, now."""

    def submit(self, task: Task) -> None:
        """Begin a task; only while fewer than `slots` are in work."""

    def wait(self) -> Outcome:
        """The outcome of the next task that ends, of those in work."""

    def close(self) -> None:
        """Stop at once; what is in work is lost."""


class InlineRunner:
    """This process itself, one task after another: for debugging, and for tests of what is not a runner's."""

    slots = 1

    def __init__(self, on_frame: Callable[[], None] = lambda: None) -> None:
        self._on_frame = on_frame
        self._tasks: list[Task] = []

    def submit(self, task: Task) -> None:
        self._tasks.append(task)

    def wait(self) -> Outcome:
        return run_unit(self._tasks.pop(0), self._on_frame)

    def close(self) -> None:
        self._tasks.clear()


class LocalRunner:
    """Processes of this machine; one that dies fails its task, and another takes its place.

    Parameters
    ----------
    workers : 0: one for each processor
    memory_mb : most that each may allocate; beyond, its task fails. 0: no limit
    on_frame : called after each frame of any of them
    """

    def __init__(
        self,
        workers: int = 0,
        memory_mb: int = DEFAULT_MEMORY_MB,
        on_frame: Callable[[], None] = lambda: None,
    ) -> None:
        # Not forked: kernels and OpenCV have threads by now, which a forked child would lack.
        self._context = multiprocessing.get_context("spawn")
        self._memory_mb = memory_mb
        self._on_frame = on_frame
        self._workers = [self._start() for _ in range(workers or cores())]

    @property
    def slots(self) -> int:
        return len(self._workers)

    def submit(self, task: Task) -> None:
        worker = next(one for one in self._workers if one.task is None)
        if not worker.process.is_alive():  # ended while it had nothing to do
            worker = self._replace(worker)
        worker.task = task
        with suppress(OSError):  # it ends this moment: `wait` will notice
            worker.pipe.send(task)

    def wait(self) -> Outcome:
        while True:
            busy = {worker.pipe: worker for worker in self._workers if worker.task is not None}
            for pipe in wait(list(busy)):
                outcome = self._heard(busy[pipe])  # type: ignore[index]
                if outcome is not None:
                    return outcome

    def _heard(self, worker: _Worker) -> Outcome | None:
        """What a worker has to say; the end of its pipe is its own end."""
        task = worker.task
        assert task is not None
        try:
            said = worker.pipe.recv()
        except (EOFError, OSError):
            worker.process.join()
            reason = _end_of(worker.process.exitcode)
            process = worker.process.pid or 0
            self._replace(worker)
            return Outcome(task.unit, reason, attempt=task.attempt, process=process)
        if said is None:
            self._on_frame()
            return None
        worker.task = None
        if said.reason.startswith(OUT_OF_MEMORY):  # what was left half done may still hold some of it
            worker.process.kill()
            worker.process.join()
            self._replace(worker)
        return said

    def _start(self) -> _Worker:
        here, there = self._context.Pipe()
        process = self._context.Process(target=_work, args=(there, self._memory_mb), daemon=True)
        process.start()
        there.close()
        return _Worker(process, here)

    def _replace(self, worker: _Worker) -> _Worker:
        worker.pipe.close()
        fresh = self._start()
        self._workers[self._workers.index(worker)] = fresh
        return fresh

    def close(self) -> None:
        for worker in self._workers:
            worker.process.kill()
        for worker in self._workers:
            worker.process.join()
            worker.pipe.close()


class _Worker:
    """A process, the pipe to it and what it is doing."""

    def __init__(self, process: Any, pipe: Connection) -> None:
        self.process = process
        self.pipe = pipe
        self.task: Task | None = None


def _work(pipe: Connection, memory_mb: int) -> None:
    """Do tasks until the pipe ends; runs in a process of its own."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # who started us stops us
    threading.Thread(target=_end_with_parent, daemon=True).start()
    limit_memory(memory_mb)
    single_thread()
    while True:
        try:
            task = pipe.recv()
        except (EOFError, OSError):
            return
        pipe.send(run_unit(task, lambda: pipe.send(None)))


def single_thread() -> None:
    """Kernels, OpenCV and Arrow of this process use one thread each: frames are shared out, not pixels."""
    import pyarrow as pa

    set_threads(1)
    pa.set_cpu_count(1)
    pa.set_io_thread_count(1)


def limit_memory(memory_mb: int) -> None:
    """Let this process allocate no more than so much; 0: no limit."""
    if memory_mb:
        resource.setrlimit(resource.RLIMIT_DATA, (memory_mb * 10**6, resource.RLIM_INFINITY))


def _end_with_parent() -> None:
    """A worker whose parent was killed is of no use to anyone."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _end_of(code: int | None) -> str:
    if code is not None and code < 0:
        name = signal.Signals(-code).name
        killed = "; by the system, if memory was short" if name == "SIGKILL" else ""
        return f"its worker process was ended by {name}{killed}"
    return f"its worker process ended with exit code {code}"
