"""sqlite3 files, row by row: their index of times is what a recorder that was killed leaves damaged."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path

from rcseg_ros.recordings.storage import DEFINITIONS, RawMessage, ScannedFile, StoredFile, Topic, qos_of


def open_sqlite(path: Path) -> StoredFile:
    """Open an sqlite3 file that nobody writes to."""
    return ScannedFile(path, _scan_sqlite)


def _scan_sqlite(path: Path, topics: Collection[str] | None) -> Iterator[tuple[Topic, RawMessage]]:
    # Immutable: no lock, no file beside it, also where nothing may be written.
    with closing(sqlite3.connect(f"{path.absolute().as_uri()}?immutable=1", uri=True)) as base:
        base.execute("PRAGMA writable_schema = ON")  # else a file that was cut is refused as a whole
        known = _topics_of_sqlite(base)
        chosen = [number for number, topic in known.items() if topics is None or topic.name in topics]
        data = "x''" if topics is None else "data"
        rows = base.execute(
            f"SELECT topic_id, timestamp, {data} FROM messages NOT INDEXED "
            f"WHERE topic_id IN ({','.join('?' * len(chosen))}) ORDER BY rowid",
            chosen,
        )
        for number, log_ns, content in rows:
            yield known[number], RawMessage(known[number].name, log_ns, content)


def _topics_of_sqlite(base: sqlite3.Connection) -> dict[int, Topic]:
    """Topics by their number; what older versions of the format lack is left empty."""
    columns = {row[1] for row in base.execute("PRAGMA table_info(topics)")}
    qos = "offered_qos_profiles" if "offered_qos_profiles" in columns else "''"
    definitions: dict[str, tuple[str, str]] = {}
    if base.execute("PRAGMA table_info(message_definitions)").fetchall():
        rows = base.execute(
            "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        )
        definitions = {name: (encoding, text) for name, encoding, text in rows}
    found = {}
    for number, name, kind, encoding, profiles in base.execute(
        f"SELECT id, name, type, serialization_format, {qos} FROM topics"
    ):
        language, text = definitions.get(kind, ("", ""))
        text = text if language in DEFINITIONS else ""
        is_idl = DEFINITIONS.get(language, False)
        found[number] = Topic(name, kind, 0, text, is_idl, qos_of(profiles), encoding)
    return found
