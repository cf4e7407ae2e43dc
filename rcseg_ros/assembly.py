"""From a pair of messages to a registered frame: which gives the points, which the colour, which the camera.

The algorithm wants points and colour in one pixel grid. Depth images and organised clouds have that grid
already; other clouds are projected into the camera's grid, where of two points in one pixel the nearer wins.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_core import RangeColorFrame
from rcseg_ros.conversions import (
    CameraModel,
    MessageError,
    decode_camera_info,
    decode_cloud,
    decode_depth,
    decode_image,
)

# An organised cloud whose points fall this far from their own pixels was not taken through the given camera.
_GRID_TOLERANCE_PX = 4.0


def assemble_frame(
    range_message: Any,
    image: Any | None = None,
    camera_info: Any | None = None,
    cloud_to_camera: NDArray[np.float64] | None = None,
) -> RangeColorFrame:
    """Registered frame from a cloud or depth image, a colour image and a camera_info, where there is one.

    Parameters
    ----------
    range_message : sensor_msgs PointCloud2, or Image / CompressedImage holding depth (REP 118)
    image : sensor_msgs Image or CompressedImage; None takes the colour from the cloud's own rgb field
    camera_info : needed for depth images and unorganised clouds; None makes an organised cloud a scanner grid
    cloud_to_camera : (4, 4) rigid transform from the cloud's frame to the camera's; None: they are the same

    Raises
    ------
    MessageError
        Beside those of the decoders: ``no_camera_info``, ``no_color``, ``size_mismatch``,
        ``camera_mismatch``.
    rcseg_core.errors.InputError
        What the frame itself refuses, such as no valid pixel.
    """
    camera = None if camera_info is None else decode_camera_info(camera_info)
    color = None if image is None else decode_image(image)
    if not hasattr(range_message, "fields"):
        return _frame_from_depth(decode_depth(range_message), color, camera)
    cloud = decode_cloud(range_message, with_color=color is None)
    in_grid = cloud.organized and (color is None or cloud.points.shape == color.shape)
    if in_grid and cloud_to_camera is None:
        return _frame_from_grid(cloud.points, cloud.color if color is None else color, camera)
    if camera is None:
        raise _no_grid(cloud.points.shape, color)
    points, own_color = project_cloud(cloud.points, camera, cloud.color, cloud_to_camera)
    chosen = own_color if color is None else color
    if chosen is None:
        raise _no_color()
    if points.shape != chosen.shape:
        raise _size_mismatch("camera_info", points.shape, "colour image", chosen.shape)
    return RangeColorFrame(points, chosen, camera.pinhole)


def _frame_from_depth(
    depth_m: NDArray[np.float32], color: NDArray[np.uint8] | None, camera: CameraModel | None
) -> RangeColorFrame:
    if camera is None:
        raise MessageError(
            "no_camera_info", "depth image without a camera_info: nothing says where its points are"
        )
    if color is None:
        raise _no_color()
    if depth_m.shape != color.shape[:2]:
        raise _size_mismatch("depth image", depth_m.shape, "colour image", color.shape)
    if depth_m.shape != (camera.height, camera.width):
        raise _size_mismatch("depth image", depth_m.shape, "camera_info", (camera.height, camera.width))
    return RangeColorFrame.from_depth(depth_m, color, camera.pinhole)


def _frame_from_grid(
    points: NDArray[np.float32], color: NDArray[np.uint8] | None, camera: CameraModel | None
) -> RangeColorFrame:
    if color is None:
        raise _no_color()
    if camera is None:
        return RangeColorFrame(points, color, None)
    if points.shape[:2] != (camera.height, camera.width):
        raise _size_mismatch("cloud", points.shape, "camera_info", (camera.height, camera.width))
    _check_grid(points, camera)
    return RangeColorFrame(points, color, camera.pinhole)


def _check_grid(points: NDArray[np.float32], camera: CameraModel) -> None:
    """Refuse a cloud that another camera, or another coordinate frame, put into this grid."""
    rows, cols = np.divmod(np.arange(0, points.shape[0] * points.shape[1], 97), points.shape[1])
    sample = points[rows, cols].astype(np.float64)
    ahead = np.isfinite(sample).all(axis=1) & (sample[:, 2] != 0)
    if not ahead.any():
        return
    x, y, z = sample[ahead].T
    pinhole = camera.pinhole
    off_px = np.hypot(
        pinhole.fx * x / z + pinhole.cx - cols[ahead], pinhole.fy * y / z + pinhole.cy - rows[ahead]
    )
    if np.median(off_px) > _GRID_TOLERANCE_PX:
        raise MessageError(
            "camera_mismatch",
            f"cloud: its points lie {np.median(off_px):.0f} px (median) from where camera_info "
            "puts them; name the camera_info of the same sensor, or leave it out for a scanner grid",
        )


def project_cloud(
    points: NDArray[np.floating[Any]],
    camera: CameraModel,
    color: NDArray[np.uint8] | None = None,
    cloud_to_camera: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.uint8] | None]:
    """Sort points into the camera's pixel grid; of several in one pixel the nearest wins, then the first.

    Parameters
    ----------
    points : (..., 3) metres; NaN, or not in front of the camera: left out
    color : (..., 3) uint8, carried along

    Returns
    -------
    points : (H, W, 3) float32, metres, camera frame; NaN where no point fell
    color : (H, W, 3) uint8, 0 where no point fell; None if there was none
    """
    height, width = camera.height, camera.width
    xyz = np.asarray(points, np.float64).reshape(-1, 3)
    if cloud_to_camera is not None:
        xyz = xyz @ cloud_to_camera[:3, :3].T + cloud_to_camera[:3, 3]
    index = np.flatnonzero(np.isfinite(xyz).all(axis=1) & (xyz[:, 2] > 0))
    x, y = xyz[index, 0] / xyz[index, 2], xyz[index, 1] / xyz[index, 2]
    # Far outside the field of view the distortion polynomial folds back into the image.
    pinhole = camera.pinhole
    near = (np.abs(pinhole.fx * x + pinhole.cx - width / 2) < width) & (
        np.abs(pinhole.fy * y + pinhole.cy - height / 2) < height
    )
    index, (x, y) = index[near], _distort(x[near], y[near], camera)
    col = np.rint(pinhole.fx * x + pinhole.cx).astype(np.int64)
    row = np.rint(pinhole.fy * y + pinhole.cy).astype(np.int64)
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


def _distort(
    x: NDArray[np.float64], y: NDArray[np.float64], camera: CameraModel
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Apply plumb_bob or rational_polynomial distortion to normalised image coordinates."""
    if not camera.distortion:
        return x, y
    k1, k2, p1, p2, k3, k4, k5, k6 = (*camera.distortion, 0.0, 0.0, 0.0, 0.0)[:8]
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def _no_color() -> MessageError:
    return MessageError("no_color", "no colour: neither a colour image nor an rgb field in the cloud")


def _no_grid(cloud: tuple[int, ...], color: NDArray[np.uint8] | None) -> MessageError:
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
    return _size_mismatch("cloud", cloud, "colour image", color.shape)


def _size_mismatch(
    one: str, shape: tuple[int, ...], other: str, other_shape: tuple[int, ...]
) -> MessageError:
    return MessageError(
        "size_mismatch",
        f"{one} is {shape[1]}x{shape[0]} but {other} is {other_shape[1]}x{other_shape[0]}: "
        "use topics registered to one camera (aligned depth, or a cloud with its camera_info)",
    )
