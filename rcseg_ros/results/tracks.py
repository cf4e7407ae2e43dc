"""Tracks as rcseg_msgs/TrackArray, and label images that show tracks."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_core.tracking import KINDS, STATES, Track, Tracks
from rcseg_ros.frames.conversions import Header
from rcseg_ros.results.messages import shape_messages
from rcseg_ros.results.outputs import Make, header_message
from rcseg_ros.results.world import pose_message

#: Constants of Track.msg.
KIND_NUMBERS = {kind: number for number, kind in enumerate(KINDS, start=1)}
STATE_NUMBERS = {state: number for number, state in enumerate(STATES, start=1)}
#: Largest id that a 16UC1 image shows; the next one counts from 1 again there.
LAST_16 = 0xFFFF


def track_image(tracks: Tracks, kind: str) -> NDArray[np.int32]:
    """(H, W) int32 of track ids as a 16UC1 image shows them: from 1 again after 65535; 0 unlabelled."""
    ids = tracks.labels(kind)
    return np.where(ids > 0, (ids - 1) % LAST_16 + 1, 0).astype(np.int32)


def track_array(tracks: Tracks, header: Header, fixed_frame: str, make: Make) -> Any:
    """Build the TrackArray of one frame.

    Parameters
    ----------
    header : of the input
    fixed_frame : frame_id that poses were given in; only told where the frame had one
    """
    frame_id = fixed_frame if tracks.fixed else header.frame_id
    return make(
        "rcseg_msgs/msg/TrackArray",
        header=header_message(Header(header.stamp_ns, frame_id), make),
        sensor_frame=header.frame_id,
        fixed=tracks.fixed,
        sensor=pose_message(tracks.pose, make),
        motion=tracks.motion,
        restarted=tracks.restarted,
        tracks=[_track(track, make) for track in tracks.tracks],
        ended=np.array(tracks.ended, np.uint32),
    )


def _track(track: Track, make: Make) -> Any:
    return make(
        "rcseg_msgs/msg/Track",
        kind=KIND_NUMBERS[track.kind],
        state=STATE_NUMBERS[track.state],
        id=track.id,
        label=track.label,
        age=track.age,
        seen=track.seen,
        first_seen=_time(track.first_seen_ns, make),
        last_seen=_time(track.last_seen_ns, make),
        parent=track.parent,
        merged_into=track.merged_into,
        **shape_messages(track.fused, make),
    )


def _time(stamp_ns: int, make: Make) -> Any:
    sec, nanosec = divmod(stamp_ns, 1_000_000_000)
    return make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
