"""Passes over an image by bands of rows, on all cores.

Kernels release the interpreter lock, so plain threads run them at once; that also works inside a program that
has threads of its own, which the thread pools of Numba do not. The bands are the same for every number of
threads, and sums are added up band by band: results never depend on the machine.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from functools import cache, partial
from itertools import repeat
from queue import SimpleQueue

import cv2

from rcseg_core.errors import ConfigError

#: Bands of an image: enough to share out evenly, few enough that their tables are added up in no time.
BANDS = 4
#: Images of fewer rows are done sooner than another thread has woken up.
LEAST_ROWS = 300
#: Squares of terms over all regions of a part that are worth another thread (about 50 us).
LEAST_PRODUCTS = 10_000

_pool: SimpleQueue[_Job] | None = None
_threads = 0


def cores() -> int:
    """Processors that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        return os.cpu_count() or 1


def threads() -> int:
    """Threads that a pass uses: what `set_threads` said, else RCSEG_THREADS, else all processors.

    Raises
    ------
    ConfigError
        If RCSEG_THREADS is no number.
    """
    global _threads
    if _threads == 0:
        named = os.environ.get("RCSEG_THREADS", "").strip()
        if named and not (named.isascii() and named.isdigit()):
            raise ConfigError(
                f"environment: RCSEG_THREADS is {named!r}; expected a whole number, or 0 for all processors"
            )
        _threads = int(named or 0)
        if _threads > 0:
            cv2.setNumThreads(_threads)
        _threads = _threads or cores()
    return _threads


def set_threads(number: int) -> None:
    """Use `number` threads from now on (0: RCSEG_THREADS or all processors); results stay the same.

    OpenCV, which does some of the passes, gets as many.
    """
    global _threads
    if number < 0:
        raise ValueError(f"threads: expected 0 or more, got {number}")
    _threads = number
    cv2.setNumThreads(number or -1)


class _Job:
    """Tasks that several threads take in turn; `closed` once all are taken, `begun` helpers have a share."""

    def __init__(self, tasks: tuple[Callable[[], object], ...]) -> None:
        self.waiting = iter(tasks)
        self.lock = threading.Lock()
        self.closed = False
        self.begun = 0
        #: what each helper that has begun ended with
        self.ended: SimpleQueue[BaseException | None] = SimpleQueue()


def _take_part(job: _Job) -> None:
    with job.lock:
        if job.closed:
            return
        job.begun += 1
    error: BaseException | None = None
    try:
        for task in job.waiting:
            task()
    except BaseException as raised:  # it is raised where the tasks were given
        error = raised
    job.ended.put(error)


def _help(jobs: SimpleQueue[_Job]) -> None:
    """What a thread of the pool does for ever; while it waits it holds on to nothing."""
    while True:
        _take_part(jobs.get())


def _jobs() -> SimpleQueue[_Job]:
    """The queue of the pool, whose threads are started on first use and end with the program."""
    global _pool
    if _pool is None:
        _pool = SimpleQueue()
        for i in range(max(BANDS, cores())):
            threading.Thread(target=_help, args=(_pool,), name=f"rcseg_{i}", daemon=True).start()
    return _pool


def _forget_pool() -> None:
    """A forked child has none of the threads of its parent."""
    global _pool
    _pool = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_pool)


@cache
def bands(height: int) -> list[tuple[int, int]]:
    """First row and row after the last of each band; not to be changed."""
    return [(height * i // BANDS, height * (i + 1) // BANDS) for i in range(BANDS)]


def together(*tasks: Callable[[], object]) -> None:
    """Run all tasks, on as many threads as there are to use; the first error, if any, is raised."""
    number = min(threads(), len(tasks))
    if number <= 1:
        for task in tasks:
            task()
        return
    job, jobs = _Job(tasks), _jobs()
    for _ in range(number - 1):
        jobs.put(job)
    try:
        for task in job.waiting:
            task()
    finally:
        # all tasks are taken by now: a helper that has not begun has nothing to do (and may never begin, when
        # all threads of the pool wait like this)
        with job.lock:
            job.closed = True
        errors = [job.ended.get() for _ in range(job.begun)]
    for error in errors:
        if error is not None:
            raise error


def over_regions(count: int, terms: int, work: Callable[[int, int], object]) -> None:
    """Call work(first, last) for parts of the rows 1..count-1 of a table of regions, each with so many terms.

    Few regions or small models are done sooner than another thread has woken up.
    """
    parts = max(1, min(BANDS, (count - 1) * terms**2 // LEAST_PRODUCTS))
    bounds = [1 + (count - 1) * i // parts for i in range(parts + 1)]
    together(*map(partial, repeat(work), bounds[:-1], bounds[1:]))


def over_bands(height: int, work: Callable[[int, int, int], object], least: int = LEAST_ROWS) -> None:
    """Call work(band, first row, row after the last) for each band; one after another below `least` rows."""
    tasks = [partial(work, i, first, last) for i, (first, last) in enumerate(bands(height))]
    if height < least:
        for task in tasks:
            task()
        return
    together(*tasks)
