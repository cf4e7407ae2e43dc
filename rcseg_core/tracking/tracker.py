"""Tracker.update, step by step: clock, motion, prediction, matching, lineage, fusion.

The same frames in the same order give the same ids, whatever segmented them. What is kept of a frame is its
observation; what is kept of a lost track is a sample of its points, so memory is bounded by the number of
tracks, which is bounded itself.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_core.config import SegmenterConfig, TrackingConfig
from rcseg_core.errors import ConfigError, InputError
from rcseg_core.result.segmentation import Segmentation
from rcseg_core.tracking.motion import estimate_motion
from rcseg_core.tracking.observation import Observation, observe
from rcseg_core.tracking.prediction import Carried, Overlap, carry
from rcseg_core.tracking.registry import Frame, Registry
from rcseg_core.tracking.tracks import Tracks
from rcseg_core.world import World

Array = NDArray[np.float64]
#: Rows and columns of a rotation may miss unit length and right angles by so much.
RIGID = 1e-3
REFERENCE_WIDTH_PX = 640


class Tracker:
    """Follows surfaces, regions and objects from frame to frame.

    Parameters
    ----------
    config : TrackingConfig, or a SegmenterConfig whose group `tracking` is taken; the defaults if None

    Raises
    ------
    ConfigError
        For anything else.
    """

    def __init__(self, config: TrackingConfig | SegmenterConfig | None = None) -> None:
        if isinstance(config, SegmenterConfig):
            config = config.tracking
        self._config = TrackingConfig() if config is None else config
        if not isinstance(self._config, TrackingConfig):
            raise ConfigError(f"config: expected a TrackingConfig, got {type(config).__name__}")
        self._registry = Registry(self._config)
        self._last: Observation | None = None
        self._stamp_ns = 0
        self._pose, self._into, self._fixed = np.eye(4), np.eye(4), False

    def reconfigure(self, config: TrackingConfig) -> None:
        """Go on with other parameters: all tracks end, and ids go on."""
        self._config = config
        self._registry.reconfigure(config)
        self._last = None

    def update(
        self,
        result: Segmentation,
        stamp_ns: int,
        pose: NDArray[Any] | None = None,
        world: World | None = None,
    ) -> Tracks:
        """Name the labels of the next frame.

        Parameters
        ----------
        result : Segmentation
        stamp_ns : int, nanoseconds; earlier than the last: all tracks end and new ones begin
        pose : (4, 4) the sensor in the fixed frame (of a camera: its optical frame); None: not known
        world : whose objects are followed, where they were found with an up that was told; None: the result's

        Returns
        -------
        Tracks

        Raises
        ------
        InputError
            A pose that is no rigid motion, or a stamp that is no whole number.
        """
        given = None if pose is None else check_pose(pose)
        stamp_ns = check_stamp(stamp_ns)
        width = result.labels.shape[1]
        step = max(1, round(self._config.cell_px * width / REFERENCE_WIDTH_PX))
        seen = observe(result, world or result.world(), step)
        restarted = self._why_anew(seen, stamp_ns, given is not None)
        if restarted:
            self._registry.clear()
            self._last = None
        motion, where, into, margin = self._motion(seen, given, width)
        frame = Frame(seen, stamp_ns, where, step, margin, given is not None)
        over = None if self._last is None else self._carried(self._last, frame, into)
        ids = self._registry.update(frame, self._last, over)
        self._last, self._stamp_ns, self._fixed = seen, stamp_ns, given is not None
        self._pose, self._into = where, into if motion != "start" else np.eye(4)
        home = None if given is not None else np.asarray(np.linalg.inv(where), np.float64)
        return Tracks(
            stamp_ns=stamp_ns,
            surface_ids=ids["surface"],
            region_ids=ids["region"],
            object_ids=ids["object"],
            tracks=self._registry.snapshot(home),
            ended=self._registry.forgotten(),
            motion=motion,
            pose=where,
            fixed=given is not None,
            restarted=restarted,
            images=seen.images,
        )

    def _why_anew(self, seen: Observation, stamp_ns: int, posed: bool) -> str:
        """Why the tracks of the last frame say nothing of this one; "" where they do."""
        if self._last is None:
            return ""
        gap_s = (stamp_ns - self._stamp_ns) / 1e9
        if why := why_apart(gap_s, posed, self._fixed, self._config.max_gap_s):
            return why
        if seen.lens[0] == 0.0 and seen.labels.shape != self._last.labels.shape:
            return "another grid"
        return ""

    def _motion(
        self, seen: Observation, given: Array | None, width: int
    ) -> tuple[str, Array, Array, int]:  # fmt: skip
        """What tells the motion, the sensor in the fixed frame, the motion of points from the last sensor
        frame into this one, and the margin around them, px."""
        if self._last is None:
            return "start", np.eye(4) if given is None else given, np.eye(4), 0
        config, xyz = self._config, self._last.points.xyz
        if given is not None:
            into = np.asarray(np.linalg.inv(given) @ self._pose, np.float64)
            sigma = np.sqrt(2.0) * config.pose_sigma_m, np.sqrt(2.0) * config.pose_sigma_rad
            if min(sigma) > 0.0:  # the surfaces know the small motion better
                into = estimate_motion(xyz, seen, [into], sigma)[0]
            return "pose", given, into, 0
        into, held, covariance = estimate_motion(xyz, seen, [np.eye(4), self._into])
        where = np.asarray(self._pose @ np.linalg.inv(into), np.float64)
        self._registry.drift(where, covariance)
        margin = 0 if held else round(config.margin_px * width / REFERENCE_WIDTH_PX)
        return ("surfaces" if held else "pixels"), where, into, margin

    def _carried(self, last: Observation, frame: Frame, into: Array) -> Overlap:
        """How the regions of the last frame lie over those of this one."""
        points = last.points
        return carry(
            Carried(points.xyz, points.pixel, points.weight, points.region, last.count("region")), into,
            frame.seen, frame.step, self._config.depth_tolerance, frame.margin,
        )  # fmt: skip


def why_apart(gap_s: float, posed: bool, was_posed: bool, max_gap_s: float) -> str:
    """Why a frame is not seen as the one after the last; "" where it is.

    Parameters
    ----------
    gap_s : since the last
    posed, was_posed : whether the pose of the frame, and of the last, was told
    """
    if gap_s < 0:
        return f"time went back by {-gap_s:g} s"
    if gap_s > max_gap_s and not posed:
        return f"{gap_s:g} s without a frame, and no pose"
    if posed and not was_posed:
        return "poses came, in a frame of their own"
    return ""


def check_pose(pose: NDArray[Any]) -> Array:
    """A rigid motion as (4, 4) float64.

    Raises
    ------
    InputError
        For anything else.
    """
    made = np.asarray(pose)
    if made.shape != (4, 4) or made.dtype.kind not in "fiu":
        raise InputError(f"pose: expected a (4, 4) array of numbers, got {made.dtype} of shape {made.shape}")
    made = made.astype(np.float64)
    turn = made[:3, :3]
    if not np.isfinite(made).all():
        raise InputError("pose: it has values that are not finite; give None where the pose is not known")
    rigid = (
        np.abs(turn).max() < 1 + RIGID  # else the product may overflow
        and np.abs(turn @ turn.T - np.eye(3)).max() < RIGID
        and np.linalg.det(turn) > 0
    )
    if not rigid or np.abs(made[3] - [0, 0, 0, 1]).max() > RIGID:
        raise InputError("pose: expected a rotation and a translation, the sensor in the fixed frame")
    return made


def check_stamp(stamp_ns: Any) -> int:
    """Whole nanoseconds as an int.

    Raises
    ------
    InputError
        For anything else.
    """
    if isinstance(stamp_ns, bool) or not isinstance(stamp_ns, (int, np.integer)):
        raise InputError(f"stamp_ns: expected whole nanoseconds, got {stamp_ns!r}")
    return int(stamp_ns)
