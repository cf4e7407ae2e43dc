"""More targets of hostile inputs, as in fuzzing.py: what is made of results, and the files of runs.

World and polygons, tracking, tables, and the files by which `rcseg batch` knows what is done.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import recordings
import shapely
from fuzzing import DEPTHS, FLOATS, Target, damaged_bytes, damaged_text, frames, or_refused
from hypothesis import strategies as st

from rcseg_core import RangeColorFrame, Segmentation, SegmenterConfig, segment
from rcseg_core.tracking import KINDS, Tracker, Tracks
from rcseg_ros.batch.options import BATCH, BatchOptions
from rcseg_ros.batch.run import BatchRequest, plan_batch, run_batch
from rcseg_ros.batch.runners import InlineRunner
from rcseg_ros.batch.work import UNIT
from rcseg_ros.frames.assembly import assemble
from rcseg_ros.frames.conversions import Header
from rcseg_ros.recordings.result_bag import make_message
from rcseg_ros.recordings.segmenting import Segmented, frame_row
from rcseg_ros.recordings.storage import RawMessage
from rcseg_ros.results.made import ResultMessages
from rcseg_ros.tables.parquet import Episode, TableWriter, check_tables, read_labels
from rcseg_ros.tables.rows import frame_tables

numbers = st.sampled_from([*FLOATS, *DEPTHS])
ups = st.none() | st.tuples(numbers, numbers, numbers)


def _segmented(frame: RangeColorFrame | None) -> Segmentation | None:
    return None if frame is None else or_refused(lambda one: segment(one, SegmenterConfig()), frame)


# World and polygons.

worlds = st.tuples(frames(), ups)


def take_world(drawn: tuple[RangeColorFrame | None, tuple[float, float, float] | None]) -> None:
    """Polygons are valid and lie apart from their holes; masks and objects tell of the same pixels."""
    frame, up = drawn
    result = _segmented(frame)
    if result is None:
        return
    world = or_refused(lambda told: result.world(told), None if up is None else np.array(up))
    if world is None:
        return
    shape = result.labels.shape
    assert world.class_mask.shape == shape and ((world.class_mask > 0) <= (result.surface_labels > 0)).all()
    objects = world.object_labels
    assert set(np.unique(objects)) - {0} == {one.label for one in world.objects}
    assert ((objects > 0) <= (result.surface_labels > 0)).all()
    if world.ground is not None:
        assert world.ground.shape == shape and world.ground.max() <= 2
    for surface, boundary in zip(result.surfaces, world.boundaries, strict=True):
        assert not surface.pixel_count or boundary.rings
        for polygon in boundary.polygons:
            assert shapely.is_valid(polygon) and polygon.area >= 0, shapely.is_valid_reason(polygon)
        for distance in (0.0, 1e-3, 1e6):
            inner = surface.polygon_inset(distance)
            assert inner is None or shapely.is_valid(inner)


# Tracking.

poses = st.sampled_from(
    [None, np.eye(4), np.zeros((4, 4)), np.eye(3), np.full((4, 4), np.nan), np.diag([1.0, -1.0, 1.0, 1.0]),
     np.array([[1, 0, 0, 1e9], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]), np.eye(4) * 1e300]
)  # fmt: skip
stamps = st.sampled_from([0, 1, -1, 10**9, 10**9 + 33_000_000, 2**62, -(2**62), 1.5, None])
sequences = st.lists(st.tuples(frames(), stamps, poses), min_size=2, max_size=4)


def take_sequence(drawn: list[tuple[RangeColorFrame | None, Any, Any]]) -> None:
    """Every label has a name of its own, ids are never used again, and what ended is not told of."""
    tracker, ended, largest = Tracker(), set[int](), 0
    for frame, stamp, pose in drawn:
        result = _segmented(frame)
        if result is None:
            continue
        told = _named(tracker, result, stamp, pose)
        if told is None:
            continue
        ids = {track.id for track in told.tracks}
        assert len(ids) == len(told.tracks) and not ids & ended
        ended |= set(told.ended)
        assert not ids & ended
        fresh = [track.id for track in told.tracks if track.age == 1]
        assert not fresh or min(fresh) > largest or told.restarted == "", (fresh, largest)
        largest = max([largest, *ids])
        for kind in KINDS:
            own = told.ids(kind)
            assert own[0] == 0 and len(set(own.tolist())) == len(own) and set(own[1:].tolist()) <= ids
            assert (told.labels(kind) > 0).sum() == (told.images[kind] > 0).sum()


def _named(tracker: Tracker, result: Segmentation, stamp: Any, pose: Any) -> Tracks | None:
    return or_refused(lambda one: tracker.update(one, stamp, pose), result)


# Tables.

STAMP_NS = 10**9
tables = st.lists(frames(), min_size=1, max_size=3)


def _rows(frame: RangeColorFrame, result: Segmentation) -> Any:
    header = Header(STAMP_NS, "camera")
    row = frame_row(header, 0, frame, result, 0.0)
    row |= {"segment_cpu_ms": 0.0, "camera": _geometry()}
    messages = ResultMessages(header, frame, result, make_message, "")
    return frame_tables(Segmented(RawMessage("/d", STAMP_NS, b""), header, frame, result, row, messages))


@cache
def _geometry() -> dict[str, Any]:
    cloud = recordings.cloud_entries(1)[0].message
    return asdict(assemble(cloud, None, None).geometry)


def take_tables(drawn: list[RangeColorFrame | None]) -> None:
    """Tables are whole, with one row a region, surface and frame; label images come back as they were."""
    made = [(frame, result) for frame in drawn if (result := _segmented(frame)) is not None]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "tables" / "recording=a" / "part=00000"
        writer = TableWriter(out, Episode("a"))
        for number, (frame, result) in enumerate(made):
            writer.add(number, STAMP_NS, _rows(frame, result))
        writer.close()
        rows = check_tables(out)
        assert rows["frames"] == len(made)
        assert rows["regions"] == sum(len(result.regions) for _, result in made)
        assert rows["surfaces"] == sum(len(result.surfaces) for _, result in made)
        found = [labels for _, _, labels in read_labels(Path(folder))]
        for (_, result), labels in zip(made, found, strict=True):
            np.testing.assert_array_equal(labels, result.labels)


# Files of a run.


@cache
def _run() -> dict[str, bytes]:
    """All files of a run over one small recording, by their names below the folder of the inputs."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recordings.write_mcap(folder / "a.mcap", recordings.depth_entries(1))
        request = _request(folder)
        run_batch(request, plan_batch(request), InlineRunner())
        files = [path for path in folder.rglob("*") if path.is_file()]
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def _request(folder: Path) -> BatchRequest:
    given = next(file for file in (folder / "list.txt", folder / "a.mcap") if file.exists())
    return BatchRequest((str(given),), folder / "out", BatchOptions(SegmenterConfig.preset("fast")))


@st.composite
def runs(draw: Any) -> tuple[str, bytes]:
    """A file of a finished run, damaged, or a list of inputs."""
    files = _run()
    texts = ["out/manifest.jsonl", f"out/{BATCH}", next(name for name in files if name.endswith(UNIT))]
    name = draw(st.sampled_from([*texts, *texts, "list.txt", *(n for n in files if n.endswith(".parquet"))]))
    if name == "list.txt":
        return name, draw(damaged_text("a.mcap\n# words\n\na.mcap\n"))
    if name in texts and draw(st.booleans()):
        return name, draw(_json(files[name]))
    return name, draw(damaged_bytes(files[name]))


JSON_VALUES = [None, True, 0, -1, 1.5, 10**30, "", "x", "../..", "/", "\0", [], [[]], [1], {}, {"a": 1}]


@st.composite
def _json(draw: Any, data: bytes) -> bytes:
    """A JSON document with one value replaced, wherever it lies."""
    document = json.loads(data)
    paths = list(_paths(document))
    path, value = draw(st.sampled_from(paths)), draw(st.sampled_from(JSON_VALUES))
    if not path:
        return json.dumps(value).encode()
    inner = document
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return json.dumps(document).encode() + b"\n"


def _paths(document: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Keys of all values of a document, from the outside inwards; () is the whole."""
    yield path
    items = document.items() if isinstance(document, dict) else ()
    for key, value in items:
        yield from _paths(value, (*path, key))


def take_run(drawn: tuple[str, bytes]) -> None:
    """It is planned anew or refused in one line, within its folder; tables are read or refused."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, data in (_run() | dict([drawn])).items():
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_bytes(data)
        planned = or_refused(lambda request: plan_batch(request), _request(folder))
        if planned is not None:
            for task in planned.tasks:
                assert task.folder.resolve().is_relative_to((folder / "out").resolve()), task.folder
            for outcome in planned.done.values():
                assert outcome.frames >= 0 and isinstance(outcome.reason, str)
        for part in (folder / "out" / "tables").glob("*/*"):
            or_refused(check_tables, part)
        or_refused(lambda result: list(read_labels(result)), folder / "out")


TARGETS = {
    "world": Target(worlds, take_world, 40),
    "tracking": Target(sequences, take_sequence, 30),
    "tables": Target(tables, take_tables, 20),
    "run": Target(runs(), take_run, 60),
}
