"""Step 1: normalise the colour to the albedo where the light is known (section 3, eq. 4-7).

Eq. (5): received/incident = K rho (mu.n)/r^2. For light at the sensor, mu is the direction to the sensor, so
rho ~ P_r r^2/(mu.n). With a frame of a white Lambertian board, eq. (6) gives the incident power per pixel and
eq. (7) the albedo relative to the board. Passive colour (`none`) is left as it is.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_core.config import ReflectanceConfig
from rcseg_core.errors import InputError
from rcseg_core.frame import RangeColorFrame

#: Normals are differences over this many pixels of smoothed points: shading varies slowly, noise does not.
NORMAL_WINDOW_PX = 9


def pixel_normals(points: NDArray[Any], valid: NDArray[np.bool_]) -> NDArray[np.float32]:
    """(H, W, 3) float32 unit normals towards the sensor, from smoothed differences; NaN where unknown."""
    weight = valid.astype(np.float32)
    size = (NORMAL_WINDOW_PX, NORMAL_WINDOW_PX)
    share = cv2.boxFilter(weight, -1, size)
    smooth = cv2.boxFilter(np.where(valid[..., None], points, 0).astype(np.float32), -1, size)
    with np.errstate(invalid="ignore", divide="ignore"):
        smooth = smooth / share[..., None]
        smooth[share < 0.3] = np.nan
        d_row, d_col = np.gradient(smooth, axis=(0, 1))
        normal = np.cross(d_col, d_row)
        normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    away = np.einsum("ijk,ijk->ij", normal, smooth) > 0
    normal[away] *= -1
    return normal.astype(np.float32)


def incidence(frame: RangeColorFrame, min_cosine: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """r^2 (m^2) and mu.n of eq. (4) for light at the sensor; both (H, W) float32, NaN where unknown.

    A scanner grid has no centre of projection: its light falls along z, and r is the distance along z.
    """
    normal = pixel_normals(frame.points, frame.valid)
    points = np.where(frame.valid[..., None], frame.points, np.nan).astype(np.float32)
    if frame.camera is None:
        r2 = np.where(points[..., 2] == 0, np.nan, points[..., 2] ** 2)  # no light comes from its own plane
        cosine = np.abs(normal[..., 2])
    else:
        r2 = np.einsum("ijk,ijk->ij", points, points)
        cosine = np.abs(np.einsum("ijk,ijk->ij", normal, points)) / np.sqrt(r2)
    return r2, np.maximum(cosine, np.float32(min_cosine))


def normalize_reflectance(
    frame: RangeColorFrame, config: ReflectanceConfig, white: RangeColorFrame | None = None
) -> NDArray[np.uint8]:
    """The colour image as relative albedo, (H, W, 3) uint8.

    Parameters
    ----------
    white : RangeColorFrame, for mode "calibrated"
        The same sensor looking at a white Lambertian board, pixel for pixel.

    Raises
    ------
    InputError
        Mode "calibrated" without a white frame, or with one of another size.

    Notes
    -----
    Where the geometry is unknown the correction of the whole frame's median is used, so that those pixels
    keep their place among their neighbours. "active" is scaled to keep the median brightness; "calibrated"
    maps the white board to 255.
    """
    if config.mode == "none":
        return frame.color
    r2, cosine = incidence(frame, config.min_cosine)
    factor = r2 / cosine  # eq. (5)
    if config.mode == "calibrated":
        if white is None:
            raise InputError("reflectance.mode is calibrated: a white-reference frame is needed (eq. 6)")
        if white.color.shape != frame.color.shape:
            raise InputError(
                f"the white-reference frame is {white.width}x{white.height}, "
                f"the frame {frame.width}x{frame.height}"
            )
        r2_white, cosine_white = incidence(white, config.min_cosine)
        incident = white.color * (r2_white / cosine_white)[..., None]  # eq. (6)
        with np.errstate(invalid="ignore", divide="ignore"):
            albedo = frame.color * factor[..., None] / incident * 255.0  # eq. (7)
            known = np.isfinite(albedo)
            typical = _median((albedo / frame.color)[known & (frame.color > 0)])
        albedo = np.where(known, albedo, frame.color * typical)
    else:
        typical = _median(factor[np.isfinite(factor)])
        albedo = frame.color * (np.where(np.isfinite(factor), factor, typical) / typical)[..., None]
    return np.clip(np.rint(albedo), 0, 255).astype(np.uint8)


def _median(factors: NDArray[Any]) -> float:
    """The median, or 1 (no correction) where nothing is known."""
    return float(np.median(factors)) if factors.size else 1.0


def weigh_intensity(color: NDArray[np.uint8], weight: float) -> NDArray[np.uint8]:
    """Colour in which differences of brightness count `weight` times as much as those of chromaticity.

    Passive light is not known, so eq. (5) cannot be undone; but a shadow or a gradient of light moves the
    three channels together, while most changes of albedo do not. Grey levels are pulled towards the middle,
    what tells the channels apart stays. `color` itself for weight 1.
    """
    if weight == 1.0:
        return color
    mean = color.mean(axis=2, dtype=np.float32, keepdims=True)
    weighed: NDArray[np.uint8] = np.clip(np.rint(color + (1.0 - weight) * (127.0 - mean)), 0, 255).astype(
        np.uint8
    )
    return weighed
