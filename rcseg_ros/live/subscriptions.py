"""Subscriptions that connect to sensor drivers and to `ros2 bag play` alike, and lose as little as each
allows.

A reliable reader gets every large message but never matches a best-effort writer; a best-effort reader
matches both and may lose. So `auto` starts reliable, goes over to best effort when a publisher offers no
more, and back when that one has gone. A latched topic, published once before the node starts, is only handed
to a reader that is transient local, which in turn never matches volatile writers: each kind of writer that is
there gets a reader of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy

from rcseg_ros.live.publishers import OVERRIDABLE

BEST_EFFORT, RELIABLE = ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE
VOLATILE, LATCHED = DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL


class AdaptiveSubscription:
    """One input topic.

    Parameters
    ----------
    node, msg_type, topic, callback : as of `Node.create_subscription`
    reliability : "auto", "reliable" or "best_effort"; the standard qos_overrides parameters win over it
    depth : messages of history
    latched : hear what was published once and latched, too
    """

    def __init__(
        self,
        node: Node,
        msg_type: Any,
        topic: str,
        callback: Callable[[Any], None],
        reliability: str,
        depth: int,
        latched: bool = False,
    ) -> None:
        self._node = node
        self.topic = node.resolve_topic_name(topic)
        overridden = f"qos_overrides.{self.topic}.subscription"
        given = getattr(node, "_parameter_overrides", {})
        self._adapts = reliability == "auto" and f"{overridden}.reliability" not in given
        self._latches = latched and f"{overridden}.durability" not in given
        self._create = lambda qos, options: node.create_subscription(
            msg_type,
            topic,
            callback,
            qos,
            qos_overriding_options=options,
            event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=self._on_incompatible if self._adapts or self._latches else None
            ),
        )
        first = BEST_EFFORT if reliability == "best_effort" else RELIABLE
        self._qos = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=first)
        main = self._create(self._qos, OVERRIDABLE)  # fills the overrides into the profile
        self._subscriptions = {self._qos.durability: main}

    def publishers(self) -> int:
        """Number of publishers of the topic, as far as discovery has seen."""
        return self._node.count_publishers(self.topic)

    def review(self) -> None:
        """Fit reliability and durability to the publishers that are there now."""
        offers = [info.qos_profile for info in self._node.get_publishers_info_by_topic(self.topic)]
        if not offers:
            return
        if self._adapts:
            wanted = BEST_EFFORT if any(o.reliability == BEST_EFFORT for o in offers) else RELIABLE
            if wanted != self._qos.reliability:
                self._go_over(wanted)
        if self._latches:
            self._fit_durability({LATCHED if o.durability == LATCHED else VOLATILE for o in offers})

    def ask_again(self) -> None:
        """Hear again what is latched, as after a time in which nobody listened."""
        if LATCHED in self._subscriptions:
            old = self._subscriptions[LATCHED]
            self._subscriptions[LATCHED] = self._create(self._profile(LATCHED), None)
            self._node.destroy_subscription(old)

    def destroy(self) -> None:
        for subscription in self._subscriptions.values():
            self._node.destroy_subscription(subscription)

    def _fit_durability(self, wanted: set[DurabilityPolicy]) -> None:
        for durability in wanted - self._subscriptions.keys():
            self._subscriptions[durability] = self._create(self._profile(durability), None)
        for durability in self._subscriptions.keys() - wanted:
            self._node.destroy_subscription(self._subscriptions.pop(durability))

    def _go_over(self, reliability: ReliabilityPolicy) -> None:
        best_effort = reliability == BEST_EFFORT
        why = "a publisher offers best effort only" if best_effort else "all publishers are reliable again"
        self._node.get_logger().info(f"{self.topic}: {why}, subscribing so")
        self._qos.reliability = reliability
        old = self._subscriptions
        self._subscriptions = {each: self._create(self._profile(each), None) for each in old}
        for subscription in old.values():
            self._node.destroy_subscription(subscription)

    def _profile(self, durability: DurabilityPolicy) -> QoSProfile:
        return QoSProfile(
            history=self._qos.history,
            depth=self._qos.depth,
            reliability=self._qos.reliability,
            durability=durability,
        )

    def _on_incompatible(self, event: Any) -> None:
        """A publisher offers less reliability: go over at once, before discovery tells of it."""
        asked = self._qos.reliability == RELIABLE and event.last_policy_kind == QoSPolicyKind.RELIABILITY
        if self._adapts and asked:
            self._go_over(BEST_EFFORT)
