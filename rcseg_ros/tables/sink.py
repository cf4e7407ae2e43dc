"""Takes the results of a replay into tables: range messages are numbered as they are read."""

from __future__ import annotations

from pathlib import Path

from rcseg_ros.recordings.bag import RawMessage
from rcseg_ros.recordings.segmenting import FrameResult
from rcseg_ros.tables.parquet import Episode, TableWriter
from rcseg_ros.tables.rows import rejected_frame


class TableSink:
    """Every range message that is read makes one row of the table frames, whatever became of it."""

    def __init__(self, folder: Path, episode: Episode) -> None:
        self._tables = TableWriter(folder, episode)
        self._next = episode.first_frame
        self._numbers: dict[int, int] = {}  # by identity: two messages may be equal

    @property
    def rows(self) -> dict[str, int]:
        """Rows of each table that are written."""
        return self._tables.rows

    def expect(self, raw: RawMessage) -> None:
        self._numbers[id(raw)] = self._next
        self._next += 1

    def add(self, result: FrameResult) -> None:
        self._tables.add(self._number(result.raw), result.raw.stamp_ns, result.tables)

    def lose(self, raw: RawMessage, reason: str, error: str) -> None:
        self._tables.add(self._number(raw), raw.stamp_ns, rejected_frame(raw.log_ns, reason, error))

    def close(self) -> None:
        self._tables.close()

    def abandon(self) -> None:
        self._tables.abandon()

    def _number(self, raw: RawMessage) -> int:
        return self._numbers.pop(id(raw))
