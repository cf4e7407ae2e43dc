"""What the pixels of an image see: K and D where it is raw, P where it is rectified (REP 104).

A camera_info describes both and does not say which its image is. The topic's name tells (image_raw,
image_rect), a parameter where it does not, and for a cloud in the image's grid the fit of its points. The
segmentation wants the grid of a pinhole, in which planes are linear in inverse depth: images that a lens has
bent are rectified, colour and range alike, into the view of P.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_core import PinholeCamera
from rcseg_core.registration import render_depth
from rcseg_ros.frames.conversions import CameraModel, MessageError

#: A lens that moves no pixel farther than this is taken for a pinhole, pixels.
STRAIGHT_PX = 0.5
#: Coefficients that OpenCV's models take.
_LENGTHS = {"plumb_bob": (4, 5, 8, 12, 14), "rational_polynomial": (4, 5, 8, 12, 14), "equidistant": (4,)}
_RECTIFIED = re.compile(r"(^|[/_])rect(ified)?(?=[/_]|$)")
_RAW = re.compile(r"(^|[/_])raw(?=[/_]|$)")


@dataclass(frozen=True)
class View:
    """The pinhole that an image is to be seen through.

    matrix : "K" or "P", which of them it is
    why : what decided, for people
    """

    pinhole: PinholeCamera
    height: int
    width: int
    matrix: str
    why: str


def is_rectified(topic: str, images: str = "auto") -> bool | None:
    """Whether an image is rectified, by its topic's name or as the user says; None: neither tells.

    Parameters
    ----------
    images : "auto", "raw" or "rectified"
    """
    if images != "auto":
        return images == "rectified"
    name = topic.lower()
    return True if _RECTIFIED.search(name) else False if _RAW.search(name) else None


def choose_view(camera: CameraModel, **rectified: bool | None) -> View:
    """The view for images of one camera, of which at least one keeps its pixels if it can.

    Parameters
    ----------
    rectified : for each image, by what people call it, what `is_rectified` says
    """
    pinhole, matrix = (camera.projection, "P") if camera.projection is not None else (camera.pinhole, "K")
    named = [name for name, yes in rectified.items() if yes]
    if camera.only_projection:
        why = "K is zero"
    elif named:
        why = f"rectified {' and '.join(named)}" + ("; P is zero" if matrix == "K" else "")
    elif is_bent(camera):
        why = f"raw images with distortion {camera.distortion_model}, rectified here"
    else:
        pinhole, matrix, why = camera.pinhole, "K", "raw images without distortion"
    return View(pinhole, camera.height, camera.width, matrix, why)


def shows(view: View, camera: CameraModel, rectified: bool | None) -> bool:
    """Whether an image of the camera has the pixels of the view as it is."""
    return bool(rectified) or camera.only_projection or (not is_bent(camera) and _same(view, camera))


def _same(view: View, camera: CameraModel) -> bool:
    if not np.allclose(camera.rotation, CameraModel.rotation, atol=1e-6) and view.matrix == "P":
        return False
    return bool(np.allclose(view.pinhole.matrix(), camera.pinhole.matrix(), rtol=1e-4, atol=1e-3))


@lru_cache(maxsize=16)
def is_bent(camera: CameraModel) -> bool:
    """Whether the lens moves some pixel by more than STRAIGHT_PX.

    Raises
    ------
    MessageError
        Reason ``unknown_distortion``.
    """
    if not camera.distortion:
        return False
    pinhole, rays = camera.pinhole, raw_rays(camera)
    cols, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    off = np.hypot(
        pinhole.fx * rays[..., 0] + pinhole.cx - cols, pinhole.fy * rays[..., 1] + pinhole.cy - rows
    )
    return not bool((off <= STRAIGHT_PX).all())


def project(rays: NDArray[np.float64], camera: CameraModel) -> NDArray[np.float64]:
    """(N, 2) columns and rows of the raw image that (N, 2) rays x/z, y/z meet.

    Raises
    ------
    MessageError
        Reason ``unknown_distortion``.
    """
    points = np.ascontiguousarray(np.c_[rays, np.ones(len(rays))])[None]
    still = np.zeros(3)
    pixels, _ = _lens(camera).projectPoints(
        points, still, still, camera.pinhole.matrix(), _coefficients(camera)
    )
    return np.asarray(pixels, np.float64).reshape(-1, 2)


@lru_cache(maxsize=4)
def raw_rays(camera: CameraModel) -> NDArray[np.float64]:
    """(H, W, 2) rays x/z, y/z of a raw image; NaN where the lens' model is not defined.

    OpenCV's few steps are too few for strong lenses; what more of them do not bring within a hundredth of a
    pixel is beyond where the model turns back.
    """
    pinhole = camera.pinhole
    cols, rows = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    wanted = np.stack([cols.ravel(), rows.ravel()], axis=1)
    focal, center = np.array([pinhole.fx, pinhole.fy]), np.array([pinhole.cx, pinhole.cy])
    if not camera.distortion:
        return ((wanted - center) / focal).reshape(camera.height, camera.width, 2)
    start = _lens(camera).undistortPoints(wanted[None], pinhole.matrix(), _coefficients(camera))
    rays = np.asarray(start, np.float64).reshape(-1, 2)
    rays = np.where(np.isfinite(rays) & (np.abs(rays) < 1e3), rays, np.nan)
    with np.errstate(invalid="ignore", over="ignore"):
        for _ in range(30):
            step = (wanted - project(rays, camera)) / focal
            rays += np.clip(step, -0.5, 0.5)
            if not (np.abs(step) > 1e-7).any():
                break
        off = np.abs(project(rays, camera) - wanted).max(axis=1)
    rays[~(off < 0.01)] = np.nan
    rays.flags.writeable = False
    return rays.reshape(camera.height, camera.width, 2)


def _lens(camera: CameraModel) -> Any:
    """The part of OpenCV that knows the lens."""
    return cv2.fisheye if camera.distortion_model == "equidistant" else cv2


def _coefficients(camera: CameraModel) -> NDArray[np.float64]:
    if not camera.distortion:
        return np.zeros(4)
    if len(camera.distortion) not in _LENGTHS.get(camera.distortion_model, ()):
        raise MessageError(
            "unknown_distortion",
            f"camera_info: distortion model {camera.distortion_model!r} with {len(camera.distortion)} "
            f"coefficients is not known ({', '.join(_LENGTHS)} are); give rectified images",
        )
    return np.array(camera.distortion)


def rectify_color(
    color: NDArray[np.uint8], camera: CameraModel, view: View
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """A raw (H, W, 3) colour image in the view, and where the camera sees the view at all."""
    *maps, seen = _maps(camera, view)
    return cv2.remap(color, *maps, cv2.INTER_LINEAR), seen


@lru_cache(maxsize=4)
def _maps(camera: CameraModel, view: View) -> tuple[Any, Any, NDArray[np.bool_]]:
    """OpenCV's maps from the view to the raw image, and which pixels of the view lie in that."""
    rotation = np.array(camera.rotation).reshape(3, 3) if view.matrix == "P" else np.eye(3)
    size = (view.width, view.height)
    col, row = _lens(camera).initUndistortRectifyMap(
        camera.pinhole.matrix(), _coefficients(camera), rotation, view.pinhole.matrix(), size, cv2.CV_32FC1
    )
    seen = (col >= 0) & (col <= camera.width - 1) & (row >= 0) & (row <= camera.height - 1)
    return *cv2.convertMaps(col, row, cv2.CV_16SC2), seen


def points_of(
    depth_m: NDArray[np.float32], camera: CameraModel, rectified: bool | None
) -> NDArray[np.float32]:
    """(H, W, 3) float32 points of a depth image, metres, in the axes of the image."""
    if rectified or camera.only_projection:
        pinhole = camera.projection or camera.pinhole
        return pinhole.rays(*depth_m.shape) * depth_m[..., None]
    points = np.empty((*depth_m.shape, 3), np.float32)
    points[..., :2] = raw_rays(camera) * depth_m[..., None]
    points[..., 2] = depth_m
    return points


def rectify_points(points: NDArray[np.float32], camera: CameraModel, view: View) -> NDArray[np.float32]:
    """(H, W) depth in the view of points that lie in the grid of a raw image."""
    if view.matrix == "P":
        points = points @ np.array(camera.rotation, np.float32).reshape(3, 3).T
    return render_depth(points, view.pinhole, view.height, view.width)
