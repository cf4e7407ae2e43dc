"""visualization_msgs/MarkerArray from arrays: a mesh has thousands of points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_ros.results.cdr import HEAD, Cdr, Serialized

#: Constants of visualization_msgs/Marker.
ARROW, LINE_LIST, TEXT, TRIANGLES, DELETE_ALL = 0, 5, 9, 11, 3
MARKER_ARRAY = "visualization_msgs/msg/MarkerArray"


@dataclass(frozen=True)
class Drawing:
    """One marker: points in the header's frame, or a text at a position.

    Attributes
    ----------
    name, label : namespace and id
    kind : ARROW, LINE_LIST, TEXT or TRIANGLES
    points : (n, 3) float64, m
    rgb : three numbers of 0 to 1
    scale : three lengths, m, as the kind takes them
    position : (3,) of a text, m
    """

    name: str
    label: int
    kind: int
    points: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))
    rgb: Sequence[float] = (1.0, 1.0, 1.0)
    alpha: float = 1.0
    scale: Sequence[float] = (0.003, 0.003, 0.0)
    position: Sequence[float] = (0.0, 0.0, 0.0)
    text: str = ""


def marker_array(header: Any, drawings: Sequence[Drawing]) -> Serialized:
    """A MarkerArray that deletes what was drawn before and draws these.

    Parameters
    ----------
    header : std_msgs/Header of whatever message library
    """
    cdr, stamped = Cdr(), Cdr()
    stamped.header(header)
    start = stamped.bytes()[len(HEAD) :]
    cdr.put("I", 1 + len(drawings))
    _put_marker(cdr, start, DELETE_ALL, Drawing("", 0, 0, rgb=(0, 0, 0), alpha=0.0, scale=(0, 0, 0)))
    for drawing in drawings:
        _put_marker(cdr, start, 0, drawing)
    return Serialized(MARKER_ARRAY, cdr.bytes())


def _put_marker(cdr: Cdr, header: bytes, action: int, drawing: Drawing) -> None:
    """The fields of visualization_msgs/Marker in their order."""
    cdr.align(4)
    cdr.raw(header)
    cdr.text(drawing.name)
    cdr.put("3i", drawing.label, drawing.kind, action)
    cdr.align(8)
    # pose and scale, color, lifetime (for ever), frame_locked, number of points
    cdr.pack(
        "10d4f2IB3xI", *drawing.position, 0.0, 0.0, 0.0, 1.0, *drawing.scale, *drawing.rgb, drawing.alpha,
        0, 0, 0, len(drawing.points),
    )  # fmt: skip
    if len(drawing.points):
        cdr.align(8)
        cdr.raw(np.asarray(drawing.points, "<f8").tobytes())
    cdr.raw(_end(cdr.offset, drawing.text))


@lru_cache(maxsize=1000)
def _end(offset: int, text: str) -> bytes:
    """What follows the points, from an offset on: all of it empty but the text."""
    cdr = Cdr()
    cdr.raw(bytes(offset))
    cdr.put("I", 0)  # colors
    cdr.text("")  # texture_resource
    cdr.put("2I", 0, 0)  # texture: stamp,
    cdr.text("")  # frame,
    cdr.text("")  # format,
    cdr.put("I", 0)  # data
    cdr.put("I", 0)  # uv_coordinates
    cdr.text(text)
    cdr.text("")  # mesh_resource
    cdr.text("")  # mesh_file: name,
    cdr.put("I", 0)  # data
    cdr.put("B", 0)  # mesh_use_embedded_materials
    return cdr.bytes()[len(HEAD) + offset :]
