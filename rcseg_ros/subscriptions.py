"""Subscriptions that connect to sensor drivers and to `ros2 bag play` alike, and lose as little as each
allows.

A reliable reader gets every large message but never matches a best-effort writer; a best-effort reader
matches both and loses megabyte messages by the half. So `auto` starts reliable, and goes over to best
effort when the middleware reports a publisher that offers no more.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions


class AdaptiveSubscription:
    """One input topic.

    Parameters
    ----------
    node, msg_type, topic, callback : as of `Node.create_subscription`
    reliability : "auto", "reliable" or "best_effort"; the standard qos_overrides parameters win over it
    depth : messages of history
    """

    def __init__(
        self,
        node: Node,
        msg_type: Any,
        topic: str,
        callback: Callable[[Any], None],
        reliability: str,
        depth: int,
    ) -> None:
        self._node = node
        self._create = lambda qos, options: node.create_subscription(
            msg_type,
            topic,
            callback,
            qos,
            qos_overriding_options=options,
            event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=self._on_incompatible if reliability == "auto" else None
            ),
        )
        first = ReliabilityPolicy.BEST_EFFORT if reliability == "best_effort" else ReliabilityPolicy.RELIABLE
        self._qos = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=first)
        self._subscription = self._create(self._qos, QoSOverridingOptions.with_default_policies())
        self.topic = self._subscription.topic_name

    def publishers(self) -> int:
        """Number of publishers of the topic, as far as discovery has seen."""
        return self._node.count_publishers(self.topic)

    def destroy(self) -> None:
        self._node.destroy_subscription(self._subscription)

    def _on_incompatible(self, event: Any) -> None:
        if self._qos.reliability != ReliabilityPolicy.RELIABLE:
            return
        self._node.get_logger().info(f"{self.topic}: a publisher offers best effort only, subscribing so")
        self._qos.reliability = ReliabilityPolicy.BEST_EFFORT
        old, self._subscription = self._subscription, self._create(self._qos, None)
        self._node.destroy_subscription(old)
