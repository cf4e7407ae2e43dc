"""Colour images: every encoding of sensor_msgs that carries light, as (H, W, 3) uint8 RGB.

Encodings are compared without regard to case. Beside the names of sensor_msgs/image_encodings.hpp those that
drivers use on their own are read (nv12, mono12, yuy2, ...).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_ros.frames.pixels import picture, pixels
from rcseg_ros.frames.reading import BITS, DEFAULT_READING, Reading
from rcseg_ros.frames.refusals import MessageError, megabytes

RGB = NDArray[np.uint8]


class _Encoding(NamedTuple):
    """bits: 8, more (stored in 16), or 0 for 16 of which as many are used as the data need;
    to_rgb: conversion of OpenCV after reduction to 8 bits, None for RGB."""

    bits: int
    channels: int
    to_rgb: int | None


_ENCODINGS = {
    "rgb8": _Encoding(8, 3, None),
    "8uc3": _Encoding(8, 3, cv2.COLOR_BGR2RGB),
    "bgr8": _Encoding(8, 3, cv2.COLOR_BGR2RGB),
    "rgba8": _Encoding(8, 4, cv2.COLOR_RGBA2RGB),
    "bgra8": _Encoding(8, 4, cv2.COLOR_BGRA2RGB),
    "8uc4": _Encoding(8, 4, cv2.COLOR_BGRA2RGB),
    "mono8": _Encoding(8, 1, cv2.COLOR_GRAY2RGB),
    "8uc1": _Encoding(8, 1, cv2.COLOR_GRAY2RGB),
    "mono16": _Encoding(0, 1, cv2.COLOR_GRAY2RGB),
    "16uc1": _Encoding(0, 1, cv2.COLOR_GRAY2RGB),
    "rgb16": _Encoding(0, 3, None),
    "bgr16": _Encoding(0, 3, cv2.COLOR_BGR2RGB),
    "16uc3": _Encoding(0, 3, cv2.COLOR_BGR2RGB),
    "rgba16": _Encoding(0, 4, cv2.COLOR_RGBA2RGB),
    "bgra16": _Encoding(0, 4, cv2.COLOR_BGRA2RGB),
    "16uc4": _Encoding(0, 4, cv2.COLOR_BGRA2RGB),
}
for _bits in (10, 12, 14):
    _ENCODINGS[f"mono{_bits}"] = _Encoding(_bits, 1, cv2.COLOR_GRAY2RGB)
# OpenCV names a Bayer pattern by its second row, ROS by its first: bayer_rggb8 is OpenCV's BayerBG.
for _ros, _opencv in {"rggb": "BG", "bggr": "RG", "gbrg": "GR", "grbg": "GB"}.items():
    for _bits in (8, 10, 12, 14, 16):
        _ENCODINGS[f"bayer_{_ros}{_bits}"] = _Encoding(
            _bits if _bits < 16 else 0, 1, getattr(cv2, f"COLOR_Bayer{_opencv}2RGB")
        )
for _names, _order in {
    ("yuv422", "uyvy", "yuv422_uyvy"): cv2.COLOR_YUV2RGB_UYVY,
    ("yuv422_yuy2", "yuyv", "yuy2", "yuv422_yuyv"): cv2.COLOR_YUV2RGB_YUY2,
    ("yvyu", "yuv422_yvyu"): cv2.COLOR_YUV2RGB_YVYU,
}.items():
    for _name in _names:
        _ENCODINGS[_name] = _Encoding(8, 2, _order)
#: A plane of luma, then chroma of half the size (nv: U and V in turn; i420, yv12: one after the other).
_PLANAR = {
    "nv12": cv2.COLOR_YUV2RGB_NV12,
    "nv21": cv2.COLOR_YUV2RGB_NV21,
    "i420": cv2.COLOR_YUV2RGB_I420,
    "yuv420": cv2.COLOR_YUV2RGB_I420,
    "yv12": cv2.COLOR_YUV2RGB_YV12,
}
_DEPTH = ("32fc1", "64fc1", "16sc1", "32sc1")


def decode_image(message: Any, reading: Reading = DEFAULT_READING) -> RGB:
    """Colour image of a sensor_msgs Image or CompressedImage.

    Returns
    -------
    (H, W, 3) uint8 RGB; of encodings of more than 8 bits the upper 8 that are used (`Reading.color_bits`).
    May share memory with the message.

    Raises
    ------
    MessageError
        Reasons ``unknown_encoding``, ``truncated_data``, ``bad_step``, ``empty_image``, ``bad_compression``.
    """
    if not hasattr(message, "encoding"):
        return _decode_compressed(message, reading)
    name = str(message.encoding).lower()
    if name in _PLANAR:
        return _to_rgb(_luma_and_chroma(message), _PLANAR[name])
    if name == "nv24":
        return _decode_nv24(message)
    if name not in _ENCODINGS:
        raise _unknown(str(message.encoding))
    encoding = _ENCODINGS[name]
    values = pixels(message, np.dtype(np.uint8 if encoding.bits == 8 else np.uint16), encoding.channels)
    if values.dtype == np.uint16:
        values = _eight_bits(values, encoding.bits or reading.color_bits)
    if encoding.channels == 2 and values.shape[1] % 2:
        raise MessageError("bad_step", f"image: {name} needs an even width, got {values.shape[1]}")
    return values if encoding.to_rgb is None else _to_rgb(values, encoding.to_rgb)


def _to_rgb(values: NDArray[np.uint8], conversion: int) -> RGB:
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(values), conversion), np.uint8)


def _eight_bits(values: NDArray[np.uint16], bits: int) -> NDArray[np.uint8]:
    """The upper 8 of the bits that are used; 0: of the fewest that hold the brightest pixel."""
    if not bits:
        brightest = int(values.max(initial=0))
        bits = next(bits for bits in BITS if brightest < 1 << bits)
    return np.minimum(values >> (bits - 8), 255).astype(np.uint8)


def _unknown(encoding: str) -> MessageError:
    if encoding.lower() in _DEPTH:
        return MessageError(
            "unknown_encoding", f"image: encoding {encoding!r} is that of a depth image, not of colour"
        )
    known = ", ".join(sorted([*_ENCODINGS, *_PLANAR, "nv24"])).replace("uc", "UC")
    return MessageError(
        "unknown_encoding",
        f"image: encoding {encoding!r} is not a colour encoding rcseg reads; it reads {known}",
    )


def _decode_compressed(message: Any, reading: Reading) -> RGB:
    """JPEG, PNG or TIFF of 8 or 16 bits; a Bayer pattern compressed as it is shows in the format."""
    form = str(message.format)
    values = picture(np.frombuffer(message.data, np.uint8), form)
    if values.dtype not in (np.uint8, np.uint16):
        raise MessageError(
            "unknown_encoding", f"compressed image: format {form!r} holds {values.dtype}, which is no colour"
        )
    raw = _ENCODINGS.get(form.split(";")[0].strip().lower(), _Encoding(0, 0, None))
    if values.dtype == np.uint16:
        values = _eight_bits(values, (raw.bits if raw.bits > 8 else 0) or reading.color_bits)
    if values.ndim == 2:
        mosaic = raw.channels == 1 and raw.to_rgb is not None
        return _to_rgb(values, raw.to_rgb if mosaic else cv2.COLOR_GRAY2RGB)  # type: ignore[arg-type]
    return _to_rgb(values, cv2.COLOR_BGRA2RGB if values.shape[2] == 4 else cv2.COLOR_BGR2RGB)


def _luma_and_chroma(message: Any) -> NDArray[np.uint8]:
    """The (3 H / 2, W) rows of an image in planes.

    ``height`` is that of the image with most drivers and counts the rows of chroma with some; ``step`` is
    that of a row of luma, or of one with its chroma: the number of bytes tells which.
    """
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.frombuffer(message.data, np.uint8)
    what = f"image: {width}x{height} {message.encoding}"
    if height == 0 or width == 0:
        raise MessageError("empty_image", f"{what} has no pixel")
    if data.size == width * height * 3 // 2:
        step = width
    elif step >= width and data.size == step * height and height % 3 == 0:
        height = height * 2 // 3
    elif step < width or data.size < step * height * 3 // 2:
        raise MessageError(
            "truncated_data",
            f"{what} needs {megabytes(width * height * 3 // 2)} (luma, and chroma of half its size), "
            f"got {megabytes(data.size)} with step {step}",
        )
    if height % 2 or width % 2:
        raise MessageError("bad_step", f"{what}: an even width and height are needed")
    return np.ndarray((height * 3 // 2, width), np.uint8, data, 0, (step, 1))


def _decode_nv24(message: Any) -> RGB:
    """Luma, then U and V in turn for every pixel: read as UYVY, which has them for every second one."""
    height, width = int(message.height), int(message.width)
    data = np.frombuffer(message.data, np.uint8)
    if height == 0 or width % 2 or width == 0 or data.size != 3 * height * width:
        raise MessageError(
            "truncated_data",
            f"image: {width}x{height} nv24 needs an even width and {3 * height * width} bytes, "
            f"got {data.size}",
        )
    luma, chroma = np.split(data, [height * width])
    pairs = chroma.reshape(height, width // 2, 2, 2).mean(axis=2)
    uyvy = np.stack([np.rint(pairs).reshape(height, width).astype(np.uint8), luma.reshape(height, width)], -1)
    return _to_rgb(uyvy, cv2.COLOR_YUV2RGB_UYVY)
