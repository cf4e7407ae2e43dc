"""Where the cloud's frame stands in the camera's: from parameters, or from tf2 where it is installed.

Only clouds that must be projected need it (lidars, unregistered depth). tf2_ros comes with a ROS
installation, not with the wheels, so it is imported when a parameter asks for it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rcseg_core.errors import ConfigError
from rcseg_ros.conversions import MessageError


def rigid(translation: Any, quaternion: Any) -> NDArray[np.float64] | None:
    """(4, 4) transform of a translation in metres and a quaternion x, y, z, w; None for the identity.

    Raises
    ------
    ConfigError
        If the quaternion is zero.
    """
    if not np.linalg.norm(quaternion) > 1e-6:
        raise ConfigError(
            f"input.extrinsic_rotation = {list(quaternion)}: expected a quaternion that is not zero"
        )
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    matrix[:3, 3] = translation
    return None if np.allclose(matrix, np.eye(4), atol=1e-12) else matrix


class TransformListener:
    """The same from tf2, for a node.

    Raises
    ------
    ConfigError
        If tf2_ros is not installed.
    """

    def __init__(self, node: Any) -> None:
        try:
            import rclpy.time
            import tf2_ros
        except ImportError as error:
            raise ConfigError(
                "input.use_tf: tf2_ros is not installed; install it with ROS, or give input.extrinsic_*"
            ) from error
        self._failure = tf2_ros.TransformException
        self._buffer = tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, node)
        self._latest = rclpy.time.Time()

    def lookup(self, target: str, source: str) -> NDArray[np.float64] | None:
        """(4, 4) transform from the source to the target frame at the latest time; None if they are one.

        Raises
        ------
        MessageError
            Reason ``no_transform``.
        """
        if target == source:
            return None
        try:
            transform = self._buffer.lookup_transform(target, source, self._latest).transform
        except self._failure as error:
            raise MessageError("no_transform", f"no transform from {source} to {target}: {error}") from error
        t, q = transform.translation, transform.rotation
        return rigid((t.x, t.y, t.z), (q.x, q.y, q.z, q.w))

    def destroy(self) -> None:
        """End the subscriptions to /tf and /tf_static."""
        self._listener.unregister()
