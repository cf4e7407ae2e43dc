"""One thread that takes work from a short bounded queue: callbacks never wait for it, and the newest work
wins.

The executor's thread only pairs and enqueues, so services and timers answer while a frame is being
segmented. When the queue is full the oldest entry gives way; whoever put the new one learns which.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Any


class Worker:
    """Run `work(item)` for queued items on a thread of its own.

    Parameters
    ----------
    work : called on the worker's thread, one item at a time; must not raise
    name : the thread's name, as debuggers show it
    """

    def __init__(self, work: Callable[[Any], None], name: str) -> None:
        self._work = work
        self._queue: deque[Any] = deque()
        self._wake = threading.Condition()
        self._stopping = self._busy = False
        # A daemon, so that a process that was told to end does not wait for a frame in work.
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, item: Any, capacity: int) -> list[Any]:
        """Enqueue an item and return the older ones that gave way, so that at most `capacity` wait."""
        with self._wake:
            dropped = [self._queue.popleft() for _ in range(len(self._queue) + 1 - capacity)]
            self._queue.append(item)
            self._wake.notify_all()
        return dropped

    def put_in_turn(self, item: Any) -> None:
        """Enqueue an item once the one before it is done: nothing gives way, and at most one waits."""
        with self._wake:
            self._wake.wait_for(lambda: self._stopping or not (self._queue or self._busy))
            self._queue.append(item)
            self._wake.notify_all()

    def clear(self) -> list[Any]:
        """Forget what waits and return it; an item in work is finished."""
        with self._wake:
            forgotten = list(self._queue)
            self._queue.clear()
        return forgotten

    def stop(self, timeout_s: float) -> bool:
        """Forget what waits and end the thread; False if the item in work did not end in time."""
        with self._wake:
            self._queue.clear()
            self._stopping = True
            self._wake.notify_all()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._queue or self._stopping)
                if self._stopping:
                    return
                item = self._queue.popleft()
                self._busy = True
            self._work(item)
            del item  # a frame of megabytes must not outlive its turn while the thread waits
            with self._wake:
                self._busy = False
                self._wake.notify_all()
