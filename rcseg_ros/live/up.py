"""What the node hears of up: moving transforms and an IMU, from when `world.up_from` asks for them.

The callbacks run on the executor's thread and only remember; the worker asks for the up of its frame, and
what a frame's world says of it goes into the diagnostics.
"""

from __future__ import annotations

from typing import Any

from rclpy.node import Node
from sensor_msgs.msg import Imu

from rcseg_core.world import World
from rcseg_ros.frames.up import Told, UpSettings, UpSource, up_complaint, up_values
from rcseg_ros.live.health import Health
from rcseg_ros.live.hearing import Complaint
from rcseg_ros.live.subscriptions import AdaptiveSubscription
from rcseg_ros.live.transforms import TransformListener


class UpListener:
    """The up of a node's frames; subscribes when it is first asked to.

    Parameters
    ----------
    transforms : those that the node hears
    """

    def __init__(self, node: Node, settings: UpSettings, transforms: TransformListener, depth: int) -> None:
        self._node = node
        self._depth = depth
        self._transforms = transforms
        self._imu: AdaptiveSubscription | None = None
        self.complaint: Complaint | None = None
        self.source = UpSource(settings, transforms.tree)

    def review(self, up_from: str) -> None:
        """Once a second: hear what `world.up_from` asks for.

        Raises
        ------
        ConfigError
            If that is a transform, and tf2_msgs is not installed.
        """
        if up_from in ("tf", "imu"):
            self._transforms.hear_moving(required=up_from == "tf")
        if up_from == "imu" and self._imu is None:
            self._imu = AdaptiveSubscription(self._node, Imu, "imu", self.source.imu.add, "auto", self._depth)
        if self._imu is not None:
            self._imu.review()

    def judge(self, world: World, told: Told, health: Health) -> None:
        """Note what a frame's world says of up, and what is wrong with it."""
        for name, text in up_values(world).items():
            health.note(name, text)
        found = up_complaint(world, told, self.source.settings)
        self.complaint = None if found is None else Complaint(*found)

    def destroy(self) -> None:
        if self._imu is not None:
            self._imu.destroy()


def settings_of(parameters: Any) -> UpSettings:
    """The parameters `up.*` of a node."""
    return UpSettings(parameters["up.frame"], parameters["up.imu_from"], parameters["up.imu_low_pass"])
