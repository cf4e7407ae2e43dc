"""The node's own parameters, beside the algorithm's: what it listens to, how it pairs, which QoS it asks for.

One flat list in the form of the core's `describe`, so that one walk declares all of them as ROS parameters
and writes config/default.yaml. Knows no ROS. `python -m rcseg_ros.options` prints that file.
"""

from __future__ import annotations

from typing import Any

from rcseg_core import SegmenterConfig
from rcseg_core.config import PRESETS, Parameter, describe
from rcseg_ros.frames.poses import POSE_SOURCES
from rcseg_ros.frames.reading import DEFAULT_READING
from rcseg_ros.frames.up import IMU_FROM


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
    _option(
        "input.transport", "raw",
        "compressed: CompressedImage on TOPIC/compressed and TOPIC/compressedDepth in place of images",
        choices=("raw", "compressed"),
    ),
    _option(
        "input.depth_unit", DEFAULT_READING.depth_unit_m,
        "of depth images and clouds; 0: millimetres of whole numbers, metres of others (REP 118)",
        "m", 0.0, 1000.0,
    ),
    _option(
        "input.max_depth", DEFAULT_READING.max_depth_m,
        "a frame whose median depth is beyond it is refused: it is in another unit", "m", 0.001, 1e6,
    ),
    _option(
        "input.color_bits", DEFAULT_READING.color_bits,
        "used of 16 in images; 0: as many as the brightest pixel needs", "bits", 0, 16,
    ),
    _option("input.queue", 1, "paired frames that may wait; then the oldest is dropped", "frames", 1, 100),
    _option(
        "input.images", "auto",
        "raw: K and D of camera_info; rectified: P; auto: by the names of topics, and points of clouds",
        choices=("auto", "raw", "rectified"),
    ),
    _option(
        "input.assume_registered", False,
        "range and colour of two frames pair pixel by pixel: the driver has registered them",
    ),
    _option(
        "input.extrinsic_translation", (0.0, 0.0, 0.0),
        "origin of the range's frame seen from the colour camera, to which it is moved", "m", -100.0, 100.0,
    ),
    _option(
        "input.extrinsic_rotation", (0.0, 0.0, 0.0, 1.0),
        "rotation of the range's frame seen from the colour camera, quaternion x, y, z, w", "", -1.0, 1.0,
    ),
    _option("input.use_tf", False, "listen to moving transforms (/tf) too; /tf_static is heard anyway"),
    _option("up.frame", "base_link", "frame whose z axis points up, for world.up_from tf"),
    _option(
        "up.imu_from", "auto",
        "what of the IMU (topic imu) tells up; auto: its orientation where it has one, else its acceleration",
        choices=IMU_FROM,
    ),
    _option("up.imu_low_pass", 0.5, "time constant of the mean over the acceleration", "s", 0.001, 60.0),
    _option("sync.slop_ms", 20.0, "largest difference of stamps in a pair; exact wins", "ms", 0.0, 10000.0),
    _option(
        "sync.offset_ms", 0.0, "what colour stamps are late by; auto measures it where nothing pairs", "ms",
        -1e7, 1e7, choices=("auto",),
    ),
    _option("sync.queue", 10, "messages of a topic that wait for their partner", "messages", 1, 1000),
    _option(
        "qos.reliability", "auto",
        "of the subscriptions; auto: reliable, until a publisher offers only best effort",
        choices=("auto", "reliable", "best_effort"),
    ),
    _option("qos.depth", 5, "history of the subscriptions", "messages", 1, 1000),
    _option("bridges.vision_msgs", False, "publish ~/detections (Detection3DArray) and ~/label_info"),
    _option(
        "bridges.moveit_msgs", False, "publish ~/collision_objects, floor and tables as thin prisms"
    ),
    _option(
        "bridges.convex_plane_decomposition_msgs", False, "publish ~/planar_terrain for footstep planners"
    ),
    _option("bridges.thickness", 0.01, "of the prisms, downwards from the surface", "m", 0.0001, 10.0),
    _option("bridges.gone_after", 2.0, "a prism not seen for so long is removed", "s", 0.0, 3600.0),
    _option("bridges.inset", 0.0, "of the terrain's insets from the boundary: half a foot", "m", 0.0, 10.0),
    _option(
        "tracks.run", "auto", "follow regions; auto: while somebody hears a topic that holds their ids",
        choices=("auto", "always", "never"),
    ),
    _option("tracks.label_images", False, "label images hold ids of tracks (from 1 again after 65535)"),
    _option(
        "tracks.pose_from", "none",
        "what tells the sensor's pose; tf: with input.use_tf; odometry: topic `odom`, and tf to its child",
        choices=POSE_SOURCES,
    ),
    _option("tracks.fixed_frame", "", "frame of poses by tf, map or odom for example; empty: the odometry's"),
    _option("diagnostics.warn_period_s", 10.0, "a rejection is warned of once a period", "s", 0.1, 3600.0),
)  # fmt: skip

# Taken over between two frames; the others build subscriptions and are read at configure.
LIVE_NODE_PARAMETERS = frozenset(
    {
        "input.depth_unit",
        "input.max_depth",
        "input.color_bits",
        "input.queue",
        "diagnostics.warn_period_s",
        "tracks.run",
        "tracks.label_images",
    }
)
READ_ONLY = frozenset({"autostart", "preset"})


def all_parameters(config: SegmenterConfig | None = None) -> list[Parameter]:
    """The node's parameters, then every parameter of the algorithm, in file order."""
    return [*NODE_PARAMETERS, *describe(SegmenterConfig() if config is None else config)]


def allowed(parameter: Parameter) -> str:
    """What a value may be, for people: choices, or bounds with the unit, or words beside numbers."""
    bounds = "" if parameter.low is None else f"{parameter.low} to {parameter.high}"
    return " | ".join(filter(None, [f"{bounds} {parameter.unit}".strip(), *parameter.choices]))


def refusal(parameter: Parameter, value: Any) -> str:
    """Why a value is not one of the node's parameter, or nothing; its type has been checked."""
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if parameter.choices and not (parameter.type is float and number) and value not in parameter.choices:
        return f"{parameter.key} = {value!r}: expected {_expected(parameter)}"
    if parameter.type is tuple and len(value) != len(parameter.default):
        return f"{parameter.key} = {list(value)}: expected {len(parameter.default)} numbers"
    return ""


def _expected(parameter: Parameter) -> str:
    words = ", ".join(parameter.choices)
    return f"one of {words}" if parameter.type is str else f"a number or {words}"


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
        lines.append(f"    {'  ' if prefix else ''}{name}: {yaml_value(parameter.default)}  # {comment}")
    return "\n".join(lines) + "\n"


def yaml_value(value: Any) -> str:
    """A value as YAML and ROS read it back with its type."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        text = repr(value)
        return text if "." in text else text.replace("e", ".0e")  # YAML takes 1e-07 for a text
    if isinstance(value, tuple):
        return "[" + ", ".join(map(yaml_value, value)) + "]"
    return f'"{value}"' if isinstance(value, str) else str(value)


if __name__ == "__main__":
    print(default_yaml(), end="")
