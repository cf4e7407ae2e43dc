"""The input at the door: one registered pair of a range image and a colour image (section 2), and its camera.

Everything is checked here, once; the rooms further in trust it. The range signal of a camera is inverse
depth, because a plane seen through a pinhole is exactly linear in the pixel coordinates there, not in z.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_core.errors import InputError

#: Pixels nearer or farther are invalid: no range sensor gives them, and float32 cannot hold their signals.
MIN_DEPTH_M, MAX_DEPTH_M = 1e-9, 1e9


@dataclass(frozen=True)
class PinholeCamera:
    """A pinhole camera in pixels: ``col = fx x/z + cx``, ``row = fy y/z + cy`` (optical frame).

    Raises
    ------
    InputError
        If a focal length is not positive or a value is not finite.
    """

    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        if not all(math.isfinite(v) for v in (self.fx, self.fy, self.cx, self.cy)):
            raise InputError(f"camera: intrinsics must be finite, got {self}")
        if self.fx <= 0 or self.fy <= 0:
            raise InputError(f"camera: fx and fy must be positive pixels, got fx={self.fx}, fy={self.fy}")

    def rays(self, height: int, width: int) -> NDArray[np.float32]:
        """(height, width, 3) float32 rays, z = 1; a point is ``ray * depth`` or ``ray / inverse depth``."""
        rays = np.ones((height, width, 3), np.float32)
        rays[..., 0] = ((np.arange(width) - self.cx) / self.fx)[None, :]
        rays[..., 1] = ((np.arange(height) - self.cy) / self.fy)[:, None]
        return rays

    def matrix(self) -> NDArray[np.float64]:
        """(3, 3) camera matrix K."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], float)


@dataclass(frozen=True)
class RangeColorFrame:
    """A registered range and colour image.

    Parameters
    ----------
    points : (H, W, 3) float32 or float64, metres
        With a camera in its optical frame, without one in any. NaN, infinity and (0, 0, 0) mark a pixel where
        nothing was measured; so do values beyond MAX_DEPTH_M and, with a camera, z below MIN_DEPTH_M.
    color : (H, W, 3) uint8, RGB
    camera : PinholeCamera or None
        None for scanner grids: the range signal is then x, y, z.

    Raises
    ------
    InputError
        Wrong shape or dtype, images of different size, smaller than 3x3, or no valid pixel.
    """

    points: NDArray[Any]
    color: NDArray[np.uint8]
    camera: PinholeCamera | None = None

    def __post_init__(self) -> None:
        points, color = self.points, self.color
        if not isinstance(points, np.ndarray) or points.ndim != 3 or points.shape[2] != 3:
            raise InputError(f"points: expected an array of shape (H, W, 3), got {_what(points)}")
        if points.dtype not in (np.float32, np.float64):
            raise InputError(f"points: expected float32 or float64 metres, got {points.dtype}")
        if not isinstance(color, np.ndarray) or color.ndim != 3 or color.shape[2] != 3:
            raise InputError(f"color: expected an array of shape (H, W, 3), got {_what(color)}")
        if color.dtype != np.uint8:
            raise InputError(f"color: expected uint8 RGB, got {color.dtype}")
        if points.shape != color.shape:
            raise InputError(
                f"points are {_size(points)} and color is {_size(color)}: "
                "both must be registered in one pixel grid"
            )
        if min(points.shape[:2]) < 3:
            raise InputError(f"the image is {_size(points)}: at least 3x3 pixels are needed")
        if self.camera is not None and not isinstance(self.camera, PinholeCamera):
            raise InputError(f"camera: expected a PinholeCamera or None, got {type(self.camera).__name__}")
        # One layout for the compiled kernels, which would be compiled again for each other one.
        object.__setattr__(self, "points", np.require(points, requirements=["C", "W"]))
        object.__setattr__(self, "color", np.require(color, requirements=["C", "W"]))
        if not self.valid.any():
            raise InputError(f"no valid pixel: {self._why_nothing()}")

    @classmethod
    def from_depth(
        cls, depth_m: NDArray[Any], color: NDArray[np.uint8], camera: PinholeCamera
    ) -> RangeColorFrame:
        """A frame from a depth image along the optical axis.

        Parameters
        ----------
        depth_m : (H, W) float32 or float64, metres; 0, NaN or negative marks an invalid pixel.
        """
        if not isinstance(depth_m, np.ndarray) or depth_m.ndim != 2:
            raise InputError(f"depth: expected an array of shape (H, W), got {_what(depth_m)}")
        if depth_m.dtype not in (np.float32, np.float64):
            raise InputError(f"depth: expected float32 or float64 metres, got {depth_m.dtype}")
        if not isinstance(camera, PinholeCamera):
            raise InputError("camera: a depth image needs a PinholeCamera")
        height, width = depth_m.shape
        points = np.empty((height, width, 3), np.float32)
        across, down = camera.rays(1, width)[..., 0], camera.rays(height, 1)[..., 1]
        points[..., 2] = depth_m
        with np.errstate(invalid="ignore", over="ignore"):  # infinity: beyond all depth, and so invalid
            np.multiply(points[..., 2], across, out=points[..., 0])
            np.multiply(points[..., 2], down, out=points[..., 1])
        return cls(points, color, camera)

    @property
    def height(self) -> int:
        return int(self.points.shape[0])

    @property
    def width(self) -> int:
        return int(self.points.shape[1])

    @property
    def depth_m(self) -> NDArray[Any]:
        """(H, W) z of the points: with a camera the depth along its axis, metres; `valid` tells where."""
        return self.points[..., 2]

    @cached_property
    def valid(self) -> NDArray[np.bool_]:
        """(H, W) bool: finite points that a sensor can give; with a camera also in front of it."""
        x, y, z = (self.points[..., axis] for axis in range(3))
        # plane by plane: reducing over an axis of three takes ten times as long
        valid: NDArray[np.bool_] = np.isfinite(x) & np.isfinite(y)
        if self.camera is None:
            valid &= np.isfinite(z) & ((x != 0) | (y != 0) | (z != 0))
            for plane in (x, y, z):
                valid &= np.abs(plane) <= MAX_DEPTH_M
        else:
            valid &= (z >= MIN_DEPTH_M) & (z <= MAX_DEPTH_M)
        return valid

    def _why_nothing(self) -> str:
        """What the points are, of which none is valid."""
        finite = np.isfinite(self.points).all(axis=2)
        measured = int((finite & self.points.any(axis=2)).sum())
        if not measured:
            return "every point is NaN, infinite or (0, 0, 0)"
        if self.camera is not None and not (self.depth_m[finite] > 0).any():
            return (
                f"none of the {measured} points lies before the camera (z > 0); give them in the camera's "
                "optical frame (x right, y down, z ahead), or without a camera"
            )
        return f"all {measured} points lie beyond what is metres ({MIN_DEPTH_M:g} to {MAX_DEPTH_M:g} m)"


def _size(image: NDArray[Any]) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


def _what(value: object) -> str:
    return f"shape {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
