"""Results as a rosbag2 folder (mcap) that `ros2 bag play` and Foxglove read, written without ROS.

The messages are those that the node publishes, of the same types and topic names; the definitions of
rcseg_msgs are taken from the .msg files with their comments, so that the bag explains its own fields.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any

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
from rosbags.rosbag2.storage_mcap import McapWriter, zstd
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from rcseg_core.errors import InputError

NAMESPACE = "/rcseg"  # the node's name: its ~/labels is /rcseg/labels
_HERE = Path(__file__).resolve().parent
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
    folder = next((f for f in (_HERE / "msg", _HERE.parent / "rcseg_msgs" / "msg") if f.is_dir()), None)
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


class _QuickMcap(McapWriter):
    """Chunks of zstd's quick level -1: a tenth larger than the default's, in a third of its time."""

    def __init__(self, path: Path, compression: CompressionMode) -> None:
        super().__init__(path, compression)
        if self.compression == "zstd":
            self.compressor = partial(zstd.compress, level=-1)


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

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
