"""Recorded frames of every kind in one folder: frame folders, .npz files and recordings, one source each.

What a frame folder or an .npz holds is `rcseg_core.datasets`' matter; here recordings are added, read through
the same pairing and conversions as `rcseg replay`, with the truth that bundled recordings carry.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rcseg_core.datasets import REGIONS, LabelledFrame, list_frames, load_frame, matches, no_match
from rcseg_core.errors import InputError
from rcseg_ros.assembly import assemble_frame
from rcseg_ros.bag import RawMessage, Recording
from rcseg_ros.conversions import decode_labels
from rcseg_ros.replay import TRUTH_TOPICS
from rcseg_ros.sync import FrameSync, Pair
from rcseg_ros.topics import InputTopics, find_topics

SLOP_NS = 20_000_000
QUEUE_SIZE = 50


@dataclass(frozen=True)
class Source:
    """One frame, or the frames of one recording that are wanted; `frames` is how many are expected."""

    name: str
    frames: int
    read: Callable[[], Iterator[LabelledFrame]]


def find_sources(dataset: str | Path, pattern: str = "*") -> list[Source]:
    """What a data set holds, in the order of names; nothing but the recordings' indices is read yet.

    Parameters
    ----------
    dataset : a frame folder, an .npz file, a recording (.mcap or rosbag2 folder), or a folder of such, mixed
        and at any depth
    pattern : glob on the names of frames; those of a recording are NAME/0, NAME/1, ...; NAME takes all

    Raises
    ------
    InputError
        No such path, nothing in it, nothing that matches, or a recording without usable topics.
    """
    root = Path(dataset)
    recordings = _find_recordings(root)
    frames = [] if recordings and recordings[0][1] == root else list_frames(root)
    if not frames and not recordings:
        raise InputError(
            f"{root}: no frame here; a frame is a folder with meta.json and depth.png, an .npz file, "
            "or part of a recording"
        )
    sources = [_single(name, path) for name, path in frames if matches(name, pattern)]
    for name, path in recordings:
        sources += _part_of_recording(name, path, pattern)
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


def _find_recordings(root: Path) -> list[tuple[str, Path]]:
    """Names and paths of the recordings: rosbag2 folders, and .mcap files outside of such."""
    if (root.is_file() and root.suffix == ".mcap") or (root / "metadata.yaml").exists():
        return [(root.stem if root.is_file() else root.absolute().name, root)]
    if not root.is_dir():
        return []
    folders = {path.parent for path in root.rglob("metadata.yaml")}
    files = [path for path in root.rglob("*.mcap") if path.parent not in folders]
    named = [(folder.relative_to(root), folder) for folder in folders]
    named += [(file.relative_to(root).with_suffix(""), file) for file in files]
    return sorted((name.as_posix(), path) for name, path in named)


def _single(name: str, path: Path) -> Source:
    return Source(name, 1, lambda: iter([load_frame(path, name=name)]))


def _part_of_recording(name: str, path: Path, pattern: str) -> list[Source]:
    """The recording as a source of the frames that match; none when none does."""
    with Recording(path) as recording:
        count = recording.topics[find_topics(recording, {}).range].count
    if matches(name, pattern):
        wanted = set(range(count))
    else:
        wanted = {number for number in range(count) if matches(f"{name}/{number}", pattern)}

    def read() -> Iterator[LabelledFrame]:
        for number, frame in enumerate(read_recording(path, name)):
            if number in wanted:
                yield frame

    return [Source(name, len(wanted), read)] if wanted else []


def read_recording(path: Path, name: str) -> Iterator[LabelledFrame]:
    """The frames of a recording, NAME/0, NAME/1, ..., with the truth of the same stamp where it has some.

    Raises
    ------
    InputError
        No usable topics; a message that makes no frame; at its end, a recording that is damaged.
    """
    with Recording(path) as recording:
        inputs = find_topics(recording, {})
        truth = {
            kind: {raw.stamp_ns: raw for raw in recording.messages([topic])}
            for kind, topic in TRUTH_TOPICS.items()
            if topic in recording.topics
        }
        for number, pair in enumerate(_pairs(recording, inputs)):
            decoded = [
                None if m is None else recording.decode(m) for m in (pair.range, pair.color, pair.camera)
            ]
            try:
                frame = assemble_frame(*decoded)
            except InputError as error:
                raise InputError(f"{path}: frame {number}: {error}") from error
            found = {kind: _truth(recording, raws.get(pair.stamp_ns)) for kind, raws in truth.items()}
            surfaces = found.get("surface_labels")
            regions = found.get("labels", surfaces)
            yield LabelledFrame(f"{name}/{number}", frame, regions, REGIONS, surface_truth=surfaces)
        if recording.damage:
            raise InputError(f"{path}: damaged: {'; '.join(recording.damage)}")


def _truth(recording: Recording, raw: RawMessage | None) -> NDArray[np.int32] | None:
    return None if raw is None else decode_labels(recording.decode(raw))


def _pairs(recording: Recording, inputs: InputTopics) -> Iterator[Pair]:
    sync = FrameSync(
        slop_ns=SLOP_NS,
        queue_size=QUEUE_SIZE,
        with_color=inputs.color is not None,
        needs_camera=inputs.camera_info is not None,
    )
    add = {inputs.range: sync.add_range, inputs.color: sync.add_color, inputs.camera_info: sync.add_camera}
    for raw in recording.messages(inputs.names()):
        yield from add[raw.topic](raw.stamp_ns, raw)
    yield from sync.flush()
