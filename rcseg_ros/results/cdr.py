"""Messages straight from arrays to CDR bytes, which publishers and recordings take as they are.

rclpy copies bulk data three times on its way from an array to the wire, and makes an object of every point of
a marker; a large cloud or mesh takes longer there than all that was computed for it.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

HEAD = b"\x00\x01\x00\x00"
"""Plain CDR, little-endian; alignment is counted from behind it."""


@dataclass(frozen=True)
class Serialized:
    """A message as bytes, with its type name."""

    type: str
    data: bytes


class Cdr:
    """Values one after the other, each aligned to its size."""

    def __init__(self) -> None:
        self._parts: list[Any] = [HEAD]
        self._now = bytearray()
        self._size = 0  # behind the head, of the parts before this one

    def align(self, size: int) -> None:
        self._now += bytes(-(self._size + len(self._now)) % size)

    @property
    def offset(self) -> int:
        """Where the next byte lies, modulo the largest alignment."""
        return (self._size + len(self._now)) % 8

    def put(self, form: str, *values: Any) -> None:
        """Numbers of one size, in the form of `struct`."""
        self.align(struct.calcsize(f"<{form[-1]}"))
        self.pack(form, *values)

    def pack(self, form: str, *values: Any) -> None:
        """Numbers as they come, alignment being the form's."""
        self._now += struct.pack(f"<{form}", *values)

    def raw(self, data: bytes) -> None:
        self._now += data

    def text(self, value: str) -> None:
        data = value.encode() + b"\x00"
        self.put("I", len(data))
        self._now += data

    def header(self, header: Any) -> None:
        """A std_msgs/Header of whatever message library."""
        self.put("i", int(header.stamp.sec))
        self.put("I", int(header.stamp.nanosec))
        self.text(str(header.frame_id))

    def array(self, values: NDArray[Any]) -> None:
        """The bytes of a contiguous array; they are not copied before `bytes`."""
        self._parts += [bytes(self._now), memoryview(values.reshape(-1).view(np.uint8))]
        self._size += len(self._now) + values.nbytes
        self._now = bytearray()

    def bytes(self) -> bytes:
        return b"".join([*self._parts, self._now])
