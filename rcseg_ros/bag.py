"""Recordings as a stream of typed messages: rosbag2 folders (mcap or sqlite3) and bare .mcap files.

rosbags reads what is whole. A file whose end or index is damaged is read with the mcap package from its
beginning up to the damage instead, so that all frames before it are saved; `Recording.damage` tells of it.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

from rosbags.interfaces import MessageDefinitionFormat, Qos
from rosbags.rosbag2 import Reader
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

from rcseg_core.errors import InputError
from rcseg_ros.conversions import MessageError


@dataclass(frozen=True)
class Topic:
    """One recorded topic; ``definition`` is the message definition's text, empty where the file has none."""

    name: str
    type: str
    count: int
    definition: str = field(default="", repr=False)
    is_idl: bool = False
    qos: tuple[Qos, ...] = field(default=(), repr=False)


@dataclass(frozen=True)
class RawMessage:
    """A message as it lies in the recording: CDR bytes and the time at which it was recorded."""

    topic: str
    log_ns: int
    data: bytes = field(repr=False)

    @property
    def stamp_ns(self) -> int:
        """Stamp of a message that begins with a header; the time of recording where that is zero."""
        if len(self.data) < 12:
            return self.log_ns
        sec, nanosec = struct.unpack_from("<iI" if self.data[1] & 1 else ">iI", self.data, 4)
        return sec * 1_000_000_000 + nanosec or self.log_ns


class _Source(Protocol):
    topics: dict[str, Topic]

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]: ...

    def close(self) -> None: ...


class Recording:
    """A recording that is open for reading; use as a context manager.

    Parameters
    ----------
    path : rosbag2 folder or .mcap file

    Attributes
    ----------
    topics : dict of Topic by name
    damage : list of str
        What is wrong with the file; grows while messages are read.

    Raises
    ------
    InputError
        If there is no such file, or nothing in it can be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage: list[str] = []
        self._types: dict[str, Callable[[bytes], Any]] = {}
        self._source = self._open()
        self.topics = self._source.topics

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self._source.close()

    def _open(self) -> _Source:
        path = self.path
        if not path.exists():
            raise InputError(f"{path}: no such file or folder")
        if path.is_file() and path.suffix != ".mcap":
            raise InputError(f"{path}: not a recording rcseg reads; give an .mcap file or a rosbag2 folder")
        files = [path] if path.is_file() else sorted(path.glob("*.mcap"))
        if not files and not (path / "metadata.yaml").exists():
            raise InputError(f"{path}: neither metadata.yaml nor an .mcap file in this folder")
        try:
            source = _IndexedSource(path)
            if source.topics or not files:
                return source
            source.close()  # a file without summary shows its topics only when it is read through
        except Exception as error:
            # Whatever the library stumbles over: the messages before the damage can still be had one by one.
            if not files:
                raise InputError(f"{path}: cannot be read: {_one_line(error)}") from error
            self.damage.append(f"{path}: {_one_line(error)}")
        return _ScannedSource(files, self.damage)

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        """Messages of the given topics in the order of recording, up to the first damage."""
        try:
            yield from self._source.messages(topics)
        except Exception as error:
            text = f"{self.path}: {_one_line(error)}; nothing after this was read"
            if text not in self.damage:
                self.damage.append(text)

    def first(self, topic: str) -> Any | None:
        """The first message of a topic, deserialised; None if there is none that can be read."""
        raw = next(self.messages([topic]), None)
        return None if raw is None else self.decode(raw)

    def decode(self, raw: RawMessage) -> Any:
        """Deserialise a message by the definition that the recording itself carries.

        Raises
        ------
        MessageError
            Reason ``bad_cdr``: its bytes are not a message of its type.
        """
        topic = self.topics[raw.topic]
        if topic.type not in self._types:
            self._types[topic.type] = deserializer(topic)
        try:
            return self._types[topic.type](raw.data)
        except Exception as error:
            raise MessageError("bad_cdr", f"{raw.topic}: not a {topic.type}: {_one_line(error)}") from error


def deserializer(topic: Topic) -> Callable[[bytes], Any]:
    """Function from CDR bytes to messages of the topic's type; numeric arrays become numpy arrays."""
    if topic.definition:
        store = get_typestore(Stores.EMPTY)
        parse = _parse_idl if topic.is_idl else get_types_from_msg
        store.register(parse(topic.definition, topic.type))
    else:  # sqlite3 recordings of older distributions carry no definitions
        store = get_typestore(Stores.ROS2_JAZZY)
    return lambda data: store.deserialize_cdr(data, topic.type)


def _parse_idl(text: str, _: str) -> dict[str, Any]:
    separator = "=" * 80 + "\n"
    parts = [part.split("\n", 1)[1] for part in text.split(separator) if part.startswith("IDL: ")] or [text]
    return {name: fields for part in parts for name, fields in get_types_from_idl(part).items()}


class _IndexedSource:
    """A whole recording, read through its index in the order of time."""

    def __init__(self, path: Path) -> None:
        self._reader = Reader(path)
        self._reader.open()
        self.topics = {
            connection.topic: Topic(
                connection.topic,
                connection.msgtype,
                sum(c.msgcount for c in self._reader.connections if c.topic == connection.topic),
                connection.msgdef.data,
                connection.msgdef.format == MessageDefinitionFormat.IDL,
                tuple(connection.ext.offered_qos_profiles),
            )
            for connection in self._reader.connections
        }

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        connections = [c for c in self._reader.connections if c.topic in topics]
        if connections:  # rosbags takes an empty list for all
            for connection, log_ns, data in self._reader.messages(connections):
                yield RawMessage(connection.topic, log_ns, bytes(data))

    def close(self) -> None:
        self._reader.close()


class _ScannedSource:
    """A damaged recording: each file from its beginning to its first bad byte, in the order of writing."""

    def __init__(self, files: list[Path], damage: list[str]) -> None:
        self._files = files
        self.topics: dict[str, Topic] = {}
        self._readable: dict[Path, int] = {}
        for path in files:
            self._readable[path] = 0
            try:
                for topic, _ in self._scan(path):
                    known = self.topics.get(topic.name, topic)
                    self.topics[topic.name] = replace(known, count=known.count + 1)
                    self._readable[path] += 1
            except Exception as error:
                damage.append(f"{path}: readable for {self._readable[path]} messages: {_one_line(error)}")
        if not any(self._readable.values()):
            why = damage[-1].split(": ", 1)[1] if damage else "there is no message in it"
            raise InputError(f"{files[0]}: cannot be read: {why}")

    @staticmethod
    def _scan(path: Path) -> Iterator[tuple[Topic, RawMessage]]:
        from mcap.records import Channel, Message, Schema
        from mcap.stream_reader import StreamReader

        schemas: dict[int, Schema] = {}
        topics: dict[int, Topic] = {}
        with path.open("rb") as stream:
            for record in StreamReader(stream, validate_crcs=True).records:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    schema = schemas[record.schema_id]
                    qos = tuple(parse_qos(record.metadata.get("offered_qos_profiles", "")))
                    text, is_idl = schema.data.decode(), schema.encoding == "ros2idl"
                    topics[record.id] = Topic(record.topic, schema.name, 0, text, is_idl, qos)
                elif isinstance(record, Message):
                    topic = topics[record.channel_id]
                    yield topic, RawMessage(topic.name, record.log_time, record.data)

    def messages(self, topics: Collection[str]) -> Iterator[RawMessage]:
        for path in self._files:
            readable = self._readable[path]
            if readable:
                for count, (topic, raw) in enumerate(self._scan(path), start=1):
                    if topic.name in topics:
                        yield raw
                    if count == readable:
                        break

    def close(self) -> None:
        pass


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
