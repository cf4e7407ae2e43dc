"""Signals that end a command, however it was started.

A shell starts what runs in the background, and nohup or a job of a build server all they start, with SIGINT
ignored; Python then leaves it so, and Ctrl-C or a supervisor's request would do nothing.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def taking_signals() -> Iterator[None]:
    """SIGINT raises KeyboardInterrupt, even where it was ignored, and SIGTERM does what SIGINT does."""
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread is told of signals
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, _as_interrupt)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _as_interrupt(number: int, stack: Any) -> None:
    signal.raise_signal(signal.SIGINT)
