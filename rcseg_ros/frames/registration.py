"""How a range image and a colour image come into one pixel grid: as they are, or by a transform.

Two images pair pixel by pixel if they are of one optical frame. Two frames need a transform, unless the
driver has registered the one to the other already, which the names of topics tell, or the user does.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_core import RangeColorFrame
from rcseg_ros.frames.cameras import View, is_rectified
from rcseg_ros.frames.conversions import Header, MessageError
from rcseg_ros.frames.extrinsic import TransformTree, frame_name
from rcseg_ros.frames.up import UpSource

_COLORS = {"color", "colour", "rgb"}
_ALIGNED_TO = re.compile(r"(?:^|[/_])depth_(?:aligned_)?to_([a-z0-9]+)")
_REGISTERED = re.compile(r"(?<!un)(?<!not_)(registered|aligned)")
_COLOR_TO_DEPTH = re.compile(r"(?:^|[/_])(rgb|colou?r|image)_to_depth(?=[/_]|$)")


@dataclass(frozen=True)
class Surroundings:
    """What is known beside the messages of a frame.

    Attributes
    ----------
    range_topic, color_topic : names of the topics, which tell rectified and registered images
    images : "auto", "raw" or "rectified", what the images are
    assume_registered : range and colour pair pixel by pixel, whatever their frame_ids say
    extrinsic : (4, 4) transform from the frame of the range to that of the colour image, or None
    transforms : TransformTree
    prefer_image : False lets an organised cloud keep its own colour where the image is of another frame
    up : what a robot tells of up
    """

    range_topic: str = ""
    color_topic: str = ""
    images: str = "auto"
    assume_registered: bool = False
    extrinsic: NDArray[np.float64] | None = None
    transforms: TransformTree = field(default_factory=TransformTree)
    prefer_image: bool = False
    up: UpSource = field(default_factory=UpSource)


@dataclass(frozen=True)
class Geometry:
    """How a frame came about, for people and for metrics.

    matrix : "K" or "P" of the camera_info, "none" for a scanner's grid
    why : what decided between them
    registration : how range and colour came into one grid
    """

    matrix: str
    why: str
    registration: str

    def values(self) -> dict[str, str]:
        """Keys and values for diagnostics."""
        return {
            "camera.matrix": self.matrix,
            "camera.why": self.why,
            "camera.registration": self.registration,
        }

    def __str__(self) -> str:
        return f"{self.matrix} ({self.why}); {self.registration}"


@dataclass(frozen=True)
class Assembled:
    """A registered frame, the frame_id of its view, and how it came about."""

    frame: RangeColorFrame
    frame_id: str
    geometry: Geometry


@dataclass(frozen=True)
class Link:
    """How the range comes to the view of the colour image.

    transform : (4, 4) to the colour image's frame; None: the pixels pair as they are
    frame_id : of the view that both then have
    how : for people
    """

    transform: NDArray[np.float64] | None
    frame_id: str
    how: str


def same_frame(one: str, other: str) -> bool:
    """Whether two frame_ids may be one; an empty one says nothing."""
    return not one or not other or frame_name(one) == frame_name(other)


def find_link(header: Header, color_frame: str, around: Surroundings) -> Link:
    """How range and colour are registered.

    Parameters
    ----------
    header : of the range
    color_frame : frame_id of the colour image

    Raises
    ------
    MessageError
        Reason ``no_transform``: two frames, and nothing says how they stand to each other.
    """
    range_frame = header.frame_id
    one, other = frame_name(range_frame), frame_name(color_frame)
    if around.extrinsic is not None:
        return Link(around.extrinsic, color_frame or range_frame, "moved by input.extrinsic")
    if one == other and one:
        return Link(None, range_frame, f"one frame, {one}")
    if not one or not other:
        return Link(None, range_frame or color_frame, "frame_id missing, taken for one frame")
    if around.assume_registered:
        return Link(None, color_frame, f"{one} and {other}, assumed to be registered")
    named = registered_by_name(around.range_topic, around.color_topic)
    if named:
        frame_id = range_frame if named == around.color_topic else color_frame
        return Link(None, frame_id, f"{one} and {other}, registered by the name of {named}")
    transform = around.transforms.lookup(other, one, header.stamp_ns)
    if transform is not None:
        return Link(transform, color_frame, f"moved by tf from {one} to {other}")
    frames = ", ".join(around.transforms.frames()) or "none"
    raise MessageError(
        "no_transform",
        f"range is in frame {one}, colour in frame {other}, and no transform between them is known (tf has: "
        f"{frames}); publish or record /tf_static, give input.extrinsic_translation and _rotation "
        "(--extrinsic), or input.assume_registered (--assume-registered) if the driver has registered them",
    )


def registered_by_name(range_topic: str, color_topic: str) -> str:
    """The topic whose name says that a driver has registered the one to the other; empty if none does.

    Depth that is aligned to a third camera (aligned_depth_to_infra1) is not registered to the colour.
    """
    of_range, of_color = range_topic.lower(), color_topic.lower()
    to = _ALIGNED_TO.search(of_range)
    if to is not None:
        kin = to[1] in _COLORS or to[1] in re.split("[/_]", of_color)
        return range_topic if kin else ""
    if _COLOR_TO_DEPTH.search(of_color):
        return color_topic
    return range_topic if _REGISTERED.search(of_range) else ""


def both_rectified(around: Surroundings) -> tuple[bool | None, bool | None]:
    """Whether range and colour are rectified; of two in one grid the one that tells speaks for both."""
    of_range = is_rectified(around.range_topic, around.images)
    of_color = is_rectified(around.color_topic, around.images)
    return (
        of_color if of_range is None else of_range,
        of_range if of_color is None else of_color,
    )


def assembled(frame: RangeColorFrame, view: View, link: Link) -> Assembled:
    return Assembled(frame, link.frame_id, Geometry(view.matrix, view.why, link.how))


def moved(points: NDArray[Any], transform: NDArray[np.float64] | None) -> NDArray[Any]:
    return points if transform is None else points @ transform[:3, :3].T + transform[:3, 3]


def no_color() -> MessageError:
    return MessageError("no_color", "no colour: neither a colour image nor an rgb field in the cloud")
