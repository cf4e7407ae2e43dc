"""Clouds in the grid of a camera: organised ones that have it, others projected into it.

Whether K or P made an organised cloud its points tell: each lies on the ray of its own pixel.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_core import PinholeCamera, RangeColorFrame
from rcseg_core.registration import render_depth
from rcseg_ros.frames.axes import pose_of_grid
from rcseg_ros.frames.cameras import (
    View,
    choose_view,
    is_bent,
    is_rectified,
    project,
    rectify_color,
    rectify_points,
    shows,
)
from rcseg_ros.frames.conversions import CameraModel, Cloud, Header, MessageError, decode_camera_info
from rcseg_ros.frames.registration import (
    Assembled,
    Geometry,
    Link,
    Surroundings,
    assembled,
    both_rectified,
    find_link,
    moved,
    no_color,
)
from rcseg_ros.frames.scaling import fit_camera_info, in_proportion, mismatch, scale_color

# An organised cloud whose points fall this far from their own pixels was not taken through the given camera.
_GRID_TOLERANCE_PX = 4.0
# One of another size than the colour is in its grid if its points lie as near as this.
_SCALED_TOLERANCE_PX = 1.0
# By so much another camera must fit the points better than the one that the names of topics tell.
_BETTER_PX = 0.25


def with_own_color(cloud: Cloud, camera_info: Any | None, header: Header, around: Surroundings) -> Assembled:
    """A frame from a cloud that carries its colour."""
    if cloud.color is None:
        raise no_color()
    how = "colour of the cloud itself"
    if cloud.organized and around.extrinsic is None:
        return from_grid(cloud.points, cloud.color, camera_info, Link(None, header.frame_id, how), around)
    link = find_link(header, "" if camera_info is None else str(camera_info.header.frame_id), around)
    return projected(cloud, None, camera_info, link, around)


def has_grid(cloud: Cloud, color: NDArray[np.uint8], camera_info: Any | None, around: Surroundings) -> bool:
    """Whether an organised cloud is in the grid of a colour image, if only in another size.

    Another size that happens to be in proportion is no grid yet: the camera must put the points there.
    """
    if not cloud.organized:
        return False
    if cloud.points.shape == color.shape:
        return True
    if camera_info is None or not in_proportion(cloud.points.shape, color.shape):
        return False
    camera = decode_camera_info(fit_camera_info(camera_info, cloud.points.shape, "cloud"))
    return _best_fit(cloud.points, camera, around)[1] <= _SCALED_TOLERANCE_PX


def from_grid(
    points: NDArray[np.float32],
    color: NDArray[np.uint8],
    camera_info: Any | None,
    link: Link,
    around: Surroundings,
) -> Assembled:
    """An organised cloud in the grid of its colour: the camera that its points fit, else a scanner's grid."""
    color = scale_color(color, points.shape, "cloud")
    if camera_info is None:
        return _scanned(points, color, "no camera_info", link)
    camera = decode_camera_info(fit_camera_info(camera_info, points.shape, "cloud"))
    view, off_px = _best_fit(points, camera, around)
    if off_px > _GRID_TOLERANCE_PX:
        # its own, in the axes of a robot or a map
        if any(pose_of_grid(points, pinhole) is not None for pinhole in _pinholes(camera).values()):
            return _scanned(points, color, "points in other axes than the camera's", link)
        raise MessageError(
            "camera_mismatch",
            f"cloud: its points lie {off_px:.0f} px (median) from where camera_info puts them, by K and P, "
            "in these axes or others; name the camera_info of the same sensor, or leave it out for a scanner "
            "grid",
        )
    if view is None:  # points and colour of a raw image that a lens has bent
        view = choose_view(camera, colour=False)
        color, seen = rectify_color(color, camera, view)
        depth_m = np.where(seen, rectify_points(points, camera, view), np.nan)
        return assembled(RangeColorFrame.from_depth(depth_m, color, view.pinhole), view, link)
    return assembled(RangeColorFrame(points, color, view.pinhole), view, link)


def _scanned(points: NDArray[np.float32], color: NDArray[np.uint8], why: str, link: Link) -> Assembled:
    frame = RangeColorFrame(points, color, None)
    return Assembled(frame, link.frame_id, Geometry("none", why, link.how))


def _pinholes(camera: CameraModel) -> dict[str, PinholeCamera]:
    return {"K": camera.pinhole, "P": camera.projection or camera.pinhole}


def _best_fit(
    points: NDArray[np.float32], camera: CameraModel, around: Surroundings
) -> tuple[View | None, float]:
    """The view that an organised cloud was taken through and how far, pixels (median), its points lie from
    their own pixels there, infinite if behind the camera; None: a raw image with distortion."""
    rows, cols = np.divmod(np.arange(0, points.shape[0] * points.shape[1], 97), points.shape[1])
    sample = points[rows, cols].astype(np.float64)
    measured = np.isfinite(sample).all(axis=1) & sample.any(axis=1)
    ahead = sample[measured, 2] > 0
    with np.errstate(divide="ignore", invalid="ignore"):
        rays = sample[measured, :2] / sample[measured, 2:]
    pixels = np.stack([cols[measured], rows[measured]], axis=1)

    def off_px(seen: NDArray[np.float64]) -> float:
        off = np.where(ahead, np.hypot(*(seen - pixels).T), np.inf)
        return float(np.median(off)) if len(off) else 0.0

    told = "P" if camera.only_projection or any(both_rectified(around)) else "K"
    view, least_px = None, np.inf
    for matrix in (told, "K" if told == "P" else "P"):
        pinhole = _pinholes(camera)[matrix]
        this_px = off_px(rays * (pinhole.fx, pinhole.fy) + (pinhole.cx, pinhole.cy))
        if view is None or this_px < least_px - _BETTER_PX:
            why = "points of the cloud fit it"
            view, least_px = View(pinhole, camera.height, camera.width, matrix, why), this_px
    if least_px > _BETTER_PX and ahead.any() and is_bent(camera):
        this_px = off_px(project(rays, camera))
        if this_px < least_px - _BETTER_PX:
            return None, this_px
    return view, least_px


def projected(
    cloud: Cloud,
    color: NDArray[np.uint8] | None,
    camera_info: Any | None,
    link: Link,
    around: Surroundings,
    own_info: Any | None = None,
) -> Assembled:
    """A cloud of another frame or grid, projected into the view of the colour image's camera.

    own_info : camera_info of another camera's grid, if the cloud is in one: its surfaces stay closed then
    """
    if camera_info is None:
        raise no_grid(cloud.points.shape, color)
    if color is not None:
        camera_info = fit_camera_info(camera_info, color.shape, "colour image")
    camera = decode_camera_info(camera_info)
    of_color = is_rectified(around.color_topic, around.images)
    view = choose_view(camera, colour=of_color)
    if color is not None and _is_grid_of(cloud, own_info, around):
        depth_m = render_depth(moved(cloud.points, link.transform), view.pinhole, view.height, view.width)
        points, own_color = view.pinhole.rays(*depth_m.shape) * depth_m[..., None], None
    else:
        points, own_color = project_cloud(cloud.points, view, cloud.color, link.transform)
    if color is None:
        color = own_color
    elif not shows(view, camera, of_color):
        color, seen = rectify_color(color, camera, view)
        points[~seen] = np.nan
    if color is None:
        raise no_color()
    return assembled(RangeColorFrame(points, color, view.pinhole), view, link)


def _is_grid_of(cloud: Cloud, camera_info: Any | None, around: Surroundings) -> bool:
    """Whether an organised cloud was taken through that camera."""
    if camera_info is None or not cloud.organized:
        return False
    camera = decode_camera_info(fit_camera_info(camera_info, cloud.points.shape, "cloud"))
    return _best_fit(cloud.points, camera, around)[1] <= _SCALED_TOLERANCE_PX


def project_cloud(
    points: NDArray[np.floating[Any]],
    view: View,
    color: NDArray[np.uint8] | None = None,
    cloud_to_camera: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.uint8] | None]:
    """Sort points into the pixel grid of a view; of several in one pixel the nearest wins, then the first.

    Parameters
    ----------
    points : (..., 3) metres; NaN, or not in front of the camera: left out
    color : (..., 3) uint8, carried along

    Returns
    -------
    points : (H, W, 3) float32, metres, camera frame; NaN where no point fell
    color : (H, W, 3) uint8, 0 where no point fell; None if there was none
    """
    height, width = view.height, view.width
    xyz = np.asarray(points, np.float64).reshape(-1, 3)
    xyz = moved(xyz, cloud_to_camera)
    index = np.flatnonzero(np.isfinite(xyz).all(axis=1) & (xyz[:, 2] > 0))
    x, y = xyz[index, 0] / xyz[index, 2], xyz[index, 1] / xyz[index, 2]
    pinhole = view.pinhole
    col, row = pinhole.fx * x + pinhole.cx, pinhole.fy * y + pinhole.cy
    near = (np.abs(col) < 2 * width) & (np.abs(row) < 2 * height)  # no number too large for an integer
    index, col, row = index[near], np.rint(col[near]).astype(int), np.rint(row[near]).astype(int)
    inside = (row >= 0) & (row < height) & (col >= 0) & (col < width)
    index, pixel = index[inside], (row * width + col)[inside]
    # From far to near, the nearest is written last; the stable order reversed lets the first point win ties.
    far_to_near = np.argsort(xyz[index, 2], kind="stable")[::-1]
    index, pixel = index[far_to_near], pixel[far_to_near]

    grid = np.full((height * width, 3), np.nan, np.float32)
    grid[pixel] = xyz[index]
    if color is None:
        return grid.reshape(height, width, 3), None
    grid_color = np.zeros((height * width, 3), np.uint8)
    grid_color[pixel] = color.reshape(-1, 3)[index]
    return grid.reshape(height, width, 3), grid_color.reshape(height, width, 3)


def no_grid(cloud: tuple[int, ...], color: NDArray[np.uint8] | None) -> MessageError:
    if cloud[0] == 1:
        return MessageError(
            "no_camera_info",
            f"unorganised cloud of {cloud[1]} points without a camera_info: it cannot be projected; "
            "record or name a camera_info topic, or publish an organised cloud",
        )
    if color is None or color.shape == cloud:
        return MessageError(
            "no_camera_info", "a transformed cloud must be projected, which needs a camera_info"
        )
    return mismatch("cloud", cloud, "colour image", color.shape)
