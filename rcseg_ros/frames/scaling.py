"""Images and cameras of one field of view in different sizes, brought to the grid of the range.

Drivers bin, crop and scale: a camera_info may be that of the full sensor beside images of half its size, the
colour may have twice the pixels of the depth. A pixel of a scaled image covers those that it was made from,
so its centre lies at (x + 1/2) s - 1/2. Sizes whose sides are not in proportion are of different views:
nothing tells which part one shows of the other.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_ros.frames.refusals import MessageError

Size = tuple[int, ...]


def in_proportion(one: Size, other: Size) -> bool:
    """Whether two sizes (rows, columns) differ by one factor alone, to within a pixel of rounding."""
    (height, width), (other_height, other_width) = one[:2], other[:2]
    if min(height, width, other_height, other_width) < 1:
        return False
    scale = max(height, width) / max(other_height, other_width)
    off = max(abs(height - scale * other_height), abs(width - scale * other_width))
    return off < max(1.0, scale)


def scale_color(color: NDArray[np.uint8], size: Size, what: str = "depth image") -> NDArray[np.uint8]:
    """A colour image in the grid of a range image of the same view.

    Parameters
    ----------
    color : (H, W, 3) uint8
    size : (rows, columns) of the range
    what : name of the range, for people

    Raises
    ------
    MessageError
        Reason ``size_mismatch``.
    """
    if color.shape[:2] == tuple(size[:2]):
        return color
    if not in_proportion(color.shape, size):
        raise mismatch(what, size, "colour image", color.shape)
    smaller = color.shape[0] > size[0]
    scaled = cv2.resize(
        color, (size[1], size[0]), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    )
    return np.asarray(scaled, np.uint8)


def fit_camera_info(message: Any, size: Size, what: str = "depth image") -> Any:
    """A CameraInfo as that of an image of the given size; the message itself where it is that already.

    Binning and region of interest count where the image has them, and not where it is the whole; width and
    height of 0 are those of the image; another size in proportion is a scaled image.

    Parameters
    ----------
    message : sensor_msgs CameraInfo
    size : (rows, columns) of the image

    Raises
    ------
    MessageError
        Reason ``size_mismatch``.
    """
    height, width = size[:2]
    roi = message.roi
    whole = int(message.height), int(message.width)
    binning = max(int(message.binning_y), 1), max(int(message.binning_x), 1)
    told = _divided((int(roi.height) or whole[0], int(roi.width) or whole[1]), binning)
    if told == (height, width):
        return message
    offset = int(roi.y_offset), int(roi.x_offset)
    if min(told) == 0:
        return _changed(message, size, offset, binning)
    for one, begin, step in ((whole, (0, 0), (1, 1)), (_divided(whole, binning), (0, 0), binning)):
        if one == (height, width):
            return _changed(message, size, begin, step)
    if not in_proportion(told, size):
        raise mismatch(what, size, "camera_info", told)
    whole_pixels = _changed(message, told, offset, binning)
    return _changed(whole_pixels, size, (0, 0), (told[0] / height, told[1] / width), centred=True)


def _divided(size: Size, binning: Size) -> Size:
    return size[0] // binning[0], size[1] // binning[1]


def _changed(
    message: Any, size: Size, begin: Size, step: tuple[float, ...], *, centred: bool = False
) -> SimpleNamespace:
    """A copy with K and P of an image that begins at a pixel and takes one of `step` pixels.

    centred : a pixel is the mean of those that it stands for; CameraInfo's binning counts from their first
    """
    names = ("header", "distortion_model", "d", "r")
    kept = {name: getattr(message, name) for name in names if hasattr(message, name)}
    shift = 0.5 if centred else 0.0
    for name, columns in (("k", 3), ("p", 4)):
        values = getattr(message, name, None)
        if values is None:
            continue
        if len(values) != 3 * columns:
            kept[name] = values  # refused where it is needed
            continue
        matrix = np.array(values, float).reshape(3, columns)
        if matrix[:2].any():
            for axis, row in ((1, 0), (0, 1)):
                matrix[row] /= step[axis]
                center = matrix[row, 2] * step[axis]
                matrix[row, 2] = (center - begin[axis] + shift) / step[axis] - shift
        kept[name] = matrix.ravel()
    nothing = SimpleNamespace(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return SimpleNamespace(
        **kept, height=int(size[0]), width=int(size[1]), binning_x=1, binning_y=1, roi=nothing
    )


def mismatch(one: str, size: Size, other: str, other_size: Size) -> MessageError:
    """The refusal of two sizes; those in proportion lack a camera that relates them."""
    why = (
        "which no scale makes the same: use topics registered to one camera (aligned depth, or a cloud with "
        "its camera_info)"
    )
    if in_proportion(size, other_size):
        why = "in proportion, but no camera_info says that they show the same: record one, or name its topic"
    return MessageError(
        "size_mismatch",
        f"{one} is {size[1]}x{size[0]} but {other} is {other_size[1]}x{other_size[0]}, {why}",
    )
