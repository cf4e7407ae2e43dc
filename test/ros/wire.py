"""Images and clouds as they come from a wire: any step, padding, byte order and container, by hand."""

import array
from types import SimpleNamespace

import numpy as np
import pytest

from rcseg_ros.frames.conversions import MessageError

CONTAINERS = {
    "bytes": bytes,
    "array": lambda raw: array.array("B", raw),
    "numpy": lambda raw: np.frombuffer(raw, np.uint8),
}


def image(pixels, encoding, padding=0, big_endian=False, container="bytes"):
    """Image message with `padding` bytes of rubbish after each row, its data in one of CONTAINERS."""
    stored = np.ascontiguousarray(pixels.astype(pixels.dtype.newbyteorder(">" if big_endian else "<")))
    rows = stored.view(np.uint8).reshape(pixels.shape[0], -1)
    rows = np.hstack([rows, np.full((len(rows), padding), 0xAB, np.uint8)])
    return SimpleNamespace(
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=int(big_endian),
        step=rows.shape[1],
        data=CONTAINERS[container](rows.tobytes()),
    )


def reason(function, *arguments):
    with pytest.raises(MessageError) as caught:
        function(*arguments)
    assert str(caught.value) and "\n" not in str(caught.value)
    return caught.value.reason


KINDS = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


def cloud(columns, shape, *, big_endian=False, gaps=0, row_padding=0):
    """PointCloud2 from (name, numpy kind, values) in the given order, with unused bytes between and after."""
    order = ">" if big_endian else "<"
    offset, fields, dtype = 0, [], {"names": [], "formats": [], "offsets": []}
    for name, kind, _ in columns:
        offset += gaps
        fields.append(SimpleNamespace(name=name, offset=offset, datatype=KINDS[kind], count=1))
        dtype["names"].append(name)
        dtype["formats"].append(order + kind)
        dtype["offsets"].append(offset)
        offset += np.dtype(kind).itemsize
    table = np.zeros(shape, np.dtype({**dtype, "itemsize": offset + gaps}))
    for name, _, values in columns:
        table[name] = values
    rows = np.frombuffer(table.tobytes(), np.uint8).reshape(shape[0], -1)
    rows = np.hstack([rows, np.full((len(rows), row_padding), 0xCD, np.uint8)])
    return SimpleNamespace(
        height=shape[0], width=shape[1], fields=fields, is_bigendian=big_endian, is_dense=False,
        point_step=table.dtype.itemsize, row_step=rows.shape[1], data=rows.tobytes(),
    )  # fmt: skip
