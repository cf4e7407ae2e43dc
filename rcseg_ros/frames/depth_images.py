"""Depth images: raw, compressedDepth (PNG or RVL, whole numbers or quantised inverse depth), PNG and TIFF.

What is no measurement becomes NaN here: zero and negative values, NaN and infinity, the largest value of the
type (saturation; 65535 also after a conversion to floats), and what no depth camera gives. A frame whose
median is beyond any depth camera is in another unit than its encoding says, and is refused.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_ros.frames.expansion import ExpansionError, check_expansion
from rcseg_ros.frames.pixels import picture, pixels
from rcseg_ros.frames.reading import ABSURD, DEFAULT_READING, Reading
from rcseg_ros.frames.refusals import MessageError
from rcseg_ros.frames.rvl import decode_rvl

MILLIMETRE, METRE = 0.001, 1.0
_ENCODINGS = {
    "16uc1": np.uint16, "mono16": np.uint16, "16sc1": np.int16, "32sc1": np.int32,
    "32fc1": np.float32, "64fc1": np.float64,
}  # fmt: skip
#: The transport compressedDepth begins with this many bytes: an enumeration and two float32.
_HEADER = 12
_RVL_PIXEL = 2  # bytes
_PNG = b"\x89PNG\r\n\x1a\n"
#: Nothing nearer is a depth, and nothing farther is one in any unit.
_LEAST_M, _MOST = 1e-6, 1e7
#: Pixels, and their share, that hold one same far value where that stands for "nothing there".
_FAR_PIXELS, _FAR_SHARE = 10, 0.01


def decode_depth(message: Any, reading: Reading = DEFAULT_READING) -> NDArray[np.float32]:
    """Depth image of REP 118 and its relatives; raw, or as CompressedImage.

    Whole numbers (16UC1, mono16, 16SC1, 32SC1) are millimetres and others (32FC1, 64FC1) metres, unless
    ``reading.depth_unit_m`` says something else.

    Returns
    -------
    (H, W) float32 metres along the optical axis; NaN where nothing was measured.

    Raises
    ------
    MessageError
        Reasons ``depth_unit`` (the median lies beyond ``reading.max_depth_m``), ``unknown_encoding``,
        ``truncated_data``, ``bad_step``, ``empty_image``, ``bad_compression``.
    """
    if not hasattr(message, "encoding"):
        values = _decompressed(message)
    else:
        dtype = _ENCODINGS.get(str(message.encoding).lower())
        if dtype is None:
            raise MessageError(
                "unknown_encoding",
                f"depth: encoding {message.encoding!r} is not a depth encoding; 16UC1, 16SC1 and 32SC1 "
                "(millimetres), 32FC1 and 64FC1 (metres) are",
            )
        values = pixels(message, np.dtype(dtype), 1)
    return depth_in_metres(values, reading)


def depth_in_metres(values: NDArray[Any], reading: Reading = DEFAULT_READING) -> NDArray[np.float32]:
    """Depth of stored values: whole numbers or floats, see `decode_depth`."""
    whole = values.dtype.kind in "iu"
    unit_m = reading.depth_unit_m or (MILLIMETRE if whole else METRE)
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is no depth
        depth_m = values.astype(np.float32) * np.float32(unit_m)
        depth_m[~((depth_m > _LEAST_M) & (depth_m < _MOST))] = np.nan
        if whole:
            depth_m[values == np.iinfo(values.dtype).max] = np.nan
        else:
            for saturated in (65535.0, 65.535):
                depth_m[np.abs(values - values.dtype.type(saturated)) < 1e-6 * saturated] = np.nan
    _check_unit(depth_m, unit_m, reading)
    depth_m[depth_m > ABSURD * reading.max_depth_m] = np.nan
    return depth_m


def _check_unit(depth_m: NDArray[np.float32], unit_m: float, reading: Reading) -> None:
    """Refuse depth of another unit; take out a far value that stands for nothing."""
    sample = depth_m[:: max(1, depth_m.shape[0] // 120), :: max(1, depth_m.shape[1] // 160)]
    sample = sample[np.isfinite(sample)]
    if not sample.size or sample.max() <= reading.max_depth_m:
        return
    far = sample.max()
    alike = sample == far
    if alike.sum() >= _FAR_PIXELS and _FAR_SHARE <= alike.mean() < 1:
        depth_m[depth_m == far] = np.nan
        sample = sample[~alike]
    median = float(np.median(sample))
    if median > reading.max_depth_m:
        raise wrong_unit("depth", median, unit_m, reading)


def wrong_unit(what: str, median: float, unit_m: float, reading: Reading) -> MessageError:
    """The refusal of numbers that are too large for the unit in which they were read."""
    names = {METRE: "metres", MILLIMETRE: "millimetres"}
    unit = names.get(unit_m, f"units of {unit_m:g} m")
    small = median * MILLIMETRE <= reading.max_depth_m and unit_m == METRE
    hint = "these seem to be millimetres: set it to 0.001" if small else "metres of one unit of the data"
    return MessageError(
        "depth_unit",
        f"{what}: read as {unit}, the median is {median:.4g} m, beyond the {reading.max_depth_m:g} m of "
        f"input.max_depth: give input.depth_unit or --depth-unit ({hint})",
    )


def _decompressed(message: Any) -> NDArray[Any]:
    """Values of a CompressedImage: compressedDepth behind its header, else a PNG or TIFF as it is.

    The bytes tell which better than the format, which not every recorder fills in.
    """
    form = str(message.format)
    data = np.frombuffer(message.data, np.uint8)
    encoding = form.split(";")[0].strip().lower()
    header: NDArray[np.uint8] | None = data[:_HEADER]
    if bytes(data[_HEADER : _HEADER + len(_PNG)]) == _PNG:
        values = picture(data[_HEADER:], form)
    elif re.search("rvl|compresseddepth", form.lower()) and bytes(data[: len(_PNG)]) != _PNG:
        values = _from_rvl(data, form)
    else:
        values, header = picture(data, form), None
    if values.ndim != 2 or values.dtype == np.uint8:
        raise MessageError(
            "bad_compression",
            f"depth: format {form!r} holds {values.dtype} of {1 if values.ndim == 2 else values.shape[2]} "
            "channels; depth needs one channel of 16 bits or of floats (a JPEG keeps no depth)",
        )
    if encoding == "32fc1" and values.dtype == np.uint16:
        return _from_inverse_depth(values, header, form)
    return values


def _from_inverse_depth(
    levels: NDArray[np.uint16], header: NDArray[np.uint8] | None, form: str
) -> NDArray[np.float32]:
    """Metres z of levels n = a / z + b, with a and b from the header; 0: none."""
    a, b = (float("nan"),) * 2 if header is None else header[4:].view("<f4").tolist()
    if not (a > 0 and np.isfinite(a) and np.isfinite(b)):
        raise MessageError(
            "bad_compression",
            f"depth: format {form!r} without the header of compressedDepth that tells how it was quantised",
        )
    with np.errstate(divide="ignore"):
        depth_m = np.float32(a) / (levels.astype(np.float32) - np.float32(b))
    depth_m[levels == 0] = np.nan
    return depth_m


def _from_rvl(data: NDArray[np.uint8], form: str) -> NDArray[np.uint16]:
    body = data[_HEADER:]
    width, height = (int(v) for v in body[:8].view("<u4")) if body.size >= 8 else (0, 0)
    if width * height == 0:
        raise MessageError(
            "bad_compression", f"depth: {data.size} bytes of format {form!r} say {width}x{height} pixels"
        )
    try:  # a byte of the stream is two pixels at most, but for runs of zeros
        check_expansion(width * height * _RVL_PIXEL, data.size)
    except ExpansionError as error:
        what = f"depth of format {form!r}, {width}x{height} pixels"
        raise MessageError("too_large", f"{what}: {error}") from None
    try:
        return decode_rvl(body[8:], width * height).reshape(height, width)
    except ValueError as error:
        raise MessageError("bad_compression", f"depth: format {form!r} is damaged: {error}") from None
