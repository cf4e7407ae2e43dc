"""A replay gives what segment() gives, in order, for any number of workers; outputs are whole or absent."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from recordings import (
    COLOR,
    DEPTH,
    POINTS,
    Entry,
    cloud_entries,
    depth_entries,
    head,
    scene,
    stamps,
    write_folder,
    write_mcap,
)

from rcseg_core import InputError, Segmentation, SegmenterConfig, segment
from rcseg_core.compute.parallel import cores, threads
from rcseg_ros.commands.replay import ReplayRequest, replay
from rcseg_ros.frames.conversions import decode_cloud, decode_image, decode_labels, header_of
from rcseg_ros.recordings.bag import Recording
from rcseg_ros.recordings.result_bag import make_message
from rcseg_ros.results.outputs import labels_message

CONFIG = SegmenterConfig()
BAGS = Path(__file__).resolve().parents[2] / "bags"


def run(bag, output, **options):
    return replay(ReplayRequest(bag, output, CONFIG, **options))


def messages(folder, topic):
    with Recording(folder) as recording:
        return [recording.decode(raw) for raw in recording.messages([f"/rcseg/{topic}"])]


@pytest.fixture(scope="module")
def direct():
    return [segment(scene(i), CONFIG) for i in range(3)]


@pytest.fixture(scope="module")
def replayed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("replay")
    summary = run(write_mcap(folder / "in.mcap", depth_entries(3)), folder / "out", overlays=True)
    return folder / "out", summary


def test_labels_equal_those_of_segment_bit_for_bit(replayed, direct):
    out, _ = replayed
    for topic in ("labels", "surface_labels"):
        found = messages(out, topic)
        assert [header_of(m).stamp_ns for m in found] == stamps(3)
        assert {m.header.frame_id for m in found} == {"camera_optical_frame"}
        for message, result in zip(found, direct, strict=True):
            np.testing.assert_array_equal(decode_labels(message), getattr(result, topic))


def test_regions_edges_overlay_and_reconstruction(replayed, direct):
    out, _ = replayed
    for message, result in zip(messages(out, "regions"), direct, strict=True):
        assert [r.label for r in message.regions] == [r.label for r in result.regions]
        patch, expected = message.regions[0].range_patch, result.regions[0].range_patch
        np.testing.assert_array_equal(patch.control_points, np.ravel(expected.control_points))
    for message, result in zip(messages(out, "edges"), direct, strict=True):
        np.testing.assert_array_equal(decode_image(message)[..., 0], result.edges)
    for i, message in enumerate(messages(out, "overlay")):
        picture = cv2.imread(str(out / "overlays" / f"{i:06d}.png"))[..., ::-1]
        np.testing.assert_array_equal(decode_image(message), picture)
    for message, result in zip(messages(out, "reconstruction"), direct, strict=True):
        points, color = result.reconstruct()
        cloud = decode_cloud(message)
        np.testing.assert_array_equal(cloud.points, points)
        np.testing.assert_array_equal(cloud.color, color)


def test_metrics_and_configuration_are_complete(replayed, direct):
    out, _ = replayed
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["totals"]["frames"] == 3 and metrics["damage"] == [] and not metrics["interrupted"]
    assert metrics["topics"]["range"] == DEPTH
    totals = metrics["totals"]
    assert totals["workers"] == cores()  # the default
    assert totals["frames_per_second"] == pytest.approx(3 / totals["seconds"])
    spent_ms = sum(row["segment_cpu_ms" if cores() > 1 else "segment_ms"] for row in metrics["frames"])
    assert totals["segment_only_frames_per_second"] == pytest.approx(cores() * 3e3 / spent_ms)
    for row, result, stamp in zip(metrics["frames"], direct, stamps(3), strict=True):
        assert row["stamp_ns"] == stamp and row["regions"] == len(result.regions)
        assert row["stages_ms"].keys() == dict(result.timings).keys()
        assert row["valid_share"] == pytest.approx(1 - 16 / (48 * 64))
    config = yaml.safe_load((out / "config.yaml").read_text())
    assert SegmenterConfig.from_dict(config) == CONFIG
    assert sorted(p.name for p in out.iterdir()) == [
        "config.yaml", "metadata.yaml", "metrics.json", "out.mcap", "overlays"
    ]  # fmt: skip


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_workers_change_nothing_but_time(workers, replayed, tmp_path):
    out, _ = replayed
    before = threads(), cv2.getNumThreads()
    summary = run(write_mcap(tmp_path / "in.mcap", depth_entries(3)), tmp_path / "more", workers=workers)
    assert (summary.workers, threads(), cv2.getNumThreads()) == (workers, *before)
    with Recording(out) as one, Recording(tmp_path / "more") as more:
        topics = list(one.topics)
        assert list(more.topics) == topics
        assert list(one.messages(topics)) == list(more.messages(topics))


@pytest.mark.parametrize("flat", [False, True])
def test_clouds_that_carry_their_own_colour(flat, tmp_path):
    infos = [entry for entry in depth_entries(2) if "info" in entry.topic]
    bag = write_folder(tmp_path / "in", infos + cloud_entries(2, flat))
    summary = run(bag, tmp_path / "out")
    assert (summary.inputs.range, summary.inputs.color) == (POINTS, None)
    expected = segment(scene(1), CONFIG).labels
    found = decode_labels(messages(tmp_path / "out", "labels")[1])
    # Projection leaves every point in its pixel; only float32 rounding of the rays may differ.
    assert np.mean(found != expected) < 0.01


def test_colour_is_paired_within_the_slop_and_losses_are_counted(tmp_path):
    entries = depth_entries(3)
    for i, offset_ns in enumerate((0, 15_000_000, 40_000_000)):
        color = entries[3 * i + 2]
        color.message.header = head(color.log_ns + offset_ns)
    bag = write_folder(tmp_path / "in", entries)
    summary = run(bag, tmp_path / "out")
    assert [row["color_offset_ns"] for row in summary.frames] == [0, 15_000_000]
    assert {k: v for k, v in summary.dropped.items() if v} == {"unpaired_range": 1, "unpaired_color": 1}
    assert len(run(bag, tmp_path / "wide", slop_ns=50_000_000).frames) == 3


def test_stamps_of_zero_pair_by_the_time_of_recording(tmp_path):
    entries = depth_entries(2)
    for entry in entries:
        entry.message.header = head(0)
    summary = run(write_folder(tmp_path / "in", entries), tmp_path / "out")
    assert len(summary.frames) == 2
    assert [header_of(m).stamp_ns for m in messages(tmp_path / "out", "labels")] == [0, 0]


def test_a_bad_frame_is_left_out_and_counted(tmp_path):
    entries = depth_entries(3)
    entries[4].message.data = entries[4].message.data[:100]
    summary = run(write_folder(tmp_path / "in", entries), tmp_path / "out")
    assert [row["stamp_ns"] for row in summary.frames] == [stamps(3)[0], stamps(3)[2]]
    assert summary.rejected == {"truncated_data": 1} and "needs" in summary.first_error


def test_transforms_pass_through_untouched(tmp_path):
    stamp = stamps(1)[0]
    tf = Entry("/tf_static", make_message("tf2_msgs/msg/TFMessage", transforms=[]), stamp - 5)
    bag = write_folder(tmp_path / "in", [tf, *depth_entries(1)])
    run(bag, tmp_path / "out")
    with Recording(bag) as before, Recording(tmp_path / "out") as after:
        (raw,) = before.messages(["/tf_static"])
        assert list(after.messages(["/tf_static"])) == [raw]
        assert after.topics["/tf_static"].qos[0].durability.name == "TRANSIENT_LOCAL"
        assert after.topics["/tf_static"].type == "tf2_msgs/msg/TFMessage"


def test_recorded_truth_is_compared(tmp_path, direct):
    truth = [
        Entry(f"/truth/{kind}", labels_message(getattr(result, kind), head(stamp), make_message), stamp)
        for result, stamp in zip(direct, stamps(3), strict=True)
        for kind in ("labels", "surface_labels")
    ]
    summary = run(write_folder(tmp_path / "in", depth_entries(3) + truth[:4]), tmp_path / "out")
    for row in summary.frames[:2]:
        for kind in ("labels", "surface_labels"):
            assert row["truth"][kind]["voi_bits"] == pytest.approx(0, abs=1e-9)
            assert row["truth"][kind]["correct"] == row["truth"][kind]["truth_regions"] > 0
    assert "truth" not in summary.frames[2]


def test_only_the_wanted_outputs_and_frames(tmp_path):
    bag = write_folder(tmp_path / "in", depth_entries(3))
    summary = run(bag, tmp_path / "out", outputs=("labels",), max_frames=2)
    assert len(summary.frames) == 2
    with Recording(tmp_path / "out") as recording:
        assert {t.name: t.count for t in recording.topics.values()} == {"/rcseg/labels": 2}


def test_regions_are_described_only_where_somebody_wants_them(tmp_path, monkeypatch):
    def refuse(self):
        raise AssertionError("described for nobody")

    bag = write_folder(tmp_path / "in", depth_entries(1))
    monkeypatch.setattr(Segmentation, "regions", property(refuse))
    outputs = ("labels", "surface_labels", "edges", "overlay", "reconstruction")
    summary = run(bag, tmp_path / "out", outputs=outputs)
    assert summary.frames[0]["regions"] == decode_labels(messages(tmp_path / "out", "labels")[0]).max()


def test_a_fault_in_mid_run_leaves_what_was_finished(tmp_path, monkeypatch):
    calls = []

    def faulty(frame, config):
        calls.append(frame)
        if len(calls) == 3:
            raise RuntimeError("fault")
        return segment(frame, config)

    monkeypatch.setattr("rcseg_ros.recordings.segmenting.segment", faulty)
    with pytest.raises(RuntimeError, match="fault"):
        run(write_folder(tmp_path / "in", depth_entries(3)), tmp_path / "out", workers=1)
    assert len(messages(tmp_path / "out", "labels")) == 2
    assert len(json.loads((tmp_path / "out" / "metrics.json").read_text())["frames"]) == 2
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in", "out"]


def test_a_result_is_replaced_only_by_force_and_only_a_result(tmp_path):
    bag = write_folder(tmp_path / "in", depth_entries(1))
    run(bag, tmp_path / "out")
    before = (tmp_path / "out" / "metrics.json").read_bytes()
    with pytest.raises(InputError, match="--force"):
        run(bag, tmp_path / "out")
    assert (tmp_path / "out" / "metrics.json").read_bytes() == before
    run(bag, tmp_path / "out", force=True, outputs=("labels",))
    assert len(messages(tmp_path / "out", "labels")) == 1
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.tex").write_text("precious")
    for force in (False, True):
        with pytest.raises(InputError, match="no result of rcseg"):
            run(bag, mine, force=force)
    assert (mine / "thesis.tex").read_text() == "precious"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in", "mine", "out"]


def test_a_failed_replacement_keeps_the_old_result(tmp_path):
    run(write_folder(tmp_path / "in", depth_entries(1)), tmp_path / "out")
    empty = write_folder(tmp_path / "bad", [e for e in depth_entries(1) if e.topic == COLOR])
    with pytest.raises(InputError):
        run(empty, tmp_path / "out", force=True)
    assert len(messages(tmp_path / "out", "labels")) == 1


def test_a_preset_that_reduces_loses_no_number(tmp_path):
    """Small regions of the reduced frame may show on no pixel of the full one: messages leave them out."""
    config = SegmenterConfig.preset("fast")
    replay(ReplayRequest(BAGS / "tabletop", tmp_path / "out", config, max_frames=2))
    shown = zip(
        *(messages(tmp_path / "out", t) for t in ("regions", "labels", "surface_labels")), strict=True
    )
    for array, labels, surfaces in shown:
        pixels = [np.bincount(decode_labels(image).ravel()) for image in (labels, surfaces)]
        assert [region.pixel_count for region in array.regions] == pixels[0][1:].tolist()
        assert [surface.pixel_count for surface in array.surfaces] == pixels[1][1:].tolist()
        assert pixels[0][1:].min() > 0 and pixels[1][1:].min() > 0
        parent, height = array.hierarchy.parent, array.hierarchy.height
        assert len(parent) == len(height) >= len(array.regions)
        for node, above in enumerate(parent, start=1):
            assert above == 0 or (above > node and height[above - 1] >= height[node - 1] >= 1)
        inner = np.bincount(parent[parent > 0], minlength=len(parent) + 1)[len(array.regions) + 1 :]
        assert (inner == 2).all(), "every merge joins two"


def test_the_real_laptop_recording_equals_segment(shared_data, tmp_path):
    bag = shared_data / "bag_pcl_kinect_laptop_box"
    for range_from in ("points", "depth"):
        out = tmp_path / range_from
        summary = run(bag, out, range_from=range_from, outputs=("labels",), max_frames=1)
        assert 0.8 < summary.frames[0]["valid_share"] < 0.95
    first, second = (decode_labels(messages(tmp_path / name, "labels")[0]) for name in ("points", "depth"))
    np.testing.assert_array_equal(first, second)


def test_a_camera_info_that_was_recorded_last_holds_for_all_frames(tmp_path):
    entries = depth_entries(60)
    (*_, last) = (entry for entry in entries if "info" in entry.topic)
    bag = write_folder(tmp_path / "in", [e for e in entries if "info" not in e.topic] + [last])
    summary = run(bag, tmp_path / "out", outputs=("labels",))
    assert len(summary.frames) == 60 and not summary.dropped.total()


@pytest.mark.parametrize("late_ms", [700, 2000])
def test_images_of_a_clock_that_is_late_are_told(late_ms, tmp_path):
    """By less than a second they pair exactly, each with one of another moment."""
    entries = depth_entries(30)
    for entry in entries:
        if entry.topic == COLOR:
            entry.message.header = head(entry.log_ns - late_ms * 1_000_000)
    bag = write_folder(tmp_path / "in", entries)
    words = f"those of {COLOR} {late_ms / 1000:.2f} s: if that is by two clocks"
    if late_ms > 1000:
        with pytest.raises(InputError, match=words):
            run(bag, tmp_path / "out")
    else:
        summary = run(bag, tmp_path / "out", outputs=("labels",))
        assert len(summary.frames) == 23 and words in summary.warnings[0]
