"""A run over many recordings: whole units or none, resumed where it stopped, every fault named."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recordings import COLOR, DEPTH, depth_entries, scene, stamps, write_folder, write_mcap, write_sqlite

pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install 'rcseg[test]'")

from rcseg_core import InputError, SegmenterConfig, segment
from rcseg_ros.batch.inputs import digest, find_inputs
from rcseg_ros.batch.manifest import ALWAYS, MANIFEST, cut, read_manifest
from rcseg_ros.batch.options import BatchOptions
from rcseg_ros.batch.run import BatchRequest, plan_batch, run_batch
from rcseg_ros.batch.runners import InlineRunner
from rcseg_ros.batch.work import WORK, Outcome
from rcseg_ros.cli import main
from rcseg_ros.commands.replay import ReplayRequest, replay
from rcseg_ros.tables.parquet import open_table, read_labels
from rcseg_ros.tables.schema import TABLES, columns

CONFIG = SegmenterConfig()


def rows_of(result, table):
    """All rows of a table in the order of frames, without what every run measures anew."""
    names = [column.name for column in columns(table) if not column.varies]
    rows = open_table(result, table).to_table(columns=names).to_pylist()
    return sorted(rows, key=lambda row: (row["recording"], row["frame_index"]))  # stable: order within stays


def same_tables(one, other):
    for table in TABLES:
        np.testing.assert_equal(rows_of(one, table), rows_of(other, table), err_msg=table)


def run(inputs, output, runner=None, retries=1, shard=(1, 1), **options):
    inputs = [inputs] if isinstance(inputs, (str, Path)) else inputs
    request = BatchRequest(tuple(map(str, inputs)), output, BatchOptions(CONFIG, **options), retries, shard)
    return run_batch(request, plan_batch(request), runner or InlineRunner())


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three good recordings of different kinds."""
    folder = tmp_path_factory.mktemp("recordings")
    write_mcap(folder / "one.mcap", depth_entries(2))
    write_folder(folder / "two", depth_entries(1))
    write_sqlite(folder / "three", depth_entries(2))
    return folder


@pytest.fixture(scope="module")
def done(folder, tmp_path_factory):
    output = tmp_path_factory.mktemp("run") / "out"
    return output, run(folder, output)


def test_every_frame_of_every_recording_is_in_the_tables(done, folder):
    output, summary = done
    assert summary.frames == 5 and not summary.faulty and len(summary.new) == 3
    frames = rows_of(output, "frames")
    assert [(row["recording"], row["frame_index"]) for row in frames] == [
        ("one", 0), ("one", 1), ("three", 0), ("three", 1), ("two", 0)
    ]  # fmt: skip
    assert [row["timestamp"] for row in frames] == [0.0, 0.1, 0.0, 0.1, 0.0]
    assert {row["recording"]: row["episode_index"] for row in frames} == {"one": 0, "three": 1, "two": 2}
    assert not list((output / WORK).iterdir())


def test_labels_are_those_of_segment(done):
    output, _ = done
    for kind in ("labels", "surface_labels"):
        for name, index, labels in read_labels(output, kind=kind):
            expected = getattr(segment(scene(index), CONFIG), kind)
            np.testing.assert_array_equal(labels, expected, err_msg=f"{name} {index}")


def test_regions_and_surfaces_are_those_of_segment(done):
    output, _ = done
    result = segment(scene(1), CONFIG)
    regions = [r for r in rows_of(output, "regions") if (r["recording"], r["frame_index"]) == ("one", 1)]
    assert [row["region"] for row in regions] == [region.label for region in result.regions]
    for row, region in zip(regions, result.regions, strict=True):
        assert (row["pixel_count"], tuple(row["neighbors"])) == (region.pixel_count, region.neighbors)
        np.testing.assert_array_equal(row["range_control_points"], region.range_patch.control_points.ravel())
        np.testing.assert_array_equal(row["normal"], region.normal)
        inside = result.labels == region.label
        np.testing.assert_allclose(row["mean_color"], scene(1).color[inside].mean(axis=0), rtol=1e-6)
    surfaces = [r for r in rows_of(output, "surfaces") if (r["recording"], r["frame_index"]) == ("one", 1)]
    assert [row["kind"] for row in surfaces] == [surface.primitive.kind for surface in result.surfaces]
    for row, surface in zip(surfaces, result.surfaces, strict=True):
        np.testing.assert_array_equal(row["covariance"], surface.local.covariance.ravel())


def test_a_second_run_does_nothing_and_more_recordings_are_added(folder, tmp_path):
    inputs = tmp_path / "in"
    shutil.copytree(folder, inputs)
    run(inputs, tmp_path / "out")
    again = run(inputs, tmp_path / "out")
    assert not again.new and len(again.outcomes) == 3
    write_mcap(inputs / "four.mcap", depth_entries(1))
    more = run(inputs, tmp_path / "out")
    assert more.new == {"four-00000"}
    assert {row["recording"]: row["episode_index"] for row in rows_of(tmp_path / "out", "frames")}[
        "four"
    ] == 3


def test_known_recordings_are_not_opened_again(folder, tmp_path, monkeypatch):
    run(folder, tmp_path / "out")

    def refuse(*_):
        raise AssertionError("opened")

    monkeypatch.setattr("rcseg_ros.batch.manifest.digest", refuse)
    monkeypatch.setattr("rcseg_ros.batch.manifest._parts", refuse)
    assert not run(folder, tmp_path / "out").new


def test_a_recording_that_has_changed_is_done_anew(tmp_path):
    bag = write_mcap(tmp_path / "a.mcap", depth_entries(1))
    run(bag, tmp_path / "out")
    write_mcap(bag, depth_entries(2))
    assert run(bag, tmp_path / "out").frames == 2
    assert len(rows_of(tmp_path / "out", "frames")) == 2
    bag.touch()
    assert not run(bag, tmp_path / "out").new  # touched only


@pytest.mark.parametrize("change", [{"slop_ns": 1}, {"config": CONFIG.replace({"grouping.max_gap": 5})}])
def test_other_options_are_refused_by_name(change, folder, tmp_path):
    run(folder / "two", tmp_path / "out")
    request = BatchRequest((str(folder / "two"),), tmp_path / "out", replace(BatchOptions(CONFIG), **change))
    with pytest.raises(InputError, match=r"other options: (slop_ns|grouping.max_gap) was .*another folder"):
        plan_batch(request)


def test_a_folder_of_something_else_is_left_alone(folder, tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match="is no run of"):
        run(folder, tmp_path)
    assert [one.name for one in tmp_path.iterdir()] == ["thesis.tex"]


def damaged(folder):
    """Recordings with something wrong, and a word of what is told of each."""
    good = write_mcap(folder / "source.mcap", depth_entries(3), chunk_size=4_000).read_bytes()
    words = {}

    def add(name, data, word):
        (folder / name).write_bytes(data)
        words[name.partition(".")[0]] = word

    add("cut.mcap", good[: len(good) * 2 // 3], "readable for")
    flipped = bytearray(good)
    flipped[len(good) // 2] ^= 0xFF
    add("flipped.mcap", bytes(flipped), "nothing after this was read")
    add("empty.mcap", b"", "cannot be read")
    add("text.mcap", b"this is no recording\n" * 50, "cannot be read")
    add("ros1.bag", b"#ROSBAG V2.0\n" + b"\0" * 100, "rosbags-convert")
    write_folder(folder / "blind", [entry for entry in depth_entries(2) if entry.topic != DEPTH])
    words["blind"] = "no "
    (folder / "source.mcap").unlink()
    return words


def test_each_damage_is_named_and_what_is_good_is_kept(folder, tmp_path):
    words = damaged(tmp_path)
    summary = run([folder, tmp_path, tmp_path / "ros1.bag"], tmp_path / "out", retries=1)
    by_name = {name.rpartition("-")[0]: outcome for name, outcome in summary.outcomes.items()}
    assert by_name.keys() == {*words, "one", "two", "three"}
    for name, word in words.items():
        outcome = by_name[name]
        told = outcome.reason or "; ".join(outcome.damage)
        assert word in told and "\n" not in told, (name, told)
        assert outcome.attempt == (2 if outcome.reason else 1)
    assert {one.unit for one in summary.faulty} == {f"{name}-00000" for name in words}
    kept = {row["recording"] for row in rows_of(tmp_path / "out", "frames") if row["rejected"] is None}
    assert kept == {"one", "two", "three", "cut", "flipped"}
    failed = {file.stem for file in (tmp_path / "out" / "failed").iterdir()}
    assert failed == {f"{name}-00000" for name in ("empty", "text", "ros1", "blind")}
    again = run([folder, tmp_path, tmp_path / "ros1.bag"], tmp_path / "out", retries=0)
    assert again.new == failed and {one.unit for one in again.faulty} == {one.unit for one in summary.faulty}


def test_a_message_without_a_result_has_a_row_that_says_why(tmp_path):
    entries = depth_entries(4)
    entries[4].message.data = entries[4].message.data[:100]  # the second depth image
    entries = [entry for entry in entries if (entry.topic, entry.log_ns) != (COLOR, stamps(4)[2])]
    run(write_folder(tmp_path / "in", entries), tmp_path / "out")
    frames = rows_of(tmp_path / "out", "frames")
    assert [row["rejected"] for row in frames] == [None, "truncated_data", "unpaired_range", None]
    assert [row["frame_index"] for row in frames] == [0, 1, 2, 3]
    assert "needs" in frames[1]["error"] and frames[3]["regions"] > 0


@pytest.mark.parametrize("kind", [write_mcap, write_folder])
def test_parts_of_a_long_recording_are_those_of_the_whole(kind, tmp_path):
    bag = kind(tmp_path / "long.mcap", depth_entries(7))
    whole = run(bag, tmp_path / "whole", chunk_s=0)
    parts = run(bag, tmp_path / "parts", chunk_s=0.25)
    assert len(whole.outcomes) == 1 and len(parts.outcomes) == 3
    same_tables(tmp_path / "whole", tmp_path / "parts")


def test_parts_meet_and_begin_with_a_message():
    times = np.array([5, 6, 7, 30, 31, 52])
    parts = cut(times, 10)
    assert [(part.start_ns, part.end_ns, part.first_frame) for part in parts] == [
        (ALWAYS[0], 30, 0), (30, 52, 3), (52, ALWAYS[1], 5)
    ]  # fmt: skip
    assert len(cut(times[:0], 10)) == 1


def test_shards_share_out_all_units(folder, tmp_path):
    for i in (1, 2):
        run(folder, tmp_path / "out", shard=(i, 2))
    assert not run(folder, tmp_path / "out").new
    run(folder, tmp_path / "whole")
    same_tables(tmp_path / "out", tmp_path / "whole")


def test_a_torn_line_of_the_manifest_is_written_again(folder, tmp_path):
    run(folder, tmp_path / "out")
    file = tmp_path / "out" / MANIFEST
    text = file.read_text()
    file.write_text(text[:-40])
    assert len(read_manifest(tmp_path / "out")) == 2
    assert not run(folder, tmp_path / "out").new
    assert [entry.name for entry in read_manifest(tmp_path / "out").values()] == ["one", "three", "two"]


def test_a_unit_that_is_not_whole_is_done_again(folder, tmp_path):
    run(folder, tmp_path / "out")
    part = tmp_path / "out/tables/recording=one/part=00000"
    data = (part / "frames.parquet").read_bytes()
    (part / "frames.parquet").write_bytes(data[:-10])
    assert run(folder, tmp_path / "out").new == {"one-00000"}


def test_recordings_of_one_name_are_told_apart(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_mcap(tmp_path / name / "drive.mcap", depth_entries(1))
    run([tmp_path / "a", tmp_path / "b"], tmp_path / "out")
    names = {row["recording"] for row in rows_of(tmp_path / "out", "frames")}
    assert len(names) == 2 and all(name.startswith("drive") for name in names)


def test_inputs_are_files_folders_patterns_and_lists(folder, tmp_path, monkeypatch):
    (tmp_path / "some.txt").write_text(f"# two of them\n{folder / 'one.mcap'}\n\n{folder / 't*'}\n")
    names = {source.name for source in find_inputs([str(tmp_path / "some.txt")])}
    assert names == {"one", "two", "three"}
    monkeypatch.chdir(folder)
    assert [source.name for source in find_inputs(["*.mcap", "one.mcap", "."])] == ["one", "three", "two"]
    for missing, words in (("absent.mcap", "no such"), ("*.nothing", "nothing matches")):
        with pytest.raises(InputError, match=words):
            find_inputs([missing])
    (tmp_path / "none").mkdir()
    with pytest.raises(InputError, match="no recording"):
        find_inputs([str(tmp_path / "none")])


def test_recordings_at_urls_are_read(folder, tmp_path):
    fsspec = pytest.importorskip("fsspec")
    store = fsspec.filesystem("memory")
    store.put(str(folder / "one.mcap"), "/bucket/one.mcap")
    store.put(str(folder / "two"), "/bucket/two", recursive=True)
    try:
        found = find_inputs(["memory://bucket"])
        assert [source.path for source in found] == ["memory://bucket/one.mcap", "memory://bucket/two"]
        assert [source.size for source in found] == [
            (folder / "one.mcap").stat().st_size,
            sum(file.stat().st_size for file in (folder / "two").iterdir()),
        ]
        assert digest(found[0].path) == digest(str(folder / "one.mcap"))
        assert not run("memory://bucket", tmp_path / "out").faulty
        run([folder / "one.mcap", folder / "two"], tmp_path / "local")
        same_tables(tmp_path / "out", tmp_path / "local")
        store.pipe("/bucket/bad.mcap", b"nothing")
        (fault,) = run("memory://bucket/b*", tmp_path / "bad", retries=0).faulty
        assert fault.reason.startswith("memory://bucket/bad.mcap: cannot be read")
        with pytest.raises(InputError, match="no recording there"):
            find_inputs(["memory://bucket/absent"])
    finally:
        store.rm("/bucket", recursive=True)


def test_bags_hold_what_a_replay_writes(folder, tmp_path):
    from rcseg_ros.recordings.bag import Recording

    run(folder / "one.mcap", tmp_path / "out", bags=True, outputs=("labels", "regions"))
    replay(ReplayRequest(folder / "one.mcap", tmp_path / "replay", CONFIG, outputs=("labels", "regions")))
    bag = tmp_path / "out/tables/recording=one/part=00000/bag"
    with Recording(bag) as one, Recording(tmp_path / "replay") as other:
        assert list(one.messages(one.topics)) == list(other.messages(other.topics))


def test_a_replay_writes_the_same_tables(folder, done, tmp_path):
    replay(ReplayRequest(folder / "one.mcap", tmp_path / "replay", CONFIG, outputs=("labels",), tables=True))
    output, _ = done
    for table in TABLES:
        mine = [row for row in rows_of(output, table) if row["recording"] == "one"]
        np.testing.assert_equal(rows_of(tmp_path / "replay", table), mine)


def test_what_fails_once_is_tried_again(folder, tmp_path):
    class Moody(InlineRunner):
        calls = 0

        def wait(self):
            self.calls += 1
            if self.calls == 1:
                task = self._tasks.pop(0)
                return Outcome(task.unit, "OSError: stale file handle", attempt=task.attempt)
            return super().wait()

    summary = run(folder, tmp_path / "out", Moody())
    assert not summary.faulty and sorted(one.attempt for one in summary.outcomes.values()) == [1, 1, 2]


def test_the_command_says_what_there_is_and_exits_with_3_where_some_failed(folder, tmp_path, capsys):
    (tmp_path / "bad.mcap").write_bytes(b"nothing")
    arguments = ["batch", str(folder / "two"), str(tmp_path / "bad.mcap"), "-o", str(tmp_path / "out")]
    assert main([*arguments, "--dry-run"]) == 0
    assert "2 units" in capsys.readouterr().out and not (tmp_path / "out").exists()
    assert main([*arguments, "--workers", "1"]) == 3
    out = capsys.readouterr().out
    assert "1 units done, 1 failed" in out and "cannot be read" in out
    assert main([*arguments[:2], "-o", str(tmp_path / "out"), "--slop", "7"]) == 2
    assert "slop_ns" in capsys.readouterr().err
    assert main([*arguments, "--shard", "3/2"]) == 2
    assert json.loads((tmp_path / "out" / "batch.json").read_text())["tables"] == 1


def test_tracks_are_those_of_the_tracker(folder, tmp_path):
    from rcseg_core.tracking import Tracker

    run(folder / "one.mcap", tmp_path / "out", tracks=True)
    tracker = Tracker(CONFIG)
    for index, stamp in enumerate(stamps(2)):
        expected = tracker.update(segment(scene(index), CONFIG), stamp)
        for table, kind in (("surfaces", "surface"), ("regions", "region"), ("objects", "object")):
            rows = [row for row in rows_of(tmp_path / "out", table) if row["frame_index"] == index]
            assert [row["track"] for row in rows] == expected.ids(kind)[1:].tolist()
    replay(ReplayRequest(folder / "one.mcap", tmp_path / "replay", CONFIG, tables=True, tracks=True))
    same_tables(tmp_path / "out", tmp_path / "replay")
