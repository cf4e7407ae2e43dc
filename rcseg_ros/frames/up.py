"""Which way is up in a sensor's frame, by what a robot tells: a transform, or an IMU.

One class serves live topics and recordings: both hand it their messages, and ask for the up of a frame by its
stamp. Where none is known the reason stands in its place. What is told from elsewhere (a floor, a parameter)
is the core's own; `world.up_from` of its configuration says which.
"""

from __future__ import annotations

import threading
from bisect import bisect_left
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rcseg_core.world import World
from rcseg_ros.frames.extrinsic import TransformTree, frame_name

Array = NDArray[np.float64]

#: Outputs that need to know where up is.
SILENT = "class_mask, ground_points and obstacle_points"
IMU_FROM = ("auto", "orientation", "acceleration")
GRAVITY = 9.81
#: An averaged acceleration farther than this from gravity, m/s^2, is none at rest, or in another unit.
GRAVITY_SLOP = 1.5
#: IMU samples that are kept, and how far the nearest may be from a frame's stamp.
IMU_HISTORY, IMU_REACH_NS = 2000, 500_000_000


@dataclass(frozen=True)
class UpSettings:
    """How a robot tells which way is up; the parameters `up.*` of the node, options of `rcseg replay`.

    Attributes
    ----------
    frame : frame whose z axis points up, for `world.up_from` tf
    imu_from : "auto" (the orientation where the IMU gives one), "orientation" or "acceleration"
    imu_low_pass_s : time constant of the low pass over the acceleration
    """

    frame: str = "base_link"
    imu_from: str = "auto"
    imu_low_pass_s: float = 0.5


@dataclass(frozen=True)
class Told:
    """What is told of up in a frame.

    Attributes
    ----------
    vector : (3,) float64 unit vector in the frame of the points; None where nothing is told
    source : "tf" or "imu"; "" where nobody was asked, since up comes from elsewhere
    reason : why nothing is told, for people
    """

    vector: Array | None = None
    source: str = ""
    reason: str = ""


NOTHING_TOLD = Told()


def up_of_transform(matrix: Array) -> Array:
    """(3,) up in the sensor's frame, of the (4, 4) transform from there to a frame whose z axis points up."""
    return _unit(matrix[2, :3])


def up_of_orientation(quaternion: Any) -> Array | None:
    """(3,) up in the IMU's frame, of its orientation x, y, z, w in a frame whose z axis points up."""
    q = np.asarray(quaternion, np.float64)
    if not np.isfinite(q).all() or not np.linalg.norm(q) > 1e-6:
        return None
    return np.asarray(Rotation.from_quat(q).as_matrix()[2])


def _unit(vector: Any) -> Array:
    v = np.asarray(vector, np.float64)
    return v / np.linalg.norm(v)


class ImuFilter:
    """Up in an IMU's frame over time, from its orientation or from its low-passed acceleration.

    At rest an accelerometer measures what holds it against gravity, so its acceleration points up (REP 145).
    """

    def __init__(self, settings: UpSettings, history: int | None = IMU_HISTORY) -> None:
        self._history = history
        self._from = settings.imu_from
        self._time_s = settings.imu_low_pass_s
        self._lock = threading.Lock()
        self._mean: tuple[int, Array] | None = None
        self._stamps: list[int] = []
        self._ups: list[Array] = []
        self.frame_id = ""
        self.complaint = "no message of the IMU yet"

    def add(self, message: Any) -> None:
        """Take in a sensor_msgs/Imu; one that tells nothing leaves its reason in `complaint`."""
        stamp = message.header.stamp
        stamp_ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
        with self._lock:
            up, self.complaint = self._up_of(message, stamp_ns)
            if up is not None:
                if self._stamps and stamp_ns < self._stamps[-1]:
                    self._forget(len(self._stamps))  # time went back, as when a bag loops
                self._stamps.append(stamp_ns)
                self._ups.append(up)
                if self._history is not None and len(self._stamps) > 2 * self._history:
                    self._forget(self._history)
                self.frame_id = str(message.header.frame_id)

    def at(self, stamp_ns: int) -> Array | None:
        """(3,) up in the IMU's frame of the sample nearest in time; None where none is near."""
        with self._lock:
            if not self._stamps:
                return None
            after = bisect_left(self._stamps, stamp_ns)
            around = [i for i in (after - 1, after) if 0 <= i < len(self._stamps)]
            near = min(around, key=lambda i: abs(self._stamps[i] - stamp_ns))
            if abs(self._stamps[near] - stamp_ns) > IMU_REACH_NS:
                lag_s = (stamp_ns - self._stamps[near]) / 1e9
                self.complaint = (
                    f"the nearest IMU message is {lag_s:+.1f} s from the frame: are the clocks one?"
                )
                return None
            return self._ups[near]

    def _forget(self, count: int) -> None:
        del self._stamps[:count], self._ups[:count]

    def _up_of(self, message: Any, stamp_ns: int) -> tuple[Array | None, str]:
        told = float(message.orientation_covariance[0]) != -1.0
        q = message.orientation
        if self._from == "orientation" or (self._from == "auto" and told):
            up = up_of_orientation((q.x, q.y, q.z, q.w)) if told else None
            if up is not None or self._from == "orientation":
                return up, "" if up is not None else "the IMU gives no orientation"
        return self._of_acceleration(message.linear_acceleration, stamp_ns)

    def _of_acceleration(self, acceleration: Any, stamp_ns: int) -> tuple[Array | None, str]:
        measured = np.array([acceleration.x, acceleration.y, acceleration.z], np.float64)
        if not np.isfinite(measured).all():
            return None, "the IMU's acceleration is not finite"
        mean = measured
        if self._mean is not None and stamp_ns >= self._mean[0]:
            since_s = (stamp_ns - self._mean[0]) / 1e9
            mean = measured + np.exp(-since_s / self._time_s) * (self._mean[1] - measured)
        self._mean = stamp_ns, mean
        size = float(np.linalg.norm(mean))
        if abs(size - GRAVITY) > GRAVITY_SLOP:
            return None, f"the IMU's mean acceleration is {size:.2f} m/s^2, not gravity's 9.81"
        return mean / size, ""


class UpSource:
    """What a robot tells of up, frame by frame.

    Parameters
    ----------
    transforms : of the robot; needed for tf, and where an IMU has a frame of its own
    history : samples of the IMU that are kept; None: all, of a recording
    """

    def __init__(
        self,
        settings: UpSettings | None = None,
        transforms: TransformTree | None = None,
        history: int | None = IMU_HISTORY,
    ) -> None:
        self.settings = settings or UpSettings()
        self.transforms = transforms or TransformTree()
        self.imu = ImuFilter(self.settings, history)

    def at(self, up_from: str, frame_id: str, stamp_ns: int) -> Told:
        """Up in the frame of a result; `world.up_from` says who is asked: "tf", "imu", or none of these."""
        if up_from == "tf":
            return self._by_tf(frame_id, stamp_ns)
        return self._by_imu(frame_id, stamp_ns) if up_from == "imu" else NOTHING_TOLD

    def _by_tf(self, frame_id: str, stamp_ns: int) -> Told:
        target = self.settings.frame
        matrix = self.transforms.lookup(target, frame_id, stamp_ns)
        if matrix is not None:
            return Told(up_of_transform(matrix), "tf")
        known = ", ".join(self.transforms.frames()) or "none"
        return Told(None, "tf", f"no transform from {frame_id} to {target} (up.frame); known frames: {known}")

    def _by_imu(self, frame_id: str, stamp_ns: int) -> Told:
        up = self.imu.at(stamp_ns)
        if up is None:
            return Told(None, "imu", self.imu.complaint)
        if frame_name(self.imu.frame_id) == frame_name(frame_id):
            return Told(up, "imu")
        matrix = self.transforms.lookup(frame_id, self.imu.frame_id, stamp_ns)
        if matrix is None:
            return Told(None, "imu", f"no transform from the IMU's frame {self.imu.frame_id} to {frame_id}")
        return Told(_unit(matrix[:3, :3] @ up), "imu")


def up_values(world: World) -> dict[str, str]:
    """Up and the tilt of the floor against it, for diagnostics."""
    if world.up is None:
        return {"world.up": "unknown"}
    x, y, z = world.up.vector
    values = {"world.up": f"{x:.4f} {y:.4f} {z:.4f}", "world.up_from": world.up.source}
    if world.tilt is not None:
        angle, sigma = np.rad2deg([world.tilt.angle_rad, world.tilt.standard_deviation_rad])
        values["world.tilt_deg"] = f"{angle:.2f} +- {sigma:.2f}"
    return values


def up_complaint(world: World, told: Told, settings: UpSettings) -> tuple[str, str] | None:
    """Why outputs are silent, or that the floor contradicts the up that was told: a short name, the words."""
    if world.up is None:
        why = told.reason or {"none": "world.up_from is none", "floor": "no floor is seen"}.get(
            world.config.up_from, "nothing tells it"
        )
        return (
            "up_unknown",
            f"up is unknown, so that {SILENT} are silent: {why}",
        )
    if world.tilt is None or world.tilt.expected:
        return None
    suspect = {
        "tf": f"the transform to {settings.frame} (up.frame)",
        "imu": "the IMU's mounting or its transform",
        "parameter": "world.up_x, up_y, up_z",
    }.get(world.up.source, "what tells up")
    by = f"{up_values(world)['world.tilt_deg']} degrees against up"
    return (
        "up_tilted",
        f"the floor that is seen is tilted by {by}: {suspect} is wrong, or it is no floor",
    )
