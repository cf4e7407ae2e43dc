"""Shared memory of Fast DDS that nobody uses any more: left by processes that were killed, or by this one.

Fast DDS makes a segment in /dev/shm for each participant: half a megabyte by default, 135 MB with the profile
for large messages. It removes the segment when a participant is destroyed; a process that is killed leaves it
for ever, so that a robot which respawns a node runs out of memory one segment at a time.

A segment is in use as long as somebody holds the lock on its `_el` file. That is the rule of `fastdds shm
clean` as well.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import time
from collections.abc import Iterator
from pathlib import Path

SHARED_MEMORY = Path("/dev/shm")
# Fast DDS makes the lock file first and locks it then: what is younger than this may be about to be locked.
YOUNG_S = 2.0
_SEGMENT_LOCK = re.compile(r"fastrtps_[0-9a-f]{16}_el")  # a segment's; those of ports have other names


def clear_dead_segments(folder: Path = SHARED_MEMORY) -> int:
    """Remove the segments whose processes are dead; ports and what living processes use stay.

    Parameters
    ----------
    folder : where the system keeps shared memory; where it is absent nothing is done

    Returns
    -------
    Bytes that were given back. Files of other users are left alone, without a word.
    """
    try:
        locks = [path for path in folder.iterdir() if _SEGMENT_LOCK.fullmatch(path.name)]
    except OSError:
        return 0
    return sum(_clear(lock) for lock in locks)


def clear_own_segments(folder: Path = SHARED_MEMORY) -> int:
    """Remove the segments of this process, just before it ends without destroying its participants.

    Returns
    -------
    Bytes that were given back.
    """
    return sum(_remove(lock) for lock in _own_locks(folder))


def _own_locks(folder: Path) -> Iterator[Path]:
    """Lock files of segments that this process holds locked, not only open."""
    for descriptor in Path("/proc/self/fdinfo").glob("*"):
        with contextlib.suppress(OSError):
            path = Path(os.readlink(f"/proc/self/fd/{descriptor.name}"))
            ours = path.parent == folder and _SEGMENT_LOCK.fullmatch(path.name)
            if ours and "FLOCK" in descriptor.read_text():
                yield path


def _clear(lock: Path) -> int:
    """Remove one segment and its lock file, if nobody holds the lock; bytes that were given back."""
    try:
        descriptor = os.open(lock, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:  # removed by another, or another user's
        return 0
    try:
        if time.time() - os.fstat(descriptor).st_ctime < YOUNG_S:
            return 0
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return _remove(lock)
    except OSError:  # somebody holds it
        return 0
    finally:
        os.close(descriptor)


def _remove(lock: Path) -> int:
    """Remove a segment and then its lock file, without which it would never be found again."""
    segment = lock.with_name(lock.name.removesuffix("_el"))
    try:
        size = segment.lstat().st_size
        segment.unlink()
        lock.unlink()
    except OSError:
        return 0
    return size
