"""Where the camera stands in the frame of an organised cloud, from the cloud's own grid.

A cloud keeps the pixel grid of its camera when it is turned to other axes (x ahead, z up) or moved to the
frame of a robot or a map, so each point still tells which way its pixel looks. With the camera's matrix known
that gives its pose. It serves where no transform is known, and never invents one: a grid whose rays meet in
the origin, but not as this camera's do, was taken by another camera.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_core import PinholeCamera

Array = NDArray[np.float64]

#: Largest median distance of a point's image from its own pixel.
FIT_PX = 1.0
#: A rotation that fits so well needs no shift beside it.
_SURE_PX = 0.02
#: Axes that differ less from a permutation are one: half a pixel at a usual focal length, radians.
_EXACT_RAD = 1e-3
_SAMPLES, _LEAST = 4000, 50


def pose_of_grid(points: NDArray[np.floating[Any]], camera: PinholeCamera) -> Array | None:
    """The transform from the frame of an organised cloud to the optical frame of the camera that made it.

    Parameters
    ----------
    points : (H, W, 3) metres; NaN, infinite or (0, 0, 0) where nothing was measured
    camera : of the grid, pixels

    Returns
    -------
    (4, 4) float64, or None: no pose of this camera gives the grid, or too few points tell. Axes that are a
    permutation of the optical ones come out exactly, and the identity where the points are optical already.
    """
    found = _samples(points)
    if found is None:
        return None
    xyz, pixels = found
    turned = _rotation(xyz, pixels, camera)
    turned_px = _off_px(xyz, pixels, camera, turned)
    if turned_px > _SURE_PX:
        moved = _pose(xyz, pixels, camera)
        moved_px = np.inf if moved is None else _off_px(xyz, pixels, camera, moved)
        # a camera of another matrix in the origin must not explain the grid as well
        if moved_px <= FIT_PX and moved_px < 0.5 * min(turned_px, _centred_px(xyz, pixels)):
            return moved
    return turned if turned_px <= FIT_PX else None


def _samples(points: NDArray[np.floating[Any]]) -> tuple[Array, Array] | None:
    """Points (N, 3) and their pixels (N, 2) as column and row, evenly spread over what was measured."""
    rows, cols = np.nonzero(np.isfinite(points).all(axis=2) & points.any(axis=2))
    stride = max(1, rows.size // _SAMPLES)
    rows, cols = rows[::stride], cols[::stride]
    if rows.size < _LEAST or np.ptp(rows) < 2 or np.ptp(cols) < 2:
        return None
    return points[rows, cols].astype(np.float64), np.stack([cols, rows], axis=1).astype(np.float64)


def _off_px(xyz: Array, pixels: Array, camera: PinholeCamera, pose: Array) -> float:
    """Median distance of the points' images from their pixels."""
    return float(np.median(_distances(xyz, pixels, camera, pose)))


def _distances(xyz: Array, pixels: Array, camera: PinholeCamera, pose: Array) -> Array:
    """Distance of each point's image from its pixel; infinite behind the camera."""
    x, y, z = (xyz @ pose[:3, :3].T + pose[:3, 3]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        seen = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1)
    return np.where(z > 0, np.hypot(*(seen - pixels).T), np.inf)


def _best(off: Array) -> NDArray[np.bool_]:
    """All but the tenth that fits worst."""
    return np.asarray(off <= np.sort(off)[int(0.9 * (len(off) - 1))])


def _rotation(xyz: Array, pixels: Array, camera: PinholeCamera) -> Array:
    """The pose of a camera in the origin: it turns the points onto the rays of their pixels."""
    rays = np.ones_like(xyz)
    rays[:, :2] = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    unit = xyz / np.linalg.norm(xyz, axis=1, keepdims=True)
    pose = np.eye(4)
    for _ in range(2):  # once more without the tenth that fits worst
        left, _, right = np.linalg.svd(rays.T @ unit)
        mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
        pose[:3, :3] = left @ mirror @ right
        off = np.linalg.norm(unit @ pose[:3, :3].T - rays, axis=1)
        kept = _best(off)
        rays, unit = rays[kept], unit[kept]
    exact = np.rint(pose)
    if np.abs(exact - pose).max() < _EXACT_RAD:
        pose = exact
    return pose


def _centred_px(xyz: Array, pixels: Array) -> float:
    """Median distance of the points' images from their pixels for the best camera in the origin.

    On a single plane there is a perfect one wherever the camera stands; then nothing tells them apart.
    """
    ahead = np.linalg.svd(xyz / np.linalg.norm(xyz, axis=1, keepdims=True), full_matrices=False)[2]
    z = xyz @ ahead[0]
    if np.median(z) < 0:
        z, ahead[0] = -z, -ahead[0]
    front = z > 0
    plane = (xyz[front] @ ahead[1:].T) / z[front, None]
    matrix = cv2.findHomography(plane, pixels[front], cv2.LMEDS)[0] if front.sum() >= _LEAST else None
    if matrix is None or front.mean() < 0.9:
        return np.inf
    seen = cv2.perspectiveTransform(plane[:, None], matrix)[:, 0]
    return float(np.median(np.hypot(*(seen - pixels[front]).T)))


def _pose(xyz: Array, pixels: Array, camera: PinholeCamera) -> Array | None:
    """The pose of a camera anywhere."""
    middle = np.median(xyz, axis=0)  # a map's coordinates may be of millions
    near, matrix = xyz - middle, camera.matrix()
    kept = np.ones(len(near), bool)
    pose = np.eye(4)
    for _ in range(3):
        try:
            good, turn, shift = cv2.solvePnP(near[kept], pixels[kept], matrix, None, flags=cv2.SOLVEPNP_SQPNP)
        except cv2.error:
            return None
        if not good:
            return None
        turn, shift = cv2.solvePnPRefineLM(near[kept], pixels[kept], matrix, None, turn, shift)
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
        off = _distances(near, pixels, camera, pose)
        kept = _best(off)
        if not np.isfinite(off[kept]).all():
            return None
    pose[:3, 3] -= pose[:3, :3] @ middle
    return pose
