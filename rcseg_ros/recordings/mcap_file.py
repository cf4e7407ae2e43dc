"""mcap files: by their index where it is whole, else from their beginning.

Every chunk that is read is checked by its CRC, the index by its own, and the data as a whole where only that
has one, so that bytes which changed are told of.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Iterator, Mapping
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import McapReader, make_reader
from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Message, MessageIndex, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.summary import Summary
from numpy.typing import NDArray

from rcseg_ros.frames.expansion import check_expansion, check_zstd
from rcseg_ros.recordings.storage import (
    ALWAYS,
    DEFINITIONS,
    RawMessage,
    ScannedFile,
    Span,
    StoredFile,
    Topic,
    merge_topics,
    one_line,
    qos_of,
    same_type,
)

_FOOTER = struct.Struct("<BQQQI8s")
_HEAD_OF_CHUNK = struct.Struct("<25xQII")  # opcode, length and two times; then bytes, CRC, letters of a name
_HEAD_OF_FOOTER = struct.Struct("<BQQQ")
_END_OF_DATA = struct.Struct("<BQI")
_HEAD_OF_RECORD = 9  # opcode and length
#: What releases of the library call the first time that is wanted and the first that is not any more.
_BOUNDS = ("starting_at", "ending_before")
if _BOUNDS[0] not in signature(McapReader.iter_messages).parameters:
    _BOUNDS = ("start_time", "end_time")


def open_mcap(path: Path) -> StoredFile:
    """Open an mcap, by its index if that is whole."""
    try:
        return _IndexedMcap(path)
    except _NoIndex:
        return ScannedFile(path, _scan_mcap)
    except Exception as error:  # whatever the library stumbles over: what comes before can still be had
        return ScannedFile(path, _scan_mcap, one_line(error))


class _NoIndex(Exception):
    """The file is not damaged, but has no index of all its messages."""


class _IndexedMcap:
    """An mcap with an index, whose messages come in the order of time, each chunk checked by its CRC."""

    has_index = True

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage = ""
        with path.open("rb") as stream:
            _check_summary(stream)
            summary = make_reader(stream).get_summary()
        statistics = summary.statistics if summary is not None else None
        if summary is None or statistics is None or not _is_complete(summary):
            raise _NoIndex
        with path.open("rb") as stream:
            _check_chunks(stream, summary.chunk_indexes)
        counts = statistics.channel_message_counts
        self._channels = {
            number: _topic_of(channel, summary.schemas) for number, channel in summary.channels.items()
        }
        self.topics = merge_topics([(topic, counts.get(n, 0)) for n, topic in self._channels.items()])
        self._summary, self._chunks = summary, summary.chunk_indexes
        self.start_ns = min(chunk.message_start_time for chunk in summary.chunk_indexes)
        with path.open("rb") as stream:
            if not _data_is_as_written(stream, summary.chunk_indexes[0].chunk_start_offset):
                self.damage = "bytes have changed: the CRC of its data is not the recorded one"

    def messages(self, topics: Collection[str], span: Span = ALWAYS) -> Iterator[RawMessage]:
        within = {} if span == ALWAYS else dict(zip(_BOUNDS, (max(span[0], 0), max(span[1], 0)), strict=True))
        with self.path.open("rb") as stream:
            reader: Any = make_reader(stream, validate_crcs=True)
            if hasattr(reader, "_summary"):  # else the library reads it anew for each stream
                reader._summary = self._summary
            for _, channel, message in reader.iter_messages(list(topics), **within):
                topic = self._channels[channel.id]
                if same_type(self.topics[topic.name], topic):
                    yield RawMessage(channel.topic, message.log_time, message.data)

    def times(self, topic: str) -> NDArray[np.int64]:
        found: list[int] = []
        numbers = {number for number, own in self._channels.items() if own.name == topic}
        with self.path.open("rb") as stream:
            for chunk in self._chunks:
                for number in numbers & chunk.message_index_offsets.keys():
                    stream.seek(chunk.message_index_offsets[number] + _HEAD_OF_RECORD)
                    found += [ns for ns, _ in MessageIndex.read(ReadDataStream(stream)).records]
        return np.sort(np.array(found, np.int64))


def _check_summary(stream: Any) -> None:
    """Refuse an index whose bytes are not those that were written, where their CRC is recorded."""
    size = stream.seek(0, 2)
    stream.seek(max(0, size - _FOOTER.size))
    footer = stream.read()
    if len(footer) == _FOOTER.size:
        _, _, start, _, crc, _ = _FOOTER.unpack(footer)
        if crc and 0 < start < size:
            stream.seek(start)
            summary = stream.read(size - _FOOTER.size - start)
            if zlib.crc32(footer[: _HEAD_OF_FOOTER.size], zlib.crc32(summary)) != crc:
                raise ValueError("the index is damaged: its CRC is not the recorded one")
    stream.seek(0)


def _data_is_as_written(stream: Any, first_chunk: int) -> bool:
    """Compare the CRC of the whole data section, where chunks have none by which reading would notice."""
    stream.seek(first_chunk + 33)
    if any(stream.read(4)):
        return True
    stream.seek(-_FOOTER.size, 2)
    end_of_data = _FOOTER.unpack(stream.read())[2] - _END_OF_DATA.size
    stream.seek(end_of_data)
    opcode, _, recorded = _END_OF_DATA.unpack(stream.read(_END_OF_DATA.size))
    if opcode != Opcode.DATA_END or not recorded:
        return True
    stream.seek(0)
    crc, left = 0, end_of_data
    while left and (block := stream.read(min(left, 2**24))):
        crc, left = zlib.crc32(block, crc), left - len(block)
    return crc == recorded


def _is_complete(summary: Summary) -> bool:
    """Whether a summary tells of all messages, channels and schemas."""
    statistics, channels = summary.statistics, summary.channels
    assert statistics is not None
    counts = statistics.channel_message_counts
    return (
        0 < len(summary.chunk_indexes) == statistics.chunk_count
        and sum(counts.values()) == statistics.message_count
        and counts.keys() <= channels.keys()
        and all(c.message_index_offsets.keys() <= channels.keys() for c in summary.chunk_indexes)
        and all(c.message_index_offsets or not c.message_end_time for c in summary.chunk_indexes)
        and all(c.schema_id == 0 or c.schema_id in summary.schemas for c in channels.values())
    )


def _topic_of(channel: Channel, schemas: Mapping[int, Schema]) -> Topic:
    schema = schemas.get(channel.schema_id)
    name, encoding, data = (schema.name, schema.encoding, schema.data) if schema else ("", "", b"")
    definition = data.decode("utf-8", "replace") if encoding in DEFINITIONS else ""
    return Topic(
        channel.topic, name, 0, definition, DEFINITIONS.get(encoding, False),
        qos_of(channel.metadata.get("offered_qos_profiles", "")), channel.message_encoding or "cdr",
    )  # fmt: skip


def _records(stream: Any) -> Iterator[McapRecord]:
    """All records in the order of the file, those of a chunk in its place."""
    for record in StreamReader(stream, validate_crcs=True, emit_chunks=True).records:
        if isinstance(record, Chunk):
            _check_chunk(record.uncompressed_size, record.compression, record.data[:18], len(record.data))
            yield from breakup_chunk(record, validate_crc=True)
        else:
            yield record


def _check_chunks(stream: Any, indexes: Collection[ChunkIndex]) -> None:
    """Refuse chunks that claim to unpack to more than is allowed; the index may claim less than they do."""
    for index in indexes:
        stream.seek(index.chunk_start_offset)
        head = stream.read(_HEAD_OF_CHUNK.size)
        if len(head) < _HEAD_OF_CHUNK.size:
            raise ValueError("the index names chunks beyond the end of the file")
        unpacked, _, letters = _HEAD_OF_CHUNK.unpack(head)
        compression = stream.read(min(letters, 16)).decode("utf-8", "replace")
        size = int.from_bytes(stream.read(8), "little")
        _check_chunk(unpacked, compression, stream.read(18), min(size, index.chunk_length))


def _check_chunk(unpacked: int, compression: str, head: bytes, size: int) -> None:
    check_expansion(unpacked, size)
    if compression == "zstd":
        check_zstd(head, size)


def _scan_mcap(path: Path, topics: Collection[str] | None) -> Iterator[tuple[Topic, RawMessage]]:
    schemas: dict[int, Schema] = {}
    channels: dict[int, Topic] = {}
    with path.open("rb") as stream:
        for record in _records(stream):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                if record.id not in channels:  # the summary repeats them
                    channels[record.id] = _topic_of(record, schemas)
            elif isinstance(record, Message):
                topic = channels[record.channel_id]
                if topics is None or topic.name in topics:
                    yield topic, RawMessage(topic.name, record.log_time, record.data)
