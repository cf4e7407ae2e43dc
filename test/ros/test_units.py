"""Units from the command line to the frame: what is refused names the option, and the option works."""

import json

import cv2
import numpy as np
import pytest
from recordings import (
    COLOR,
    DEPTH,
    INFO,
    Entry,
    cloud_entries,
    depth_entries,
    head,
    info_message,
    scene,
    stamps,
    write_folder,
)
from test_bad_input import npz, refused  # noqa: F401
from test_depth_images import quantised, rvl

from rcseg_ros.cli import main
from rcseg_ros.commands.segment_one import read_npz
from rcseg_ros.frames.conversions import decode_cloud
from rcseg_ros.frames.reading import Reading
from rcseg_ros.recordings.bag import Recording
from rcseg_ros.recordings.recorded import find_sources
from rcseg_ros.recordings.result_bag import make_message
from rcseg_ros.results.outputs import depth_message


def in_millimetres(entries):
    """The depth of a recording as 32FC1 in millimetres."""
    for i, stamp in enumerate(stamps(len(entries) // 3)):
        depth = depth_message(1000 * scene(i).depth_m, head(stamp), make_message)
        (entry,) = (e for e in entries if e.topic == DEPTH and e.log_ns == stamp)
        entry.message.data = depth.data
    return entries


def test_a_recording_in_millimetres_is_refused_and_read_with_its_unit(refused, tmp_path, monkeypatch):  # noqa: F811
    bag = write_folder(tmp_path / "in", in_millimetres(depth_entries(2)))
    error = refused("replay", bag)
    assert "read as metres" in error and "--depth-unit" in error and "0.001" in error
    assert main(["replay", str(bag), "-o", "out", "--depth-unit", "0.001", "--outputs", "labels"]) == 0
    found = json.loads((tmp_path / "work" / "out" / "metrics.json").read_text())["frames"]
    true_m = float(np.median(scene(0).depth_m[scene(0).valid]))
    assert found[0]["noise"]["median_depth_m"] == pytest.approx(true_m, rel=0.3)
    assert found[0]["valid_share"] == pytest.approx(scene(0).valid.mean())


def test_the_limit_of_the_median_is_an_option(refused, tmp_path):  # noqa: F811
    bag = write_folder(tmp_path / "in", depth_entries(1))
    assert "beyond the 0.5 m of input.max_depth" in refused("replay", bag, "--max-depth", "0.5")
    clouds = write_folder(tmp_path / "clouds", cloud_entries(1))
    assert "cloud, from its middle: read as metres" in refused("replay", clouds, "--max-depth", "0.01")


def test_arrays_in_millimetres_are_refused_and_read_with_their_unit(refused, tmp_path):  # noqa: F811
    frame = scene(0)
    depth = npz(tmp_path / "d.npz", depth=1000 * frame.depth_m, color=frame.color, K=frame.camera.matrix())
    points = npz(tmp_path / "p.npz", points=1000 * frame.points, color=frame.color)
    for path in (depth, points):
        error = refused("segment", path, "-o", f"out_{path.stem}")
        assert path.name in error and "--depth-unit" in error
    whole = npz(tmp_path / "w.npz", color=frame.color, K=frame.camera.matrix(),
                depth=np.nan_to_num(1000 * frame.depth_m).astype(np.uint16))  # fmt: skip
    assert main(["segment", str(whole), "-o", "out_w"]) == 0
    for path in (depth, points):
        assert main(["segment", str(path), "-o", f"out_{path.stem}", "--depth-unit", "0.001"]) == 0
        regions = json.loads((tmp_path / "work" / f"out_{path.stem}" / "regions.json").read_text())
        assert regions["regions"][0]["centroid_m"][2] < 10


def test_the_limit_of_the_median_is_an_option_of_segment_too(refused, tmp_path):  # noqa: F811
    frame = scene(0)
    file = npz(tmp_path / "d.npz", depth=frame.depth_m, color=frame.color, K=frame.camera.matrix())
    assert "beyond the 0.5 m of input.max_depth" in refused("segment", file, "--max-depth", "0.5")


@pytest.mark.parametrize("kind", ["depth", "points"])
def test_whole_numbers_of_points_take_their_unit(tmp_path, kind):
    """A unit of 0.001 must not become the whole number 0."""
    frame = scene(0)
    values = {"depth": frame.depth_m, "points": frame.points}[kind]
    whole = np.nan_to_num(1000 * values).round().astype(np.int32)
    file = npz(tmp_path / "w.npz", **{kind: whole}, color=frame.color, K=frame.camera.matrix())
    read = read_npz(file, Reading(depth_unit_m=0.001))
    np.testing.assert_allclose(read.points[frame.valid], frame.points[frame.valid], atol=0.002)
    (source,) = find_sources(file, reading=Reading(depth_unit_m=0.001))
    (found,) = source.read()
    np.testing.assert_allclose(found.frame.points[frame.valid], frame.points[frame.valid], atol=0.002)
    assert not found.frame.valid[~frame.valid].any()


def test_evaluate_reads_units_as_segment_and_replay_do(refused, tmp_path):  # noqa: F811
    frame = scene(0)
    arrays = {"color": frame.color, "K": frame.camera.matrix()}
    floats = npz(tmp_path / "f.npz", depth=1000 * frame.depth_m, **arrays)
    points = npz(tmp_path / "p.npz", points=1000 * frame.points, color=frame.color)
    bag = write_folder(tmp_path / "in", in_millimetres(depth_entries(1)))
    for path in (floats, points, bag):
        error = refused("evaluate", path, "--tables-only")
        assert path.name in error and "--depth-unit" in error and "metres" in error
        (source,) = find_sources(path, reading=Reading(depth_unit_m=0.001))
        (found,) = source.read()
        np.testing.assert_allclose(found.frame.depth_m[frame.valid], frame.depth_m[frame.valid], rtol=1e-4)
    whole = np.nan_to_num(1000 * frame.depth_m).round().astype(np.uint16)
    whole[0, 0] = 65535  # saturated
    (found,) = find_sources(npz(tmp_path / "w.npz", depth=whole, **arrays))[0].read()
    assert not found.frame.valid[0, 0] and np.nanmedian(found.frame.depth_m) < 10
    assert main(["evaluate", str(floats), "--tables-only", "--depth-unit", "0.001"]) == 0


def as_drivers_send(frame, stamp):
    """Depth as quantised inverse depth in RVL, colour of twice the size in nv12, camera_info without size."""
    levels, head_of_depth = quantised(frame.depth_m)
    depth = make_message(
        "sensor_msgs/msg/CompressedImage", header=head(stamp), format="32FC1; compressedDepth rvl",
        data=np.frombuffer(head_of_depth + rvl(levels), np.uint8),
    )  # fmt: skip
    big = cv2.resize(frame.color, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
    i420 = cv2.cvtColor(big, cv2.COLOR_RGB2YUV_I420).reshape(-1)
    luma, chroma = np.split(i420, [big.shape[0] * big.shape[1]])
    color = make_message(
        "sensor_msgs/msg/Image", header=head(stamp), height=big.shape[0], width=big.shape[1], encoding="nv12",
        is_bigendian=0, step=0, data=np.concatenate([luma, chroma.reshape(2, -1).T.ravel()]),
    )  # fmt: skip
    messages = {INFO: info_message(stamp, 0, 0), DEPTH: depth, COLOR: color}
    return [Entry(topic, message, stamp) for topic, message in messages.items()]


def test_a_recording_of_transports_that_drivers_use(tmp_path):
    entries = [entry for i, stamp in enumerate(stamps(2)) for entry in as_drivers_send(scene(i), stamp)]
    bag = write_folder(tmp_path / "in", entries)
    out = tmp_path / "out"
    topics = f"range={DEPTH},color={COLOR},camera_info={INFO}"
    assert main(["replay", str(bag), "-o", str(out), "--topics", topics, "--outputs", "reconstruction"]) == 0
    rows = json.loads((out / "metrics.json").read_text())["frames"]
    assert [row["valid_share"] for row in rows] == [pytest.approx(scene(i).valid.mean()) for i in range(2)]
    with Recording(out) as result:
        cloud = decode_cloud(result.first("/rcseg/reconstruction"))
    made = np.isfinite(cloud.points).all(axis=2) & scene(0).valid
    assert made.mean() > 0.5
    off = np.abs(cloud.points - scene(0).points)[made].max(axis=1)
    assert np.median(off) < 0.01
    assert np.median(np.abs(cloud.color.astype(int) - scene(0).color)[made]) < 10
