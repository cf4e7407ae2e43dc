"""Bytes of messages as arrays: rows with or without padding, any byte order, pictures in PNG, JPEG or TIFF.

Drivers leave the step from row to row at zero, count it in pixels, or fill it with garbage. The number of
bytes then tells it where it leaves one reading only; else the message is refused, with both numbers.
"""

from __future__ import annotations

import re
import sys
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_ros.frames.expansion import ExpansionError, check_expansion, claimed_pixels
from rcseg_ros.frames.refusals import MessageError, megabytes

_LARGEST_PIXEL = 8  # bytes: four channels of 16 bits
_VIDEO = re.compile(r"h\.?26[45]|hevc|av1|vp[89]|theora|mpeg-?[24]", re.IGNORECASE)


def row_step(claimed: int, row_bytes: int, rows: int, size: int, what: str) -> int:
    """Bytes from row to row: as claimed where that fits the data, else as the data's size tells.

    Parameters
    ----------
    claimed : the message's own step
    row_bytes : bytes of a row without padding
    size : bytes of data

    Raises
    ------
    MessageError
        Reasons ``bad_step`` and ``truncated_data``.
    """
    if claimed >= row_bytes and size >= claimed * (rows - 1) + row_bytes:
        return claimed
    if size == row_bytes * rows:
        return row_bytes
    if claimed < row_bytes and size % rows == 0 and row_bytes <= size // rows < 2 * row_bytes:
        return size // rows
    if claimed >= row_bytes:
        raise MessageError(
            "truncated_data",
            f"{what} with {claimed} bytes a row needs {megabytes(claimed * rows)}, got {megabytes(size)}; "
            f"without padding it would be {row_bytes} bytes a row, {megabytes(row_bytes * rows)}",
        )
    reason = "truncated_data" if size < row_bytes * rows else "bad_step"
    raise MessageError(
        reason,
        f"{what} needs {row_bytes} bytes a row, {megabytes(row_bytes * rows)}, but the message says "
        f"{claimed} bytes a row and has {megabytes(size)}",
    )


def pixels(message: Any, dtype: np.dtype[Any], channels: int) -> NDArray[Any]:
    """Pixels of a raw Image as (H, W) or (H, W, channels) in native byte order, row padding taken off."""
    height, width = int(message.height), int(message.width)
    row_bytes = width * channels * dtype.itemsize
    data = np.frombuffer(message.data, np.uint8)
    what = f"image: {width}x{height} {message.encoding}"
    if height == 0 or width == 0:
        raise MessageError("empty_image", f"{what} has no pixel")
    step = row_step(int(message.step), row_bytes, height, data.size, what)
    shape = (height, width) if channels == 1 else (height, width, channels)
    strides = (step, channels * dtype.itemsize, dtype.itemsize)[: len(shape)]
    big_endian = bool(message.is_bigendian)
    found = np.ndarray(shape, dtype.newbyteorder(">" if big_endian else "<"), data, 0, strides)
    native = dtype.itemsize == 1 or big_endian == (sys.byteorder == "big")
    return found if native else found.astype(dtype)


def picture(data: NDArray[np.uint8], form: str) -> NDArray[Any]:
    """A compressed picture as it was stored: (H, W) or (H, W, 3 or 4) in BGR order, 8 or 16 bits, or floats.

    Raises
    ------
    MessageError
        Reasons ``bad_compression`` and ``too_large``.
    """
    if _VIDEO.search(form):
        raise MessageError(
            "bad_compression",
            f"compressed image: format {form!r} is a video stream, which is not read; "
            "republish it as images, for example `ros2 run image_transport republish ffmpeg raw`",
        )
    try:
        check_expansion(claimed_pixels(data[:65536].tobytes()) * _LARGEST_PIXEL, data.size)
    except ExpansionError as error:
        raise MessageError("too_large", f"compressed image of format {form!r}: {error}") from None
    # unchanged: 16 bits stay 16, and an EXIF tag does not turn the image out of its camera's grid
    try:
        found = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    except cv2.error:  # more pixels than OpenCV takes
        found = None
    if found is None:
        raise MessageError(
            "bad_compression",
            f"compressed image: {data.size} bytes of format {form!r} "
            "could not be decoded; JPEG, PNG and TIFF are read",
        )
    return found
