"""Results as a rosbag2 folder (mcap) that `ros2 bag play` and Foxglove read, written without ROS.

The messages are those that the node publishes, of the same types and topic names; the definitions of
rcseg_msgs are taken from the .msg files with their comments, so that the bag explains its own fields.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any

import zstandard
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import McapWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from rcseg_core.errors import InputError

#: Of zstd, for chunks: it goes in steps of four bytes, as the numbers of a point do (docs/batch.md).
LEVEL = -3
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, number, times of recording and of publishing
NAMESPACE = "/rcseg"  # the node's name: its ~/labels is /rcseg/labels
_PACKAGE = Path(__file__).resolve().parents[1]
_SEPARATOR = "=" * 80 + "\n"


def _qos(durability: QosDurability) -> Qos:
    never = QosTime(9223372036, 854775807)  # how rosbag2 writes an infinite duration
    return Qos(
        QosHistory.KEEP_LAST, 10, QosReliability.RELIABLE, durability, never, never,
        QosLiveliness.AUTOMATIC, never, False,
    )  # fmt: skip


RELIABLE, LATCHED = _qos(QosDurability.VOLATILE), _qos(QosDurability.TRANSIENT_LOCAL)


@lru_cache(maxsize=1)
def message_definitions() -> dict[str, str]:
    """Text of each rcseg_msgs definition by type name, as installed with rcseg or from the source tree."""
    folder = next((f for f in (_PACKAGE / "msg", _PACKAGE.parent / "rcseg_msgs" / "msg") if f.is_dir()), None)
    if folder is None:
        raise InputError("the definitions of rcseg_msgs are missing: reinstall rcseg")
    return {f"rcseg_msgs/msg/{path.stem}": path.read_text("utf-8") for path in sorted(folder.glob("*.msg"))}


@lru_cache(maxsize=1)
def result_types() -> Typestore:
    """Message types of ROS 2 Jazzy and of rcseg_msgs."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types: dict[str, Any] = {}
    for name, text in message_definitions().items():
        types.update(get_types_from_msg(text, name))
    store.register(types)
    return store


def make_message(type_name: str, **fields: Any) -> Any:
    """Build a message that recordings hold; all fields are to be given, arrays as numpy arrays."""
    return result_types().types[type_name](**fields)


def serialize(message: Any) -> memoryview:
    """CDR bytes of a message built by `make_message`."""
    return result_types().serialize_cdr(message, message.__msgtype__)


def definition_text(type_name: str) -> str:
    """Definition of a type and of all that it contains, in the form of an mcap schema, our comments kept."""
    text, _ = result_types().generate_msgdef(type_name, ros_version=2)
    own = message_definitions()
    head, *parts = text.split(_SEPARATOR)
    sections = [own.get(type_name, head)]
    for part in parts:
        title, body = part.split("\n", 1)
        package, name = title.removeprefix("MSG: ").split("/")
        sections.append(f"{title}\n{own.get(f'{package}/msg/{name}', body)}")
    return _SEPARATOR.join(section if section.endswith("\n") else section + "\n" for section in sections)


def _by_its_types(metadata: str) -> str:
    """Metadata that names the distribution whose types these are: readers know no "rosbags"."""
    return metadata.replace("ros_distro: rosbags", "ros_distro: jazzy")


class _Pieces(BytesIO):
    """A chunk as the pieces that were written to it: a cloud of 6 MB would be copied three times else."""

    def __init__(self) -> None:
        super().__init__()
        self._pieces: list[Any] = []
        self._size = 0

    def write(self, data: Any) -> int:
        self.take(bytes(data))
        return len(data)

    def take(self, data: Any) -> None:
        """Take in bytes that nobody changes any more."""
        self._pieces.append(data)
        self._size += len(data)

    def tell(self) -> int:
        return self._size

    def getvalue(self) -> Any:
        return self._pieces


class _QuickMcap(McapWriter):
    """Chunks of a quick level of zstd: a sixth larger than the default's, in a quarter of its time."""

    chunk: Any

    def __init__(self, path: Path, compression: CompressionMode) -> None:
        super().__init__(path, compression)
        self.compressor: Any = _compress
        self.chunk.bio = _Pieces()

    def write(self, connection: Connection, timestamp: int, data: bytes | memoryview) -> None:
        chunk = self.chunk
        self.message_start_time = min(timestamp, self.message_start_time)
        self.message_end_time = max(timestamp, self.message_end_time)
        self.channel_stats[connection.id] += 1
        chunk.message_start_time = min(timestamp, chunk.message_start_time)
        chunk.message_end_time = max(timestamp, chunk.message_end_time)
        chunk.msgs[connection.id].append((timestamp, chunk.bio.tell()))
        chunk.bio.take(_MESSAGE.pack(5, len(data) + 22, connection.id, 0, timestamp, timestamp))
        chunk.bio.take(data)
        if chunk.bio.tell() > 2**20:
            self.close_chunk()

    def close_chunk(self) -> None:
        super().close_chunk()
        self.chunk.bio = _Pieces()

    def close(self, version: int, metadata: str) -> None:
        super().close(version, _by_its_types(metadata))


def _compress(pieces: list[Any]) -> bytes:
    stream = zstandard.ZstdCompressor(level=LEVEL).compressobj(size=sum(len(piece) for piece in pieces))
    return b"".join([*(stream.compress(piece) for piece in pieces), stream.flush()])


class _QuickWriter(Writer):
    STORAGE_PLUGINS = MappingProxyType({StoragePlugin.MCAP: _QuickMcap})


class BagWriter:
    """A rosbag2 folder that is being written; `close` makes it readable, whatever happened before.

    Parameters
    ----------
    folder : must not exist yet
    """

    def __init__(self, folder: Path) -> None:
        self._writer = _QuickWriter(folder, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP)
        self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._writer.open()
        self._connections: dict[str, Connection] = {}

    def write(
        self, topic: str, type_name: str, data: bytes | memoryview, log_ns: int, qos: Sequence[Qos] = ()
    ) -> None:
        """Add a message, serialised to CDR; the first of a topic decides its type and QoS."""
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic,
                type_name,
                msgdef=definition_text(type_name),
                rihs01=result_types().hash_rihs01(type_name),
                offered_qos_profiles=qos or (LATCHED if topic == "/tf_static" else RELIABLE,),
            )
        self._writer.write(self._connections[topic], log_ns, data)

    def close(self) -> None:
        self._writer.close()
        file = self._writer.metapath
        file.write_text(_by_its_types(file.read_text("utf-8")), "utf-8")

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
