"""Passes over an image by bands of rows, on all cores.

Kernels release the interpreter lock, so plain threads run them at once; that also works inside a program that
has threads of its own, which the thread pools of Numba do not. The bands are the same for every number of
threads, and sums are added up band by band: results never depend on the machine.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait

#: Bands of an image: enough to share out evenly, few enough that their tables are added up in no time.
BANDS = 4
#: Images of fewer rows are done sooner than another thread has woken up.
LEAST_ROWS = 300

_pool: ThreadPoolExecutor | None = None
_threads = 0


def cores() -> int:
    """Processors that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        return os.cpu_count() or 1


def threads() -> int:
    """Threads that a pass uses: what `set_threads` said, else RCSEG_THREADS, else all processors."""
    global _threads
    if _threads == 0:
        named = os.environ.get("RCSEG_THREADS", "")
        _threads = int(named) if named.isdigit() and int(named) > 0 else cores()
    return _threads


def set_threads(number: int) -> None:
    """Use `number` threads from now on (0: RCSEG_THREADS or all processors); results stay the same."""
    global _threads
    if number < 0:
        raise ValueError(f"threads: expected 0 or more, got {number}")
    _threads = number


def _workers() -> ThreadPoolExecutor:
    global _pool
    if _pool is None:
        _pool = ThreadPoolExecutor(max(BANDS, cores()), thread_name_prefix="rcseg")
    return _pool


def _forget_pool() -> None:
    """A forked child has none of the threads of its parent."""
    global _pool
    _pool = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_pool)


def bands(height: int) -> list[tuple[int, int]]:
    """First row and row after the last of each band."""
    return [(height * i // BANDS, height * (i + 1) // BANDS) for i in range(BANDS)]


def together(*tasks: Callable[[], object]) -> None:
    """Run all tasks, on as many threads as there are to use; the first error, if any, is raised."""
    number = min(threads(), len(tasks))
    if number <= 1:
        for task in tasks:
            task()
        return
    waiting = iter(tasks)

    def work() -> None:
        for task in waiting:
            task()

    helpers = [_workers().submit(work) for _ in range(number - 1)]
    try:
        work()
    finally:
        # all tasks are taken by now: a helper that has not begun has nothing to do (and may never begin, when
        # all workers wait like this)
        begun = [helper for helper in helpers if not helper.cancel()]
        wait(begun)
    for helper in begun:
        helper.result()


def over_bands(height: int, work: Callable[[int, int, int], object], least: int = LEAST_ROWS) -> None:
    """Call work(band, first row, row after the last) for each band; one after another below `least` rows."""
    if height < least:
        for i, (first, last) in enumerate(bands(height)):
            work(i, first, last)
        return
    together(*(lambda i=i, a=a, b=b: work(i, a, b) for i, (a, b) in enumerate(bands(height))))
