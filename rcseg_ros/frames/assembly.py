"""From a pair of messages to a registered frame: which gives the points, which the colour, which the camera.

The algorithm wants points and colour in one pixel grid. Depth images and organised clouds of the colour's own
camera have that grid already, once both are rectified; depth of another camera is drawn into the colour's
view, and other clouds are projected into it, where of two points in one pixel the nearer wins.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_core import RangeColorFrame
from rcseg_core.registration import render_depth
from rcseg_ros.frames.cameras import (
    choose_view,
    is_rectified,
    points_of,
    rectify_color,
    rectify_points,
    shows,
)
from rcseg_ros.frames.cloud_frames import from_grid, has_grid, projected, with_own_color
from rcseg_ros.frames.conversions import (
    Cloud,
    Header,
    MessageError,
    decode_camera_info,
    decode_cloud,
    decode_depth,
    decode_image,
    header_of,
)
from rcseg_ros.frames.reading import DEFAULT_READING, Reading
from rcseg_ros.frames.registration import (
    Assembled,
    Link,
    Surroundings,
    assembled,
    both_rectified,
    find_link,
    moved,
    no_color,
    same_frame,
)
from rcseg_ros.frames.scaling import fit_camera_info, scale_color


def assemble_frame(
    range_message: Any,
    image: Any | None = None,
    camera_info: Any | None = None,
    cloud_to_camera: NDArray[np.float64] | None = None,
    reading: Reading = DEFAULT_READING,
) -> RangeColorFrame:
    """The frame of `assemble` alone, for messages whose topics and frames tell nothing."""
    around = Surroundings(extrinsic=cloud_to_camera)
    return assemble(range_message, image, camera_info, around=around, reading=reading).frame


def assemble(
    range_message: Any,
    image: Any | None = None,
    camera_info: Any | None = None,
    range_camera_info: Any | None = None,
    around: Surroundings | None = None,
    reading: Reading = DEFAULT_READING,
) -> Assembled:
    """Registered frame from a cloud or depth image, a colour image and a camera_info, where there is one.

    Parameters
    ----------
    range_message : sensor_msgs PointCloud2, or Image / CompressedImage holding depth (REP 118)
    image : sensor_msgs Image or CompressedImage; None takes the colour from the cloud's own rgb field
    camera_info : of the colour image, or of the grid that it shares with the range; needed for depth images
        and unorganised clouds; None makes an organised cloud a scanner grid; of another size it is scaled
    range_camera_info : of a depth image of another camera, else None
    around : names of topics, transforms and what the user says
    reading : units and bits that the messages do not tell

    Raises
    ------
    MessageError
        Beside those of the decoders: ``no_camera_info``, ``no_color``, ``size_mismatch``,
        ``camera_mismatch``, ``no_transform``, ``unknown_distortion``.
    rcseg_core.errors.InputError
        What the frame itself refuses, such as no valid pixel.
    """
    around = around or Surroundings()
    color = None if image is None else decode_image(image, reading)
    header = header_of(range_message)
    frame_id = "" if image is None else _frame_of(image, camera_info)
    if not hasattr(range_message, "fields"):
        depth_m = decode_depth(range_message, reading)
        if color is None:
            raise no_color()
        return _with_depth(depth_m, color, camera_info, range_camera_info, header, frame_id, around)
    apart = not same_frame(header.frame_id, frame_id)
    cloud = decode_cloud(range_message, reading, with_color=color is None or apart)
    if color is None:
        return with_own_color(cloud, camera_info or range_camera_info, header, around)
    camera_info, own = _sorted(camera_info, range_camera_info, header.frame_id, frame_id)
    if _keeps_own_color(cloud, own, header, frame_id, around):
        return with_own_color(cloud, own, header, around)
    link = find_link(header, frame_id, around)
    if link.transform is None and has_grid(cloud, color, camera_info or own, around):
        return from_grid(cloud.points, color, camera_info or own, link, around)
    return projected(cloud, color, camera_info, link, around, own)


def _with_depth(
    depth_m: NDArray[np.float32],
    color: NDArray[np.uint8],
    camera_info: Any | None,
    range_camera_info: Any | None,
    header: Header,
    frame_id: str,
    around: Surroundings,
) -> Assembled:
    link = find_link(header, frame_id, around)
    if link.transform is None:
        return _depth_as_it_is(depth_m, color, camera_info or range_camera_info, link, around)
    camera_info, own = _sorted(camera_info, range_camera_info, header.frame_id, frame_id)
    if own is None and np.allclose(link.transform, np.eye(4), atol=1e-9):
        return _depth_as_it_is(depth_m, color, camera_info, link, around)
    return _depth_of_another_camera(depth_m, color, camera_info, own, link, around)


def _frame_of(image: Any, camera_info: Any | None) -> str:
    """Frame of the colour image; some drivers leave it to the camera_info."""
    return str(image.header.frame_id) or ("" if camera_info is None else str(camera_info.header.frame_id))


def _sorted(
    camera_info: Any | None, own: Any | None, range_frame: str, color_frame: str
) -> tuple[Any | None, Any | None]:
    """The camera_infos of colour and range; where there is one alone, its frame tells whose it is."""
    if camera_info is None or own is not None or same_frame(range_frame, color_frame):
        return camera_info, own
    of_range = same_frame(str(camera_info.header.frame_id), range_frame)
    return (None, camera_info) if of_range else (camera_info, None)


def _keeps_own_color(
    cloud: Cloud, own: Any | None, header: Header, frame_id: str, around: Surroundings
) -> bool:
    """A cloud with colour in a grid of its own needs no image of another frame, to be moved there."""
    in_grid = cloud.organized or own is not None
    if around.prefer_image or around.extrinsic is not None or cloud.color is None or not in_grid:
        return False
    try:
        return find_link(header, frame_id, around).transform is not None
    except MessageError:
        return True


def _depth_as_it_is(
    depth_m: NDArray[np.float32],
    color: NDArray[np.uint8],
    camera_info: Any | None,
    link: Link,
    around: Surroundings,
) -> Assembled:
    """Depth in the colour's grid: both are rectified where they are not yet."""
    if camera_info is None:
        raise MessageError(
            "no_camera_info", "depth image without a camera_info: nothing says where its points are"
        )
    color = scale_color(color, depth_m.shape)
    camera = decode_camera_info(fit_camera_info(camera_info, depth_m.shape))
    of_range, of_color = both_rectified(around)
    view = choose_view(camera, depth=of_range, colour=of_color)
    if not shows(view, camera, of_range):
        depth_m = rectify_points(points_of(depth_m, camera, of_range), camera, view)
    if not shows(view, camera, of_color):
        color, seen = rectify_color(color, camera, view)
        depth_m = np.where(seen, depth_m, np.nan)
    return assembled(RangeColorFrame.from_depth(depth_m, color, view.pinhole), view, link)


def _depth_of_another_camera(
    depth_m: NDArray[np.float32],
    color: NDArray[np.uint8],
    camera_info: Any | None,
    own_info: Any | None,
    link: Link,
    around: Surroundings,
) -> Assembled:
    """Depth drawn into the view of the colour image's camera."""
    if camera_info is None or own_info is None:
        what = "colour image" if camera_info is None else "depth image"
        raise MessageError(
            "no_camera_info",
            f"depth of another camera ({link.how}): the camera_info of the {what} is missing; "
            "camera_info is the colour's, depth_camera_info (--topics range_camera_info=) the depth's",
        )
    camera = decode_camera_info(fit_camera_info(camera_info, color.shape, "colour image"))
    own = decode_camera_info(fit_camera_info(own_info, depth_m.shape))
    of_color = is_rectified(around.color_topic, around.images)
    view = choose_view(camera, colour=of_color)
    points = points_of(depth_m, own, is_rectified(around.range_topic, around.images))
    depth_m = render_depth(moved(points, link.transform), view.pinhole, view.height, view.width)
    if not shows(view, camera, of_color):
        color, seen = rectify_color(color, camera, view)
        depth_m = np.where(seen, depth_m, np.nan)
    return assembled(RangeColorFrame.from_depth(depth_m, color, view.pinhole), view, link)
