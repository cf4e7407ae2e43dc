"""ROS messages to arrays and frames: the door through which every recorded or live message comes.

Pure functions over duck-typed messages: what rclpy delivers and what rosbags deserialises have the same field
names, and both hold bulk data in something with a buffer, so `numpy.frombuffer` reads either without a copy.
What does not fit is refused with a `MessageError`, whose `reason` is a short name for counters.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_core import PinholeCamera
from rcseg_core.errors import InputError


class MessageError(InputError):
    """A message that cannot be used; ``reason`` is its name in counters and diagnostics."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


@dataclass(frozen=True)
class Header:
    """Stamp (integer nanoseconds) and coordinate frame of a message; results carry their input's."""

    stamp_ns: int
    frame_id: str


def header_of(message: Any) -> Header:
    """Header of any stamped message."""
    stamp = message.header.stamp
    return Header(int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec), str(message.header.frame_id))


# encoding: (bits per channel, channels, cv2 conversion to RGB after reduction to 8 bits; None: RGB already)
# OpenCV names a Bayer pattern by its second row, ROS by its first: bayer_rggb8 is OpenCV's BayerBG.
_COLOR_ENCODINGS: dict[str, tuple[int, int, int | None]] = {
    "rgb8": (8, 3, None),
    "8UC3": (8, 3, cv2.COLOR_BGR2RGB),
    "bgr8": (8, 3, cv2.COLOR_BGR2RGB),
    "rgba8": (8, 4, cv2.COLOR_RGBA2RGB),
    "bgra8": (8, 4, cv2.COLOR_BGRA2RGB),
    "8UC4": (8, 4, cv2.COLOR_BGRA2RGB),
    "mono8": (8, 1, cv2.COLOR_GRAY2RGB),
    "8UC1": (8, 1, cv2.COLOR_GRAY2RGB),
    "mono16": (16, 1, cv2.COLOR_GRAY2RGB),
    "16UC1": (16, 1, cv2.COLOR_GRAY2RGB),
    "rgb16": (16, 3, None),
    "bgr16": (16, 3, cv2.COLOR_BGR2RGB),
    "yuv422": (8, 2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (8, 2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (8, 2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (8, 2, cv2.COLOR_YUV2RGB_YUY2),
}
for _ros, _opencv in {"rggb": "BG", "bggr": "RG", "gbrg": "GR", "grbg": "GB"}.items():
    for _bits in (8, 16):
        _COLOR_ENCODINGS[f"bayer_{_ros}{_bits}"] = (_bits, 1, getattr(cv2, f"COLOR_Bayer{_opencv}2RGB"))


def decode_image(message: Any) -> NDArray[np.uint8]:
    """Colour image of a sensor_msgs Image or CompressedImage.

    Returns
    -------
    (H, W, 3) uint8 RGB; 16-bit encodings keep their upper byte. May share memory with the message.

    Raises
    ------
    MessageError
        Reasons ``unknown_encoding``, ``truncated_data``, ``bad_step``, ``empty_image``, ``bad_compression``.
    """
    if not hasattr(message, "encoding"):
        return cv2.cvtColor(_decompress(message, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    encoding = str(message.encoding)
    if encoding not in _COLOR_ENCODINGS:
        raise MessageError(
            "unknown_encoding",
            f"image: encoding {encoding!r} is not a colour encoding rcseg reads; "
            f"it reads {', '.join(sorted(_COLOR_ENCODINGS))}",
        )
    bits, channels, to_rgb = _COLOR_ENCODINGS[encoding]
    pixels = _pixels(message, np.dtype(np.uint8 if bits == 8 else np.uint16), channels)
    if bits == 16:
        pixels = (pixels >> 8).astype(np.uint8)
    if to_rgb is None:
        return pixels
    if channels == 2 and pixels.shape[1] % 2:
        raise MessageError("bad_step", f"image: {encoding} needs an even width, got {pixels.shape[1]}")
    return cv2.cvtColor(np.ascontiguousarray(pixels), to_rgb)


def decode_depth(message: Any) -> NDArray[np.float32]:
    """Depth image of REP 118: 16UC1 (or mono16) millimetres, 32FC1 metres; or its compressedDepth PNG.

    Returns
    -------
    (H, W) float32 metres along the optical axis; NaN where nothing was measured (0, negative, NaN, infinite).
    """
    if not hasattr(message, "encoding"):
        return _decode_compressed_depth(message)
    encoding = str(message.encoding)
    if encoding in ("16UC1", "mono16"):
        depth_m = _pixels(message, np.dtype(np.uint16), 1) * np.float32(0.001)
    elif encoding == "32FC1":
        depth_m = _pixels(message, np.dtype(np.float32), 1).astype(np.float32)
    else:
        raise MessageError(
            "unknown_encoding",
            f"depth: encoding {encoding!r} is not a depth encoding; "
            "REP 118 knows 16UC1 (millimetres) and 32FC1 (metres)",
        )
    depth_m[~((depth_m > 0) & (depth_m < np.inf))] = np.nan
    return depth_m


def decode_labels(message: Any) -> NDArray[np.int32]:
    """Label image (H, W) from a 16UC1 Image; 0 is unlabelled."""
    if str(message.encoding) not in ("16UC1", "mono16"):
        raise MessageError("unknown_encoding", f"labels: expected encoding 16UC1, got {message.encoding!r}")
    return _pixels(message, np.dtype(np.uint16), 1).astype(np.int32)


def _decode_compressed_depth(message: Any) -> NDArray[np.float32]:
    form = str(message.format)
    if "compressedDepth" not in form or not form.startswith("16UC1"):
        raise MessageError(
            "bad_compression", f"depth: compressed format {form!r}; only '16UC1; compressedDepth png' is read"
        )
    millimetres = _decompress(message, cv2.IMREAD_UNCHANGED, skip=12)  # the transport's own header
    depth_m = millimetres.astype(np.float32) * np.float32(0.001)
    depth_m[depth_m == 0] = np.nan
    return depth_m


def _decompress(message: Any, flags: int, skip: int = 0) -> NDArray[Any]:
    data = np.frombuffer(message.data, np.uint8)[skip:]
    pixels = cv2.imdecode(data, flags) if data.size else None
    if pixels is None:
        raise MessageError(
            "bad_compression",
            f"compressed image: {data.size} bytes of format {str(message.format)!r} "
            "could not be decoded; JPEG and PNG are read",
        )
    return pixels


def _pixels(message: Any, dtype: np.dtype[Any], channels: int) -> NDArray[Any]:
    """Pixels of a raw Image as (H, W) or (H, W, channels) in native byte order, row padding taken off."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    row_bytes = width * channels * dtype.itemsize
    data = np.frombuffer(message.data, np.uint8)
    what = f"image: {width}x{height} {message.encoding}"
    if height == 0 or width == 0:
        raise MessageError("empty_image", f"{what} has no pixel")
    if step < row_bytes:
        raise MessageError("bad_step", f"{what} needs {row_bytes} bytes a row, but step says {step}")
    if data.size < step * (height - 1) + row_bytes:
        raise MessageError(
            "truncated_data", f"{what} with step {step} needs {step * height} bytes, got {data.size}"
        )
    shape = (height, width) if channels == 1 else (height, width, channels)
    strides = (step, channels * dtype.itemsize, dtype.itemsize)[: len(shape)]
    big_endian = bool(message.is_bigendian)
    pixels = np.ndarray(shape, dtype.newbyteorder(">" if big_endian else "<"), data, 0, strides)
    native = dtype.itemsize == 1 or big_endian == (sys.byteorder == "big")
    return pixels if native else pixels.astype(dtype)


@dataclass(frozen=True)
class Cloud:
    """A point cloud as arrays.

    points : (H, W, 3) float32, metres, in the cloud's frame; H = 1 when unorganised; NaN or z = 0 invalid
    color : (H, W, 3) uint8 RGB, or None when the cloud has no colour field
    """

    points: NDArray[np.float32]
    color: NDArray[np.uint8] | None

    @property
    def organized(self) -> bool:
        return self.points.shape[0] > 1


# sensor_msgs/PointField datatype: INT8 .. FLOAT64 are 1 .. 8
_POINT_FIELD_TYPES = dict(enumerate(("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"), start=1))


def decode_cloud(message: Any, *, with_color: bool = True) -> Cloud:
    """Points and colour of a PointCloud2: fields of any order, offset and type, any byte order and padding.

    Colour comes from ``rgb`` or ``rgba`` (packed into a float32 or an integer) or from ``r``, ``g``, ``b``;
    `with_color` False leaves it where it is.

    Raises
    ------
    MessageError
        Reasons ``missing_field``, ``bad_field``, ``bad_step``, ``truncated_data``, ``empty_cloud``.
    """
    data, shape, strides = _cloud_layout(message)
    fields = {str(field.name): field for field in message.fields}
    order = ">" if message.is_bigendian else "<"

    def column(name: str, kind: str | None = None) -> NDArray[Any]:
        """(H, W) view of one field; ``kind`` overrides the declared number type (same size)."""
        field = fields[name]
        offset = int(field.offset)
        dtype = np.dtype(kind or _POINT_FIELD_TYPES.get(int(field.datatype), "V1")).newbyteorder(order)
        if dtype.kind == "V" or offset + dtype.itemsize > message.point_step:
            raise MessageError(
                "bad_field",
                f"cloud: field {name!r} (datatype {field.datatype}, offset {offset}) "
                f"does not fit into point_step {message.point_step}",
            )
        return np.ndarray(shape, dtype, data, offset, strides)

    missing = [axis for axis in "xyz" if axis not in fields]
    if missing:
        raise MessageError(
            "missing_field",
            f"cloud: no field {', '.join(missing)}; it has {', '.join(fields) or 'none'}",
        )
    points = np.empty((*shape, 3), np.float32)
    for axis, name in enumerate("xyz"):
        points[..., axis] = column(name)
    return Cloud(points, _cloud_color(fields, column, shape) if with_color else None)


def _cloud_layout(message: Any) -> tuple[NDArray[np.uint8], tuple[int, int], tuple[int, int]]:
    """Bytes of a cloud, its (rows, columns), and the bytes from row to row and from point to point."""
    height, width = int(message.height), int(message.width)
    point_step, row_step = int(message.point_step), int(message.row_step)
    what = f"cloud: {width}x{height} points"
    if height == 0 or width == 0:
        raise MessageError("empty_cloud", f"{what}: there is no point")
    row_bytes = width * point_step
    # Some drivers leave row_step at zero in clouds of one row, where it has no meaning.
    row_step = row_bytes if height == 1 else row_step
    if point_step == 0 or row_step < row_bytes:
        raise MessageError("bad_step", f"{what} of {point_step} bytes do not fit into row_step {row_step}")
    data = np.frombuffer(message.data, np.uint8)
    if data.size < row_step * (height - 1) + row_bytes:
        raise MessageError("truncated_data", f"{what} need {row_step * height} bytes, got {data.size}")
    return data, (height, width), (row_step, point_step)


def _cloud_color(fields: dict[str, Any], column: Any, shape: tuple[int, int]) -> NDArray[np.uint8] | None:
    color = np.empty((*shape, 3), np.uint8)
    packed = next((name for name in ("rgb", "rgba") if name in fields), None)
    if packed is not None:
        bits = column(packed, "u4").astype("<u4")  # the float32 form is a bit pattern too, never a number
        return cv2.cvtColor(bits.view(np.uint8).reshape(*shape, 4), cv2.COLOR_BGRA2RGB, color)
    if all(name in fields for name in "rgb"):
        for channel, name in enumerate("rgb"):
            color[..., channel] = column(name)
        return color
    return None


@dataclass(frozen=True)
class CameraModel:
    """A sensor_msgs/CameraInfo: pinhole, image size in pixels, and the distortion that projection applies."""

    pinhole: PinholeCamera
    height: int
    width: int
    distortion_model: str = ""
    distortion: tuple[float, ...] = ()
    frame_id: str = ""


_DISTORTION_LENGTHS = {"plumb_bob": (4, 5), "rational_polynomial": (8,)}


def decode_camera_info(message: Any) -> CameraModel:
    """Camera of a CameraInfo, from K; binning and region of interest are taken into account.

    Raises
    ------
    MessageError
        Reasons ``uncalibrated_camera`` (K is all zero) and ``unknown_distortion``.
    """
    fx, _, cx, _, fy, cy, *_ = (float(value) for value in message.k)
    if fx == 0 or fy == 0:
        raise MessageError(
            "uncalibrated_camera",
            "camera_info: K is zero, the camera is not calibrated; "
            "calibrate it, or name another camera_info topic",
        )
    distortion = tuple(float(value) for value in message.d)
    model = str(message.distortion_model)
    if not any(distortion[8:]):
        distortion = distortion[:8]  # OpenCV's longer forms end in thin-prism and tilt terms, mostly unused
    if not any(distortion):
        model, distortion = "", ()
    elif len(distortion) not in _DISTORTION_LENGTHS.get(model, ()):
        raise MessageError(
            "unknown_distortion",
            f"camera_info: distortion model {model!r} with {len(distortion)} coefficients "
            "is not known; plumb_bob (4 or 5) and rational_polynomial (8) are",
        )
    roi = message.roi
    bin_x, bin_y = max(int(message.binning_x), 1), max(int(message.binning_y), 1)
    pinhole = PinholeCamera(
        fx / bin_x, fy / bin_y, (cx - int(roi.x_offset)) / bin_x, (cy - int(roi.y_offset)) / bin_y
    )
    height = (int(roi.height) or int(message.height)) // bin_y
    width = (int(roi.width) or int(message.width)) // bin_x
    return CameraModel(pinhole, height, width, model, distortion, str(message.header.frame_id))
