"""Which bridges there are, which package each needs, and its import at run time."""

from __future__ import annotations

import importlib
import importlib.util
from dataclasses import dataclass
from typing import Any

from rcseg_core.errors import ConfigError


@dataclass(frozen=True)
class Bridge:
    """Messages of another package on a topic of the node.

    Attributes
    ----------
    topic : below the node's own name
    type : type name of its messages
    latched : whether who subscribes later is given the latest message too
    """

    topic: str
    type: str
    latched: bool = False

    @property
    def package(self) -> str:
        return self.type.split("/")[0]


#: By the name of the parameter `bridges.NAME` that turns them on.
BRIDGES: dict[str, tuple[Bridge, ...]] = {
    "vision_msgs": (
        Bridge("detections", "vision_msgs/msg/Detection3DArray"),
        Bridge("label_info", "vision_msgs/msg/LabelInfo", latched=True),
    ),
    "moveit_msgs": (Bridge("collision_objects", "moveit_msgs/msg/CollisionObject"),),
    "convex_plane_decomposition_msgs": (
        Bridge("planar_terrain", "convex_plane_decomposition_msgs/msg/PlanarTerrain"),
    ),
}


def available(package: str) -> bool:
    """Whether a package of messages is installed."""
    return importlib.util.find_spec(package) is not None


def load(bridge: Bridge) -> Any:
    """The class of a bridge's messages.

    Raises
    ------
    ConfigError
        If its package is not installed.
    """
    package, _, name = bridge.type.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        raise ConfigError(
            f"bridges.{package}: {bridge.type} is not installed; "
            f"install it (apt install ros-$ROS_DISTRO-{package.replace('_', '-')}, or build it from source), "
            "or leave this bridge out"
        ) from None
