"""Recorded frames of every kind in one folder: frame folders, .npz files and recordings, one source each.

What a frame folder or an .npz holds is `rcseg_core.datasets`' matter; here recordings are added, read through
the same pairing and conversions as `rcseg replay`, with the truth that bundled recordings carry.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rcseg_core.datasets import REGIONS, LabelledFrame, list_frames, load_frame, matches, no_match
from rcseg_core.errors import InputError
from rcseg_ros.frames.assembly import assemble
from rcseg_ros.frames.conversions import decode_labels
from rcseg_ros.frames.extrinsic import recorded_transforms
from rcseg_ros.frames.point_clouds import check_unit
from rcseg_ros.frames.reading import DEFAULT_READING, Reading
from rcseg_ros.frames.registration import Surroundings
from rcseg_ros.frames.sync import FrameSync, Pair, explain_gap
from rcseg_ros.recordings.bag import RawMessage, Recording
from rcseg_ros.recordings.layout import find_recordings
from rcseg_ros.recordings.topics import TRUTH_TOPICS, InputTopics, find_topics

SLOP_NS = 20_000_000
QUEUE_SIZE = 50


@dataclass(frozen=True)
class Source:
    """One frame, or the frames of one recording that are wanted; `frames` is how many are expected."""

    name: str
    frames: int
    read: Callable[[], Iterator[LabelledFrame]]


def find_sources(dataset: str | Path, pattern: str = "*", reading: Reading = DEFAULT_READING) -> list[Source]:
    """What a data set holds, in the order of names; nothing but the recordings' indices is read yet.

    Parameters
    ----------
    dataset : a frame folder, an .npz file, a recording (.mcap, .db3 or rosbag2 folder), or a folder of such,
        mixed and at any depth
    pattern : glob on the names of frames; those of a recording are NAME/0, NAME/1, ...; NAME takes all
    reading : what the data do not tell of their units

    Raises
    ------
    InputError
        No such path, nothing in it, nothing that matches, or a recording without usable topics.
    """
    root = Path(dataset)
    recordings = find_recordings(root)
    frames = [] if recordings and recordings[0][1] == root else list_frames(root)
    if not frames and not recordings:
        raise InputError(
            f"{root}: no frame here; a frame is a folder with meta.json and depth.png, an .npz file, "
            "or part of a recording"
        )
    sources = [_single(name, path, reading) for name, path in frames if matches(name, pattern)]
    for name, path in recordings:
        sources += _part_of_recording(name, path, pattern, reading)
    if not sources:
        raise no_match(root, pattern, sorted(name for name, _ in [*frames, *recordings]))
    return sorted(sources, key=lambda source: source.name)


def group_of(name: str) -> str:
    """Data set that a frame is pooled with: its uppermost folder, else the letters its name begins with."""
    folder, slash, _ = name.partition("/")
    if slash:
        return folder
    letters = re.match(r"[^\W\d_]+", name)
    return letters.group() if letters else name


def _single(name: str, path: Path, reading: Reading) -> Source:
    def read() -> Iterator[LabelledFrame]:
        found = load_frame(path, name=name, depth_unit_m=reading.depth_unit_m)
        try:
            check_unit(found.frame.points, reading)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        yield found

    return Source(name, 1, read)


def _part_of_recording(name: str, path: Path, pattern: str, reading: Reading) -> list[Source]:
    """The recording as a source of the frames that match; none when none does."""
    with Recording(path) as recording:
        count = recording.topics[find_topics(recording, {}).range].count
    if matches(name, pattern):
        wanted = set(range(count))
    else:
        wanted = {number for number in range(count) if matches(f"{name}/{number}", pattern)}

    def read() -> Iterator[LabelledFrame]:
        for number, frame in enumerate(read_recording(path, name, reading)):
            if number in wanted:
                yield frame

    return [Source(name, len(wanted), read)] if wanted else []


def read_recording(path: Path, name: str, reading: Reading = DEFAULT_READING) -> Iterator[LabelledFrame]:
    """The frames of a recording, NAME/0, NAME/1, ..., with the truth of the same stamp where it has some.

    Raises
    ------
    InputError
        No usable topics; a message that makes no frame; at its end, a recording that is damaged.
    """
    with Recording(path) as recording:
        inputs = find_topics(recording, {})
        transforms = recorded_transforms(recording, inputs.range, inputs.color)
        around = Surroundings(inputs.range, inputs.color or "", transforms=transforms)
        truth = {
            kind: {raw.stamp_ns: raw for raw in recording.messages([topic])}
            for kind, topic in TRUTH_TOPICS.items()
            if topic in recording.topics
        }
        number = -1
        for number, pair in enumerate(_pairs(recording, inputs)):
            decoded = [
                None if m is None else recording.decode(m)
                for m in (pair.range, pair.color, pair.camera, pair.range_camera)
            ]
            try:
                frame = assemble(*decoded, around, reading).frame
            except InputError as error:
                raise InputError(f"{path}: frame {number}: {error}") from error
            found = {kind: _truth(recording, raws.get(pair.stamp_ns)) for kind, raws in truth.items()}
            surfaces = found.get("surface_labels")
            regions = found.get("labels", surfaces)
            yield LabelledFrame(f"{name}/{number}", frame, regions, REGIONS, surface_truth=surfaces)
        if recording.damage:
            raise InputError(f"{path}: damaged: {'; '.join(recording.damage)}")
        if number < 0:
            raise InputError(f"{path}: no frame: {_why_none(recording, inputs)}")


def _why_none(recording: Recording, inputs: InputTopics) -> str:
    topics = [topic for topic in (inputs.range, inputs.color) if topic is not None]
    stamps = [[raw.stamp_ns for raw in recording.messages([topic])] for topic in topics]
    words = explain_gap(stamps[0], stamps[-1], SLOP_NS)
    return f"nothing of {' met anything of '.join(topics)} within {SLOP_NS / 1e6:g} ms; {words}"


def _truth(recording: Recording, raw: RawMessage | None) -> NDArray[np.int32] | None:
    return None if raw is None else decode_labels(recording.decode(raw))


def _pairs(recording: Recording, inputs: InputTopics) -> Iterator[Pair]:
    sync = FrameSync(
        slop_ns=SLOP_NS,
        queue_size=QUEUE_SIZE,
        with_color=inputs.color is not None,
        needs_camera=inputs.camera_info is not None,
        needs_range_camera=lambda pair: inputs.range_camera_info is not None,
    )
    add = sync.by_topic(inputs.range, inputs.color, inputs.camera_info, inputs.range_camera_info)
    for info in (inputs.camera_info, inputs.range_camera_info):
        for raw in islice(recording.messages([info or ""]), 1):
            add[info](raw.stamp_ns, raw)  # one that was sent once holds for the frames before it too
    for raw in recording.messages(inputs.names()):
        yield from add[raw.topic](raw.stamp_ns, raw)
    yield from sync.flush()
