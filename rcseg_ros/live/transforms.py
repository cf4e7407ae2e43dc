"""The transforms that a node hears, into the tree that recordings fill as well."""

from __future__ import annotations

from typing import Any

from rcseg_core.errors import ConfigError
from rcseg_ros.frames.extrinsic import TransformTree


class TransformListener:
    """The transforms that a node hears: the fixed ones always, moving ones where a parameter asks for them.

    The messages of /tf_static are latched, so a node that starts late hears them too. Without tf2_msgs, which
    comes with every ROS installation but not with the wheels, nothing is heard.

    Raises
    ------
    ConfigError
        If moving ones are asked for and tf2_msgs is not installed.
    """

    def __init__(self, node: Any, *, moving: bool) -> None:
        self.tree = TransformTree()
        self._node = node
        self._subscriptions: list[Any] = []
        self._message: Any = None
        self._moving = False
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError as error:
            if moving:
                raise ConfigError(
                    "input.use_tf: tf2_msgs is not installed; install it with ROS, or give input.extrinsic_*"
                ) from error
            return
        from rclpy.qos import DurabilityPolicy, QoSProfile

        self._message = TFMessage
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._listen(TFMessage, "/tf_static", latched, fixed=True)
        if moving:
            self.hear_moving(required=True)

    def hear_moving(self, *, required: bool) -> None:
        """Listen to moving transforms too; again is nothing new.

        Raises
        ------
        ConfigError
            If they are required and tf2_msgs is not installed.
        """
        if self._message is None and required:
            raise ConfigError("world.up_from tf: tf2_msgs is not installed; install it with ROS")
        if self._message is not None and not self._moving:
            self._moving = True
            self._listen(self._message, "/tf", 100, fixed=False)

    def _listen(self, kind: Any, topic: str, qos: Any, *, fixed: bool) -> None:
        self._subscriptions.append(
            self._node.create_subscription(
                kind, topic, lambda message: self.tree.add(message, fixed=fixed), qos
            )
        )

    def destroy(self) -> None:
        """End the subscriptions."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
