"""Up from recordings: what a user says of it in a word; the transforms and IMU messages that tell it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from rcseg_core import SegmenterConfig
from rcseg_core.errors import InputError
from rcseg_ros.frames.extrinsic import TransformTree
from rcseg_ros.frames.up import UpSettings, UpSource

IMU_TYPE = "sensor_msgs/msg/Imu"


@dataclass(frozen=True)
class UpRequest:
    """How the up of a recording is told.

    Attributes
    ----------
    settings : as of the node
    imu_topic : "" takes the one that there is
    """

    settings: UpSettings = field(default_factory=UpSettings)
    imu_topic: str = ""


def parse_up(text: str, config: SegmenterConfig) -> tuple[SegmenterConfig, UpRequest]:
    """The option --up: tf:FRAME, imu, imu:TOPIC, X,Y,Z, floor or none; "" leaves the configuration as it is.

    Raises
    ------
    InputError
        For anything else.
    """
    kind, _, rest = text.partition(":")
    if not text:
        return config, UpRequest()
    if kind == "tf" and rest:
        return config.replace({"world.up_from": "tf"}), UpRequest(UpSettings(frame=rest))
    if kind == "imu":
        return config.replace({"world.up_from": "imu"}), UpRequest(imu_topic=rest)
    if text in ("floor", "none"):
        return config.replace({"world.up_from": text}), UpRequest()
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--up {text}: expected tf:FRAME, imu, imu:TOPIC, X,Y,Z, floor or none") from None
    changes = {"world.up_from": "parameter", "world.up_x": x, "world.up_y": y, "world.up_z": z}
    return config.replace(changes), UpRequest()


def recorded_up(
    recording: Any, range_topic: str, up_from: str, request: UpRequest, transforms: TransformTree
) -> UpSource:
    """What a recording tells of up; to be called before its frames are read.

    Parameters
    ----------
    recording : rcseg_ros.recordings.bag.Recording
    range_topic : the frame of its messages is to be known in the frame that points up
    transforms : of the recording; moving ones are added where they are needed

    Raises
    ------
    InputError
        If an IMU is asked for and there is none.
    """
    source = UpSource(request.settings, transforms, history=None)
    if up_from not in ("tf", "imu"):
        return source
    first = recording.first(range_topic)
    frame_id = "" if first is None else str(first.header.frame_id)
    if up_from == "imu":
        for raw in recording.messages([_imu_topic(recording, request.imu_topic)]):
            source.imu.add(recording.decode(raw))
    target = request.settings.frame if up_from == "tf" else source.imu.frame_id
    if transforms.lookup(target, frame_id) is None:
        for message in recording.latched("/tf"):
            transforms.add(message, fixed=False)
    return source


def _imu_topic(recording: Any, wanted: str) -> str:
    found = sorted(name for name, topic in recording.topics.items() if topic.type == IMU_TYPE)
    if wanted in found or (found and not wanted):
        return wanted or max(found, key=lambda name: recording.topics[name].count)
    known = f"; it has {', '.join(found)}" if found else "; it has no topic of that type"
    raise InputError(f"--up: no {IMU_TYPE} on {wanted or 'any topic'} in {recording.path}{known}")
