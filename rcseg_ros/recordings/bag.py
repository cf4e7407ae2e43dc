"""Recordings as a stream of typed messages: rosbag2 folders (mcap or sqlite3) and single files of such.

All files of a recording are read in the order of time, whatever their names are, and each as far as it is
whole: `Recording.damage` tells what was lost, `Recording.warnings` what was odd though nothing was lost.
"""

from __future__ import annotations

import heapq
import tempfile
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from rcseg_core.errors import InputError
from rcseg_ros.frames.conversions import MessageError
from rcseg_ros.frames.expansion import ExpansionError, unpack_zstd
from rcseg_ros.recordings.layout import (
    METADATA,
    ZSTD_MAGIC,
    Metadata,
    find_files,
    left_logs,
    natural_order,
    open_file,
    read_metadata,
    ros1_bag,
)
from rcseg_ros.recordings.storage import (
    ALWAYS,
    RawMessage,
    Span,
    StoredFile,
    Topic,
    merge_topics,
    one_line,
    same_type,
)

__all__ = ["RawMessage", "Recording", "Topic", "deserializer"]

#: Messages among which the first ones of all topics are looked for.
_LOOK_AT = 32


class Recording:
    """A recording that is open for reading; use as a context manager.

    Parameters
    ----------
    path : rosbag2 folder, or one of its files: .mcap or .db3, compressed or not

    Attributes
    ----------
    topics : dict of Topic by name
    damage : list of str
        What is wrong with the files so that messages are missing; grows while messages are read.
    warnings : list of str
        What is wrong though every message can be read.

    Raises
    ------
    InputError
        If there is no such file, or nothing in it can be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage: list[str] = []
        self.warnings: list[str] = []
        self._types: dict[str, Callable[[bytes], Any]] = {}
        self._firsts: dict[str, RawMessage | None] | None = None
        self._scratch = tempfile.TemporaryDirectory(prefix="rcseg-")
        try:
            self._files = self._open()
        except OSError as error:  # no permission, or it goes away this moment
            self._scratch.cleanup()
            raise InputError(f"{error.filename or path}: cannot be read: {error.strerror or error}") from None
        except BaseException:
            self._scratch.cleanup()
            raise
        self.topics = merge_topics([(t, t.count) for _, file in self._files for t in file.topics.values()])

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self._scratch.cleanup()

    def _open(self) -> list[tuple[Path, StoredFile]]:
        """All files that hold messages, by the time of their first one."""
        metadata = read_metadata(self.path)
        paths = find_files(self.path, metadata)
        files = []
        for path in paths:
            stored = open_file(path, Path(tempfile.mkdtemp(dir=self._scratch.name)))
            if stored.damage:
                self.damage.append(f"{path}: {stored.damage}")
            files.append((path, stored))
        encodings = {topic.encoding for _, file in files for topic in file.topics.values()}
        if "ros1" in encodings and "cdr" not in encodings:
            raise ros1_bag(paths[0])
        count = sum(topic.count for _, file in files for topic in file.topics.values())
        if not count:
            why = self.damage[-1].partition(": ")[2] if self.damage else "there is no message in it"
            raise InputError(f"{paths[0]}: cannot be read: {why}")
        if self.path.is_dir():
            for log in left_logs(self.path):
                self.damage.append(f"{self.path}: no file for {log}, so that its messages are missing")
            self._compare(metadata, {path.name for path in paths}, count)
        readable = [
            (file.start_ns, natural_order(path), path, file)
            for path, file in files
            if file.start_ns is not None
        ]
        return [(path, file) for _, _, path, file in sorted(readable, key=lambda item: item[:2])]

    def _compare(self, metadata: Metadata, names: set[str], count: int) -> None:
        """Note where metadata.yaml and the files differ; messages that it counts and no file has are lost."""
        absent, unnamed = sorted({*metadata.files} - names), sorted(names - {*metadata.files})
        if metadata.fault:
            self.warnings.append(
                f"{self.path}: {metadata.fault}; {_listed(sorted(names))} read in the order of time"
            )
        elif absent and count < metadata.messages:
            self.damage.append(
                f"{self.path}: {_listed(absent)} of {METADATA} not here, "
                f"nor {metadata.messages - count} of its {metadata.messages} messages"
            )
        elif absent or unnamed:
            self.warnings.append(
                f"{self.path}: {METADATA} names {_listed(metadata.files) or 'no file'}; "
                f"{_listed(sorted(names))} read instead"
            )

    def messages(self, topics: Collection[str], span: Span = ALWAYS) -> Iterator[RawMessage]:
        """Messages of the given topics in the order of recording, of each file up to its first damage.

        span : only those recorded from the first time up to the second, which an index finds at once
        """
        streams = [self._stream(path, file, set(topics), span) for path, file in self._files]
        for _, raw in heapq.merge(*streams, key=lambda item: item[0]):
            if raw is not None:
                yield raw

    def times(self, topic: str) -> NDArray[np.int64]:
        """Times at which a topic's messages were recorded, int64 nanoseconds, rising."""
        return np.sort(np.concatenate([file.times(topic) for _, file in self._files]))

    @property
    def has_index(self) -> bool:
        """Whether the messages of a time are found without reading all that come before."""
        return all(file.has_index for _, file in self._files)

    def _stream(
        self, path: Path, file: StoredFile, topics: set[str], span: Span
    ) -> Iterator[tuple[int, RawMessage | None]]:
        """One file's messages after the time of its first: so it is opened no earlier than needed."""
        topics = topics & file.topics.keys()
        if not topics or file.start_ns is None:
            return
        yield file.start_ns, None
        left = sum(file.topics[name].count for name in topics)
        try:
            for raw in file.messages(topics, span):
                left -= 1
                if same_type(self.topics[raw.topic], file.topics[raw.topic]):
                    yield raw.log_ns, _unpacked(raw)
        except Exception as error:
            self._note(f"{path}: {one_line(error)}; nothing after this was read, {left} messages")
        else:
            if left > 0 and span == ALWAYS:
                self._note(f"{path}: {left} messages that its index counts are not there")

    def _note(self, damage: str) -> None:
        if damage not in self.damage:  # it is met again by each reading
            self.damage.append(damage)

    def first(self, topic: str) -> Any | None:
        """The first message of a topic, deserialised; None if there is none that can be read."""
        raw = self.first_raw(topic)
        return None if raw is None else self.decode(raw)

    def first_raw(self, topic: str) -> RawMessage | None:
        """The first message of a topic as it is stored; None if there is none that can be read.

        Most topics begin together, and to find one is to unpack a chunk: so all are looked for at once.
        """
        if self._firsts is None:
            self._firsts = {}
            known = len(self.damage)
            for raw in islice(self.messages(self.topics), _LOOK_AT):
                self._firsts.setdefault(raw.topic, raw)
            del self.damage[known:]  # it is met again, and counted, when the frames are read
        if topic not in self._firsts:
            self._firsts[topic] = next(self.messages([topic]), None)
        return self._firsts[topic]

    def latched(self, ending: str = "/tf_static") -> list[Any]:
        """All messages of the topics whose names end so, deserialised, wherever they lie in the recording.

        What was published once holds for every frame, also for those recorded before it. To be called before
        the frames are read; messages that cannot be read are left out.
        """
        topics = [name for name in self.topics if f"/{name}".endswith(ending)]
        found = []
        for raw in self.messages(topics) if topics else ():
            with suppress(MessageError):
                found.append(self.decode(raw))
        return found

    def decode(self, raw: RawMessage) -> Any:
        """Deserialise a message by the definition that the recording itself carries.

        Raises
        ------
        MessageError
            Reason ``bad_cdr``: its bytes are not a message of its type.
        """
        topic = self.topics[raw.topic]
        try:
            if topic.type not in self._types:
                self._types[topic.type] = deserializer(topic)
            return self._types[topic.type](raw.data)
        except Exception as error:
            raise MessageError("bad_cdr", f"{raw.topic}: not a {topic.type}: {one_line(error)}") from error


def deserializer(topic: Topic) -> Callable[[bytes], Any]:
    """Function from CDR bytes to messages of the topic's type; numeric arrays become numpy arrays."""
    return _deserializer(topic.type, topic.definition, topic.is_idl)


@lru_cache(maxsize=256)
def _deserializer(name: str, definition: str, is_idl: bool) -> Callable[[bytes], Any]:
    """Made once for all recordings of a process: rosbags compiles code for each type."""
    store = _known_types()
    if definition:
        own = get_typestore(Stores.EMPTY)
        own.register((_parse_idl if is_idl else get_types_from_msg)(definition, name))
        # Converted ROS 1 recordings have the names of old, such as K for k, in the same bytes.
        if not (name in store.fielddefs and _layout(own, name) == _layout(store, name)):
            store = own
    return lambda data: store.deserialize_cdr(data, name)


@lru_cache(maxsize=1)
def _known_types() -> Typestore:
    """Recordings in sqlite3 of older distributions carry no definitions."""
    return get_typestore(Stores.ROS2_JAZZY)


def _layout(store: Typestore, name: str) -> list[Any]:
    """Types of the fields in order, those of nested messages too, without the names of fields."""
    if name not in store.fielddefs:
        return [name]
    return [_layout_of(store, kind) for _, kind in store.fielddefs[name][1]]


def _layout_of(store: Typestore, kind: Any) -> Any:
    node, content = kind
    if node == Nodetype.NAME:
        return _layout(store, content)
    if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return node, _layout_of(store, content[0]), content[1]
    return kind


def _listed(names: Collection[str]) -> str:
    """The names, or their number where there are many."""
    return ", ".join(names) if len(names) <= 3 else f"{len(names)} files"


def _unpacked(raw: RawMessage) -> RawMessage:
    """The message as it was before a recorder that compresses each by itself; CDR never begins so."""
    if not raw.data.startswith(ZSTD_MAGIC):
        return raw
    # what cannot be unpacked is refused when it is decoded
    with suppress(zstandard.ZstdError, ExpansionError):
        return replace(raw, data=unpack_zstd(raw.data))
    return raw


def _parse_idl(text: str, _: str) -> dict[str, Any]:
    separator = "=" * 80 + "\n"
    parts = [part.split("\n", 1)[1] for part in text.split(separator) if part.startswith("IDL: ")] or [text]
    return {name: fields for part in parts for name, fields in get_types_from_idl(part).items()}
