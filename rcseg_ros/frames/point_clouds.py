"""Point clouds: PointCloud2 of any layout as points and colour.

Which points are missing is left to the frame, but for what the cloud's own fields say: a `range` of zero is
no measurement, even where a transformation has moved its point away from (0, 0, 0).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_ros.frames.depth_images import METRE, wrong_unit
from rcseg_ros.frames.pixels import row_step
from rcseg_ros.frames.reading import DEFAULT_READING, Reading
from rcseg_ros.frames.refusals import MessageError


@dataclass(frozen=True)
class Cloud:
    """A point cloud as arrays.

    points : (H, W, 3) float32, metres, in the cloud's frame; H = 1 when unorganised; NaN, infinite or
        (0, 0, 0) where nothing was measured
    color : (H, W, 3) uint8 RGB, or None when the cloud has no colour field
    """

    points: NDArray[np.float32]
    color: NDArray[np.uint8] | None

    @property
    def organized(self) -> bool:
        return self.points.shape[0] > 1


# sensor_msgs/PointField datatype: INT8 .. FLOAT64 are 1 .. 8
_POINT_FIELD_TYPES = dict(enumerate(("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"), start=1))


def decode_cloud(message: Any, reading: Reading = DEFAULT_READING, *, with_color: bool = True) -> Cloud:
    """Points and colour of a PointCloud2: fields of any order, offset and type, any byte order and padding.

    Colour comes from ``rgb`` or ``rgba`` (packed into a float32 or an integer) or from ``r``, ``g``, ``b``;
    `with_color` False leaves it where it is.

    Raises
    ------
    MessageError
        Reasons ``missing_field``, ``bad_field``, ``bad_step``, ``truncated_data``, ``empty_cloud`` and
        ``depth_unit`` (half of the points lie farther than ``reading.max_depth_m`` from their middle).
    """
    data, shape, strides = _cloud_layout(message)
    fields = {str(field.name): field for field in message.fields}
    order = ">" if message.is_bigendian else "<"

    def column(name: str, kind: str | None = None) -> NDArray[Any]:
        """(H, W) view of one field; ``kind`` overrides the declared number type (same size)."""
        field = fields[name]
        offset = int(field.offset)
        dtype = np.dtype(kind or _POINT_FIELD_TYPES.get(int(field.datatype), "V1")).newbyteorder(order)
        if dtype.kind == "V" or offset + dtype.itemsize > strides[1]:
            raise MessageError(
                "bad_field",
                f"cloud: field {name!r} (datatype {field.datatype}, offset {offset}) "
                f"does not fit into point_step {strides[1]}",
            )
        return np.ndarray(shape, dtype, data, offset, strides)

    missing = [axis for axis in "xyz" if axis not in fields]
    if missing:
        raise MessageError(
            "missing_field",
            f"cloud: no field {', '.join(missing)}; it has {', '.join(fields) or 'none'}",
        )
    points = np.empty((*shape, 3), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # what float32 cannot hold is infinite: missing
        for axis, name in enumerate("xyz"):
            points[..., axis] = column(name)
        points *= np.float32(reading.depth_unit_m or METRE)
    if "range" in fields:
        points[column("range") == 0] = np.nan
    check_unit(points, reading)
    return Cloud(points, _cloud_color(fields, column, shape) if with_color else None)


def _cloud_layout(message: Any) -> tuple[NDArray[np.uint8], tuple[int, int], tuple[int, int]]:
    """Bytes of a cloud, its (rows, columns), and the bytes from row to row and from point to point."""
    height, width = int(message.height), int(message.width)
    point_step = int(message.point_step)
    what = f"cloud: {width}x{height} points"
    if height == 0 or width == 0:
        raise MessageError("empty_cloud", f"{what}: there is no point")
    data = np.frombuffer(message.data, np.uint8)
    if point_step == 0 and data.size % (height * width) == 0:
        point_step = data.size // (height * width)
    if point_step == 0:
        raise MessageError("bad_step", f"{what}: point_step is 0, so a point has no bytes")
    # some drivers leave row_step at zero in clouds of one row, where it has no meaning
    claimed = int(message.row_step) if height > 1 else width * point_step
    step = row_step(claimed, width * point_step, height, data.size, f"{what} of {point_step} bytes")
    return data, (height, width), (step, point_step)


def check_unit(points: NDArray[np.float32], reading: Reading) -> None:
    """Refuse a cloud in millimetres; one in a map frame may lie far from the origin, but is not as wide."""
    flat = points.reshape(-1, 3)
    sample = flat[:: max(1, len(flat) // 1000)].astype(np.float64)
    sample = sample[np.isfinite(sample).all(axis=1) & sample.any(axis=1)]
    if len(sample):
        wide = float(np.median(np.linalg.norm(sample - np.median(sample, axis=0), axis=1)))
        if wide > reading.max_depth_m:
            raise wrong_unit("cloud, from its middle", wide, reading.depth_unit_m or METRE, reading)


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
