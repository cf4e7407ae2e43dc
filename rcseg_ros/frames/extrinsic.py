"""Where one sensor stands in another's frame: from parameters, or from the transforms of a robot.

One tree of frames serves recordings and live topics: it takes tf2_msgs/TFMessage as it comes from /tf_static
and /tf, and follows chains of any length in both directions. A fixed transform holds for ever, of a moving
one what lies between the samples before and after the frame's stamp.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rcseg_core.errors import ConfigError

Matrix = NDArray[np.float64]
#: Samples of a moving transform that are kept.
HISTORY = 1000


def rigid(translation: Any, quaternion: Any) -> Matrix | None:
    """(4, 4) transform of a translation in metres and a quaternion x, y, z, w; None for the identity.

    Raises
    ------
    ConfigError
        If the quaternion is zero.
    """
    matrix = _matrix(translation, quaternion)
    if matrix is None:
        raise ConfigError(
            f"input.extrinsic_rotation = {list(quaternion)}: expected a quaternion that is not zero"
        )
    return None if np.allclose(matrix, np.eye(4), atol=1e-12) else matrix


def _matrix(translation: Any, quaternion: Any) -> Matrix | None:
    """(4, 4) transform; None where the numbers are none."""
    if not np.isfinite([*translation, *quaternion]).all() or not np.linalg.norm(quaternion) > 1e-6:
        return None
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    matrix[:3, 3] = translation
    return matrix


def frame_name(frame_id: str) -> str:
    """A frame_id without the leading slash of ROS 1."""
    return frame_id.lstrip("/")


class TransformTree:
    """Frames and where they stand in their parents; any thread may add and look up.

    Parameters
    ----------
    history : samples of a moving transform that are kept; None: all, of a recording
    """

    def __init__(self, history: int | None = HISTORY) -> None:
        self._history = history
        self._lock = threading.Lock()
        self._fixed: dict[str, tuple[str, Matrix]] = {}
        self._moving: dict[str, tuple[str, deque[tuple[int, Matrix]]]] = {}

    def add(self, message: Any, *, fixed: bool) -> None:
        """Take in a TFMessage; transforms that are none (a zero quaternion, NaN) are left out."""
        for stamped in message.transforms:
            t, q = stamped.transform.translation, stamped.transform.rotation
            matrix = _matrix((t.x, t.y, t.z), (q.x, q.y, q.z, q.w))
            parent, child = frame_name(stamped.header.frame_id), frame_name(stamped.child_frame_id)
            if matrix is None or not parent or not child or parent == child:
                continue
            stamp = stamped.header.stamp
            with self._lock:
                if fixed:
                    self._fixed[child] = parent, matrix
                    continue
                known = self._moving.get(child)
                if known is None or known[0] != parent:
                    known = self._moving[child] = parent, deque(maxlen=self._history)
                known[1].append((int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec), matrix))

    def lookup(
        self, target: str, source: str, stamp_ns: int = 0, reach_ns: int | None = None
    ) -> Matrix | None:
        """(4, 4) transform that takes points of the source frame to the target frame; None if none is known.

        Parameters
        ----------
        stamp_ns : where transforms move, that of the frame
        reach_ns : largest time to the nearest sample of a moving transform; None: any
        """
        with self._lock:
            up_source = dict(self._upwards(frame_name(source), stamp_ns, reach_ns))
            for frame, from_target in self._upwards(frame_name(target), stamp_ns, reach_ns):
                if frame in up_source:
                    found: Matrix = np.linalg.inv(from_target) @ up_source[frame]
                    return found
        return None

    def _upwards(self, frame: str, stamp_ns: int, reach_ns: int | None) -> Iterator[tuple[str, Matrix]]:
        """The frame and all above it, each with the transform from the frame to it."""
        matrix, seen = np.eye(4), set()
        while frame not in seen:
            yield frame, matrix
            seen.add(frame)
            if frame in self._fixed:
                frame, step = self._fixed[frame]
            elif frame in self._moving:
                frame, samples = self._moving[frame]
                if reach_ns is not None and min(abs(s[0] - stamp_ns) for s in samples) > reach_ns:
                    return
                step = at_stamp(samples, stamp_ns)
            else:
                return
            matrix = step @ matrix

    def frames(self) -> list[str]:
        """Names of all frames, sorted."""
        with self._lock:
            links = {**self._fixed, **self._moving}
            return sorted({*links, *(parent for parent, _ in links.values())})


def at_stamp(samples: Sequence[tuple[int, Matrix]], stamp_ns: int) -> Matrix:
    """A moving transform between its samples (stamp, matrix); beyond them the nearest.

    Between two samples the translation is linear and the rotation the shortest one.
    """
    nearest = min(samples, key=lambda sample: abs(sample[0] - stamp_ns))
    other = max(
        (sample for sample in samples if (sample[0] < stamp_ns) != (nearest[0] < stamp_ns)),
        key=lambda sample: -abs(sample[0] - stamp_ns),
        default=nearest,
    )
    if other[0] == nearest[0] or nearest[0] == stamp_ns:
        return nearest[1]
    share = (stamp_ns - nearest[0]) / (other[0] - nearest[0])
    step = nearest[1][:3, :3].T @ other[1][:3, :3]
    turn = share * Rotation.from_matrix(step).as_rotvec()
    made = np.eye(4)
    made[:3, :3] = nearest[1][:3, :3] @ Rotation.from_rotvec(turn).as_matrix()
    made[:3, 3] = (1.0 - share) * nearest[1][:3, 3] + share * other[1][:3, 3]
    return made


def recorded_transforms(recording: Any, range_topic: str, color_topic: str | None) -> TransformTree:
    """The transforms of a recording: the fixed ones, and moving ones where two frames need them.

    Parameters
    ----------
    recording : rcseg_ros.recordings.bag.Recording
    range_topic, color_topic : topics whose messages are to meet in one view
    """
    tree = TransformTree(history=None)
    for message in recording.latched():
        tree.add(message, fixed=True)
    first = [recording.first(topic) for topic in (range_topic, color_topic) if topic is not None]
    one, *others = [str(message.header.frame_id) for message in first if message is not None] or [""]
    if any(tree.lookup(other, one) is None for other in others if frame_name(other) != frame_name(one)):
        for message in recording.latched("/tf"):
            tree.add(message, fixed=False)
    return tree
