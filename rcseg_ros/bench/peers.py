"""Other segmenters that pip installs, each as one call on a frame, for ratios in the same run.

None of them does the same work: findPlanes and planar patches find planes in the range alone, felzenszwalb
regions of the colour alone. What a peer only reads (points in its own layout) is prepared outside its call.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from rcseg_core import RangeColorFrame

Call = Callable[[], object]


@dataclass(frozen=True)
class Peer:
    """One other segmenter.

    Attributes
    ----------
    name : as tables and files call it
    make : gives the call for a frame, or None where the peer cannot do that frame
    one_thread : whether it keeps to one thread when the run asks for one
    """

    name: str
    make: Callable[[RangeColorFrame], Call | None]
    one_thread: bool = True


def installed_peers() -> tuple[Peer, ...]:
    """The peers that can be imported here, in the order of the tables."""
    peers = []
    if hasattr(cv2, "findPlanes"):  # OpenCV 5
        peers.append(Peer("cv2.findPlanes", _find_planes))
        peers.append(Peer("cv2.findPlanes+normals", _find_planes_with_normals))
    if _module("open3d") is not None:  # its OpenMP threads cannot be set from Python
        peers.append(Peer("open3d planar patches", _planar_patches, one_thread=False))
    if _module("skimage.segmentation") is not None:
        peers.append(Peer("skimage felzenszwalb", _felzenszwalb))
    return tuple(peers)


def _module(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except (ImportError, OSError):  # OSError: a shared library that a wheel needs is missing
        return None


def _four_channels(frame: RangeColorFrame) -> np.ndarray:
    """(H, W, 4) float32. OpenCV 5.0 takes three channels too, but reads them as four: nonsense, and fast."""
    fourth = np.zeros((frame.height, frame.width, 1), np.float32)
    return np.concatenate([frame.points.astype(np.float32), fourth], axis=2)


def _find_planes(frame: RangeColorFrame) -> Call:
    points = _four_channels(frame)
    return lambda: cv2.findPlanes(points, None)


def _find_planes_with_normals(frame: RangeColorFrame) -> Call | None:
    camera = frame.camera
    if camera is None:
        return None
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], np.float32)
    method = cv2.RgbdNormals_RGBD_NORMALS_METHOD_FALS
    normals = cv2.RgbdNormals.create(frame.height, frame.width, cv2.CV_32F, matrix, 5, 50.0, method)
    points = _four_channels(frame)
    return lambda: cv2.findPlanes(points, normals.apply(points))


def _planar_patches(frame: RangeColorFrame) -> Call:
    o3d = _module("open3d")
    points = frame.points[frame.valid].astype(np.float64)

    def call() -> object:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        cloud.estimate_normals()
        return cloud.detect_planar_patches()

    return call


def _felzenszwalb(frame: RangeColorFrame) -> Call:
    felzenszwalb = _module("skimage.segmentation").felzenszwalb
    color = frame.color
    return lambda: felzenszwalb(color, scale=200, sigma=0.8, min_size=200)
