"""Bad input: exit code 2, one line on stderr that says what and where, no traceback, nothing half-written."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

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
    write_mcap,
)

from rcseg_core.errors import InputError
from rcseg_ros.cli import main
from rcseg_ros.recordings.bag import Recording
from rcseg_ros.recordings.result_bag import make_message
from rcseg_ros.results.outputs import depth_message, picture_message


@pytest.fixture
def refused(tmp_path, capsys, monkeypatch):
    """Run the command line in an empty folder; return the one line with which it refuses."""
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)

    def run(*arguments, left=()):
        before = sorted(path.name for path in tmp_path.iterdir())
        assert main([str(argument) for argument in arguments]) == 2
        error = capsys.readouterr().err
        assert error.startswith("rcseg: ") and error.count("\n") == 1 and "Traceback" not in error, error
        assert sorted(path.name for path in work.iterdir()) == sorted(left)
        assert sorted(path.name for path in tmp_path.iterdir()) == before
        return error

    return run


@pytest.fixture
def recording(tmp_path):
    """Writer of a recording with the given entries."""
    return lambda entries: write_folder(tmp_path / "in", entries)


def test_missing_file(refused):
    assert "nowhere.mcap: no such file" in refused("replay", "nowhere.mcap", "-o", "out")
    assert "nowhere: no such file" in refused("inspect", "nowhere")
    assert "nowhere.npz: No such file" in refused("segment", "nowhere.npz")
    assert "nowhere.yaml: No such file" in refused("replay", "nowhere.mcap", "-c", "nowhere.yaml")


def test_a_file_that_is_no_recording(refused, tmp_path):
    text = tmp_path / "notes.txt"
    text.write_text("no bag")
    assert "give an .mcap file or a rosbag2 folder" in refused("replay", text)
    (tmp_path / "folder").mkdir()
    assert "neither metadata.yaml nor an .mcap" in refused("replay", tmp_path / "folder")
    rubbish = tmp_path / "rubbish.mcap"
    rubbish.write_bytes(b"rubbish" * 100)
    assert "cannot be read" in refused("replay", rubbish)


@pytest.fixture
def nobody():
    """Permissions as those of a user that owns nothing; root's own pass over all."""
    if os.geteuid():
        yield
        return
    os.seteuid(65534)
    yield
    os.seteuid(0)


@pytest.fixture(params=["file", "folder"])
def closed(request, tmp_path):
    """A recording that may not be read, or whose folder may not be looked into."""
    bag = write_folder(tmp_path / "closed", cloud_entries(1))
    place = bag if request.param == "folder" else next(bag.glob("*.mcap"))
    place.chmod(0)
    yield bag
    place.chmod(0o755)


def test_a_recording_that_may_not_be_read(closed, nobody):
    with pytest.raises(InputError, match=r"closed.*: cannot be read: Permission denied"):
        Recording(closed)


@pytest.mark.parametrize("compression", ["zstd", "none"])
def test_truncated_recording_frames_before_the_damage_are_processed(refused, compression, tmp_path):
    path = write_mcap(tmp_path / "cut.mcap", depth_entries(6), compression)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    error = refused("replay", path, "-o", "out", left=["out"])
    assert "cut.mcap" in error and "before it written to out" in error
    with Recording(tmp_path / "work" / "out") as result:
        assert 1 <= result.topics["/rcseg/labels"].count < 6
        assert result.damage == []


def test_corrupt_recording_frames_before_the_damage_are_processed(refused, tmp_path):
    path = write_mcap(tmp_path / "bad.mcap", depth_entries(6))
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 64] = bytes(64)
    path.write_bytes(data)
    assert "before it written to out" in refused("replay", path, "-o", "out", left=["out"])
    with Recording(tmp_path / "work" / "out") as result:
        assert 1 <= result.topics["/rcseg/labels"].count < 6


def test_damage_before_the_first_frame(refused, tmp_path):
    path = write_mcap(tmp_path / "cut.mcap", depth_entries(2), "none", chunk_size=200)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 8])
    assert "cut.mcap" in refused("replay", path, "-o", "out")


def test_no_matching_topics_lists_what_there_is(refused, recording):
    bag = recording([entry for entry in depth_entries(1) if entry.topic == INFO])
    error = refused("replay", bag)
    assert "no point clouds or depth images" in error and f"{INFO} (sensor_msgs/msg/CameraInfo, 1)" in error


def test_named_topics_that_are_not_there(refused, recording):
    bag = recording(depth_entries(1))
    assert "no topic /depth" in refused("replay", bag, "--topics", "range=/depth")
    assert "expected KEY=TOPIC" in refused("replay", bag, "--topics", "/depth")
    assert "unknown key 'rgb'" in refused("replay", bag, "--topics", f"rgb={COLOR}")
    assert "no point clouds" in refused("replay", bag, "--range-from", "points")
    assert "expected one of auto, points, depth" in refused("replay", bag, "--range-from", "clouds")


def test_cloud_and_image_of_different_size(refused, recording):
    stamp = stamps(1)[0]
    small = Entry(COLOR, picture_message(scene(0).color[:24], head(stamp), make_message), stamp)
    bag = recording([*cloud_entries(1), small])
    error = refused("replay", bag, "--topics", f"color={COLOR}")
    assert "cloud is 64x48 but colour image is 64x24" in error


def test_depth_and_image_of_different_size(refused, recording):
    stamp = stamps(1)[0]
    entries = [entry for entry in depth_entries(1) if entry.topic != DEPTH]
    small = depth_message(scene(0).depth_m[:24], head(stamp), make_message)
    bag = recording([*entries, Entry(DEPTH, small, stamp)])
    assert "depth image is 64x24 but colour image is 64x48" in refused("replay", bag)


def test_unorganised_cloud_without_camera_info(refused, recording):
    assert "unorganised cloud of 3072 points without a camera_info" in refused(
        "replay", recording(cloud_entries(2, flat=True))
    )


def test_depth_without_camera_info_or_colour(refused, recording):
    bag = recording(depth_entries(1))
    assert "depth image without a camera_info" in refused("replay", bag, "--topics", "camera_info=none")
    assert "no colour image" in refused("replay", bag, "--topics", "color=none")


def test_uncalibrated_camera(refused, recording):
    stamp = stamps(1)[0]
    entries = [entry for entry in depth_entries(1) if entry.topic != INFO]
    bag = recording([Entry(INFO, info_message(stamp, k=np.zeros((3, 3))), stamp), *entries])
    assert "K is zero" in refused("replay", bag)


def test_no_valid_pixel(refused, recording):
    entries = depth_entries(2)
    for entry in entries:
        if entry.topic == DEPTH:
            entry.message.data = np.zeros_like(entry.message.data)
    assert "no frame could be segmented: no valid pixel" in refused("replay", recording(entries))


def test_unknown_encoding_and_truncated_data(refused, tmp_path):
    for name, change in {
        "encoding": {"encoding": "jfif"},
        "data": {"data": np.zeros(10, np.uint8)},
    }.items():
        entries = depth_entries(1)
        for field, value in change.items():
            setattr(entries[2].message, field, value)
        error = refused("replay", write_folder(tmp_path / name, entries))
        assert "'jfif' is not a colour encoding" in error or "needs 9216 bytes, got 10" in error


def test_stamps_that_never_meet(refused, recording):
    entries = depth_entries(2)
    for entry in entries:
        if entry.topic == COLOR:
            entry.message.header = head(entry.log_ns + 45_000_000)
    error = refused("replay", recording(entries))
    assert "within 20 ms" in error and "--slop 46" in error and "2 unpaired_range" in error
    assert "45 ms after the range stamp, steadily" in error


def test_stamps_of_two_clocks(refused, recording):
    """Time since the start of the machine beside the time of day: no slop helps."""
    entries = depth_entries(2)
    for i, entry in enumerate(entries):
        if entry.topic == COLOR:
            entry.message.header = head(12_345_000_000 + 100_000_000 * (i // 3))
    error = refused("replay", recording(entries))
    assert "two clocks" in error and "1700000000.000 to 1700000000.100 s" in error
    assert "12.345 to 12.445 s" in error and "a larger slop does not help" in error


def npz(path, **arrays):
    np.savez(path, **arrays)
    return path


GOOD = {"points": np.ones((8, 9, 3), np.float32), "color": np.zeros((8, 9, 3), np.uint8)}


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"points": GOOD["points"][..., 0]}, "expected an array of shape (H, W, 3)"),
        ({"points": GOOD["points"].astype(np.int32)}, "expected float32 or float64 metres, got int32"),
        ({"color": GOOD["color"].astype(np.float32)}, "expected uint8 RGB, got float32"),
        ({"color": GOOD["color"][:7]}, "points are 9x8 and color is 9x7"),
        ({"points": GOOD["points"] * np.nan}, "no valid pixel"),
        ({"K": np.eye(4)}, "expected a (3, 3) camera matrix"),
        ({"K": np.zeros((3, 3))}, "fx and fy must be positive"),
    ],
)
def test_arrays_of_wrong_shape_or_type(refused, tmp_path, changes, message):
    assert message in refused("segment", npz(tmp_path / "frame.npz", **{**GOOD, **changes}), "-o", "out")


def test_archives_without_the_arrays(refused, tmp_path):
    assert "found color" in refused("segment", npz(tmp_path / "a.npz", color=GOOD["color"]))
    depth = npz(tmp_path / "b.npz", color=GOOD["color"], depth=GOOD["points"][..., 0])
    assert "depth needs the camera matrix K" in refused("segment", depth)
    text = tmp_path / "c.npz"
    text.write_text("not an archive")
    assert "c.npz: not an .npz archive" in refused("segment", text)


@pytest.mark.parametrize(
    ("name", "content"),
    [("empty.npz", b""), ("cut.npz", b"PK\x03\x04 and no more"), ("one.npz", b"\x93NUMPY and no more")],
)
def test_files_that_are_no_archive(refused, tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    for command in ("segment", "evaluate"):
        assert f"{name}: not an .npz archive of arrays" in refused(command, tmp_path / name)


def test_a_single_array_is_no_archive(refused, tmp_path):
    np.save(tmp_path / "points.npy", GOOD["points"])
    assert "a single array, saved by np.save" in refused("segment", tmp_path / "points.npy")


def test_every_fault_of_a_frame_names_its_file(refused, tmp_path):
    eight = npz(tmp_path / "eight.npz", color=GOOD["color"], depth=np.ones((8, 9), np.uint8), K=np.eye(3))
    for command in ("segment", "evaluate"):
        assert "eight.npz: depth: expected" in refused(command, eight)
    sizes = npz(tmp_path / "sizes.npz", **{**GOOD, "color": GOOD["color"][:7]})
    assert "sizes.npz: points are 9x8 and color is 9x7" in refused("segment", sizes)
    color, depth = tmp_path / "color.png", tmp_path / "depth.png"
    cv2.imwrite(str(color), np.zeros((7, 9, 3), np.uint8))
    cv2.imwrite(str(depth), np.full((8, 9), 1000, np.uint16))
    options = ("--depth", depth, "--intrinsics", "5,5,4,4")
    assert "depth.png: points are 9x8" in refused("segment", "--color", color, *options)


def test_pictures_that_do_not_fit(refused, tmp_path):
    color, depth, eight = (tmp_path / name for name in ("color.png", "depth.png", "eight.png"))
    cv2.imwrite(str(color), np.zeros((8, 9, 3), np.uint8))
    cv2.imwrite(str(depth), np.full((8, 9), 1000, np.uint16))
    cv2.imwrite(str(eight), np.full((8, 9), 100, np.uint8))
    images = ("segment", "--color", color, "--depth")
    assert "expected four numbers" in refused(*images, depth, "--intrinsics", "5,5,4")
    assert "one channel of 16 bits" in refused(*images, eight, "--intrinsics", "5,5,4,4")
    assert "not a picture" in refused(*images, __file__, "--intrinsics", "5,5,4,4")
    assert "give either FRAME.npz, or" in refused(*images, depth)


@pytest.mark.parametrize(
    "setting, message",
    [
        ("grouping.max_gab=2", "unknown parameter grouping.max_gab; did you mean grouping.max_gap?"),
        ("grouping.max_gap=99", "grouping.max_gap = 99: expected a whole number from 1 to 15 px"),
        ("grouping.max_gap=much", "grouping.max_gap = 'much': expected a whole number from 1 to 15 px"),
        ("grouping.criterion=best", "grouping.criterion = 'best': expected one of"),
        ("grouping.max_gap", "expected group.name=value"),
    ],
)
@pytest.mark.parametrize("command", ["replay", "config"])
def test_parameters(refused, recording, command, setting, message):
    where = ["config"] if command == "config" else ["replay", recording(depth_entries(1))]
    assert message in refused(*where, "--set", setting)


@pytest.mark.parametrize("command", ["replay", "config"])
def test_presets(refused, recording, command):
    where = ["config"] if command == "config" else ["replay", recording(depth_entries(1))]
    text = refused(*where, "--preset", "quick")
    assert "quick" in text and all(name in text for name in ("fast", "balanced", "accurate"))


def test_parameter_files(refused, tmp_path):
    file = tmp_path / "my.yaml"
    for text, message in {
        "grouping: {max_gab: 2}": "my.yaml: unknown parameter grouping.max_gab",
        "grouping: [1, 2]": "my.yaml: grouping: expected a mapping",
        "- a list": "a configuration is a mapping of groups",
        "grouping: {max_gap: [": "not a YAML file",
        "/**: {ros__parameters: {grouping: {max_gap: 99}}}": "my.yaml: grouping.max_gap = 99",
    }.items():
        file.write_text(text)
        assert message in refused("config", "--config", file)


def test_unwritable_output(refused, recording, tmp_path):
    bag = recording(depth_entries(1))
    (tmp_path / "a_file").write_text("")
    assert "a_file: is a file" in refused("replay", bag, "-o", tmp_path / "a_file")
    assert "is not a folder" in refused("replay", bag, "-o", tmp_path / "a_file" / "out")
    assert "cannot write" in refused("config", "--yaml", tmp_path / "nowhere" / "my.yaml")
    frame = npz(tmp_path / "frame.npz", **GOOD)
    assert "is a file" in refused("segment", frame, "-o", tmp_path / "a_file")


def test_folders_above_the_output_are_made_and_kept_only_with_it(refused, recording, tmp_path):
    colors = [entry for entry in depth_entries(1) if entry.topic == COLOR]
    refused("replay", write_folder(tmp_path / "bad", colors), "-o", tmp_path / "a" / "b" / "out")
    assert not (tmp_path / "a").exists()
    frame = npz(tmp_path / "frame.npz", **GOOD)
    assert main(["segment", str(frame), "-o", str(tmp_path / "a" / "b" / "frame")]) == 0
    assert main(["replay", str(recording(depth_entries(1))), "-o", str(tmp_path / "a" / "c" / "out")]) == 0
    assert (tmp_path / "a" / "b" / "frame" / "labels.png").is_file()
    assert (tmp_path / "a" / "c" / "out" / "metrics.json").is_file()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_read_only_output(refused, recording, tmp_path):
    bag = recording(depth_entries(1))
    (tmp_path / "locked").mkdir(mode=0o555)
    assert "cannot write there" in refused("replay", bag, "-o", tmp_path / "locked" / "out")


def test_usage(refused, recording):
    assert "No such option" in refused("replay", recording(depth_entries(1)), "--fast")
    assert "Missing argument" in refused("replay")
    assert "No such command" in refused("segmentate")
    assert "--workers" in refused("replay", "in", "--workers", "0")
    assert "expected one of all, usual, labels" in refused("replay", "in", "--outputs", "labels,pictures")


def test_inspect_of_something_else(refused, recording):
    bag = recording(depth_entries(1))
    assert "this is no result of rcseg replay" in refused("inspect", bag)


def test_a_frame_that_the_result_does_not_have(refused, recording, tmp_path):
    assert main(["replay", str(recording(depth_entries(1))), "-o", str(tmp_path / "out")]) == 0
    assert "no frame 1; it has 1" in refused("inspect", tmp_path / "out", "--frame", 1)


@pytest.mark.parametrize("workers", [1, 2])
def test_interrupt_leaves_a_readable_result(workers, tmp_path):
    frames = 400
    bag = write_folder(tmp_path / "in", cloud_entries(frames))
    options = ["--workers", str(workers), "--output", "out"]
    process = subprocess.Popen(
        [sys.executable, "-m", "rcseg_ros.cli", "replay", str(bag), *options],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    deadline = time.monotonic() + 300
    while not any(file.stat().st_size > 2**16 for file in tmp_path.glob(".out.*/out/out.mcap")):
        assert process.poll() is None and time.monotonic() < deadline, "no frame was finished in time"
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert error == "rcseg: interrupted\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in", "out"]
    with Recording(tmp_path / "out") as result:
        count = result.topics["/rcseg/labels"].count
        assert result.damage == [] and 0 < count < frames
        once = set(result.topics) - {"/rcseg/polygons"}  # one message a plane
        assert {result.topics[name].count for name in once} == {count}
