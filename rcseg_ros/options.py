"""The node's own parameters, beside the algorithm's: what it listens to, how it pairs, which QoS it asks for.

One flat list in the form of the core's `describe`, so that one walk declares all of them as ROS parameters
and writes config/default.yaml. Knows no ROS. `python -m rcseg_ros.options` prints that file.
"""

from __future__ import annotations

from typing import Any

from rcseg_core import SegmenterConfig
from rcseg_core.config import PRESETS, Parameter, describe


def _option(
    key: str, default: Any, doc: str, unit: str = "", low: Any = None, high: Any = None, choices: Any = ()
) -> Parameter:
    return Parameter(key, default, default, type(default), unit, low, high, tuple(choices), "", doc)


NODE_PARAMETERS = (
    _option("autostart", True, "configure and activate at start, without a lifecycle manager"),
    _option(
        "preset", "balanced", "of the algorithm's parameters below, where no file or override names them",
        choices=tuple(PRESETS),
    ),
    _option(
        "input.range_from", "auto", "points: PointCloud2; depth: Image (REP 118); auto: what arrives first",
        choices=("auto", "points", "depth"),
    ),
    _option(
        "input.color_from", "auto", "image: topic; cloud: its rgb field; auto: image where one is published",
        choices=("auto", "image", "cloud"),
    ),
    _option(
        "input.camera", "auto",
        "required: wait for camera_info; none: never use it; auto: wait where it is published",
        choices=("auto", "required", "none"),
    ),
    _option("input.queue", 1, "paired frames that may wait; then the oldest is dropped", "frames", 1, 100),
    _option(
        "input.extrinsic_translation", (0.0, 0.0, 0.0),
        "cloud's origin seen from the camera, for clouds that are projected", "m", -100.0, 100.0,
    ),
    _option(
        "input.extrinsic_rotation", (0.0, 0.0, 0.0, 1.0),
        "cloud's rotation seen from the camera, quaternion x, y, z, w", "", -1.0, 1.0,
    ),
    _option("input.use_tf", False, "take the extrinsic from tf2 (where tf2_ros is installed) instead"),
    _option("sync.slop_ms", 20.0, "largest difference of stamps in a pair; exact wins", "ms", 0.0, 10000.0),
    _option("sync.queue", 10, "messages of a topic that wait for their partner", "messages", 1, 1000),
    _option(
        "qos.reliability", "auto",
        "of the subscriptions; auto: reliable, until a publisher offers only best effort",
        choices=("auto", "reliable", "best_effort"),
    ),
    _option("qos.depth", 5, "history of the subscriptions", "messages", 1, 1000),
    _option("diagnostics.warn_period_s", 10.0, "a rejection is warned of once a period", "s", 0.1, 3600.0),
)  # fmt: skip

# Taken over between two frames; the others build subscriptions and are read at configure.
LIVE_NODE_PARAMETERS = frozenset({"input.queue", "diagnostics.warn_period_s"})
READ_ONLY = frozenset({"autostart", "preset"})


def all_parameters(config: SegmenterConfig | None = None) -> list[Parameter]:
    """The node's parameters, then every parameter of the algorithm, in file order."""
    return [*NODE_PARAMETERS, *describe(SegmenterConfig() if config is None else config)]


def allowed(parameter: Parameter) -> str:
    """What a value may be, for people: choices or bounds with the unit."""
    if parameter.choices:
        return " | ".join(parameter.choices)
    bounds = "" if parameter.low is None else f"{parameter.low} to {parameter.high}"
    return f"{bounds} {parameter.unit}".strip()


def default_yaml() -> str:
    """The text of config/default.yaml: a ROS 2 parameter file with every parameter at its default."""
    lines = [
        "# Every parameter of the node rcseg at its default, written by `python -m rcseg_ros.options`.",
        "# Copy what you change; a file need not be complete. Bounds, units and text: `rcseg config`.",
        "# This one, being complete, leaves nothing to a preset: take fast.yaml or accurate.yaml for those.",
        "/**:",
        "  ros__parameters:",
    ]
    group = ""
    for parameter in all_parameters():
        *prefix, name = parameter.key.split(".")
        if prefix and prefix[0] != group:
            group = prefix[0]
            lines.append(f"    {group}:")
        comment = "; ".join(part for part in (parameter.doc, allowed(parameter)) if part)
        lines.append(f"    {'  ' if prefix else ''}{name}: {_yaml_value(parameter.default)}  # {comment}")
    return "\n".join(lines) + "\n"


def _yaml_value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        text = repr(value)
        return text if "." in text else text.replace("e", ".0e")  # YAML takes 1e-07 for a text
    if isinstance(value, tuple):
        return "[" + ", ".join(map(_yaml_value, value)) + "]"
    return f'"{value}"' if isinstance(value, str) else str(value)


if __name__ == "__main__":
    print(default_yaml(), end="")
