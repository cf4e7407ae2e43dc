"""`rcseg inspect --track ID`: the life of a track through the frames of a result bag, as a table."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from rcseg_core.errors import InputError
from rcseg_core.tracking import KINDS, STATES
from rcseg_ros.frames.conversions import header_of
from rcseg_ros.recordings.bag import Recording
from rcseg_ros.recordings.result_bag import NAMESPACE

TRACKS_TOPIC = f"{NAMESPACE}/tracks"


def inspect_track(path: Path, track_id: int, console: Console) -> None:
    """Print one row for each frame between the first and the last that knows the track.

    Raises
    ------
    InputError
        If the recording holds no tracks, or not this one.
    """
    with Recording(path) as recording:
        if TRACKS_TOPIC not in recording.topics:
            raise InputError(f"{path}: no topic {TRACKS_TOPIC}; write it with `rcseg replay`")
        most = 0
        rows = []
        for number, array in enumerate(_arrays(recording)):
            for track in array.tracks:
                most = max(most, int(track.id))
                if track.id == track_id:
                    rows.append((number, array, track))
        if not rows:
            raise InputError(f"{path}: no track {track_id}; their ids are 1 to {most}")
        console.print(_table(track_id, rows))
        console.print(_summary(rows))


def _arrays(recording: Recording) -> Iterator[Any]:
    for raw in recording.messages([TRACKS_TOPIC]):
        yield recording.decode(raw)


def _table(track_id: int, rows: list[Any]) -> Table:
    kind = KINDS[rows[0][2].kind - 1]
    table = Table(title=f"track {track_id}, a {kind}", title_justify="left")
    for name in ("frame", "stamp [s]", "state", "label", "seen", "parent", "merged into", "motion", "shape"):
        table.add_column(name, justify="left" if name in ("state", "motion", "shape") else "right")
    for number, array, track in rows:
        table.add_row(
            str(number),
            f"{header_of(array).stamp_ns / 1e9:.3f}",
            STATES[track.state - 1],
            str(track.label or ""),
            f"{track.seen}/{track.age}",
            str(track.parent or ""),
            str(track.merged_into or ""),
            array.motion,
            _shape(track),
        )
    return table


def _shape(track: Any) -> str:
    """The fused shape in a few words, one sigma of its offset or radius after +-."""
    for plane in track.plane:
        at, error = plane.pose.position, _sigma(plane, 3, 2)
        return f"plane at ({at.x:.3f} {at.y:.3f} {at.z:.3f}), offset +- {1e3 * error:.2g} mm"
    for name, size in (("sphere", 4), ("cylinder", 5)):
        for form in getattr(track, name):
            return f"{name}, radius {form.radius:.4f} +- {_sigma(form, size, size - 1):.2g} m"
    return ""


def _sigma(form: Any, size: int, index: int) -> float:
    total = np.reshape(form.covariance, (size, size)) + np.reshape(form.systematic, (size, size))
    return float(np.sqrt(total[index, index]))


def _summary(rows: list[Any]) -> str:
    frame = rows[-1][1].header.frame_id
    where = "the fixed frame" if rows[-1][1].fixed else "the sensor's frame"
    return f"{rows[-1][2].seen} frames show it; shapes in {where} ({frame or 'no name'}), metres"
