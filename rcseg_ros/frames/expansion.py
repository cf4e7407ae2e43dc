"""How far a message or a file may expand when it is unpacked: a bound on memory that follows from its size.

Compressed data say how large they become, and may lie: 200 bytes can claim gigabytes, and a bomb keeps its
word. What claims more than `allowed_bytes` is refused before anything is allocated.
"""

from __future__ import annotations

import io
import math
from typing import Any

import yaml
import zstandard

#: Deflate, in PNG and zip, reaches 1032; zstd and RVL have no bound of their own.
RATIO = 1024
#: Small things may be this large: an image of 4000 x 3000 pixels of one colour compresses to a few bytes.
FLOOR = 256 << 20
#: Parts of a YAML document, its aliases written out.
MOST_PARTS = 1_000_000

#: libyaml's where PyYAML has it: a tenth of the time; it refuses what is nested a thousand deep.
_YAML_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
_BLOCK = 1 << 20


class ExpansionError(ValueError):
    """Unpacked it would be larger than its size allows."""


def allowed_bytes(size: int) -> int:
    """Bytes that something of so many bytes may become: 1024 times, and 256 MB in any case."""
    return FLOOR + RATIO * size


def check_expansion(claimed: int, size: int) -> None:
    """Refuse what claims more than is allowed.

    Parameters
    ----------
    claimed : bytes that it says it has when unpacked
    size : bytes that it has

    Raises
    ------
    ExpansionError
    """
    if claimed > allowed_bytes(size):
        raise ExpansionError(
            f"{size} bytes claim to unpack to {claimed} bytes; at most {allowed_bytes(size)} are taken"
        )


def unpack_zstd(data: bytes) -> bytes:
    """Decompress one or more zstd frames.

    Raises
    ------
    ExpansionError
        It becomes larger than its size allows.
    zstandard.ZstdError
        It is damaged.
    """
    check_zstd(data[:18], len(data))
    most, out = allowed_bytes(len(data)), io.BytesIO()
    with zstandard.ZstdDecompressor().stream_reader(io.BytesIO(data), read_across_frames=True) as reader:
        while block := reader.read(_BLOCK):
            out.write(block)
            if out.tell() > most:
                raise ExpansionError(f"{len(data)} bytes unpack to more than {most} bytes")
    return out.getvalue()


def load_yaml(text: str) -> Any:
    """`yaml.safe_load` where the aliases, written out, are not too many: nine lines can stand for billions.

    Raises
    ------
    yaml.YAMLError
        It is no YAML, or it has more than a million parts.
    """
    loader = None
    try:
        loader = _YAML_LOADER(text)
        node = loader.get_single_node()
        if node is None:
            return None
        if _parts(node, {}) > MOST_PARTS:
            raise yaml.YAMLError(f"its aliases stand for more than {MOST_PARTS} parts")
        return loader.construct_document(node)
    except (RecursionError, ValueError, TypeError) as error:  # a date that is none; a mapping as a key
        raise yaml.YAMLError(str(error) or "it cannot be read") from None
    finally:
        if loader is not None:
            loader.dispose()


def _parts(node: yaml.Node, known: dict[int, int]) -> int:
    """Parts of a node with all aliases written out; of one that holds itself, more than any number."""
    if id(node) not in known:
        known[id(node)] = MOST_PARTS + 1  # until all that it holds is counted
        inner: list[yaml.Node] = []
        if isinstance(node, yaml.SequenceNode):
            inner = node.value
        elif isinstance(node, yaml.MappingNode):
            inner = [part for pair in node.value for part in pair]
        known[id(node)] = 1 + sum(_parts(part, known) for part in inner)
    return known[id(node)]


def check_zstd(head: bytes, size: int) -> None:
    """Refuse zstd data whose first bytes claim too much; those that claim nothing pass."""
    try:
        claimed = zstandard.frame_content_size(head)
    except zstandard.ZstdError:  # no frame: whoever decompresses it says so
        return
    check_expansion(claimed, size)


def claimed_pixels(data: bytes) -> int:
    """Pixels that the head of a PNG or a JPEG claims; 0 for others, and for what is cut off before it."""
    if data.startswith(_PNG) and len(data) >= 24:
        return math.prod((int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")))
    if data.startswith(_JPEG):
        return _jpeg_pixels(data)
    return 0


def _jpeg_pixels(data: bytes) -> int:
    """Pixels by the frame header, the marker C0 to CF but for three that are others."""
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            return int.from_bytes(data[at + 5 : at + 7], "big") * int.from_bytes(data[at + 7 : at + 9], "big")
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return 0
