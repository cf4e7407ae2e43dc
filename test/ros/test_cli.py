"""The command line: what each command prints and writes; help answers without loading the algorithm."""

import json
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from recordings import CAMERA, depth_entries, scene, write_folder

from rcseg_core import SegmenterConfig, segment
from rcseg_core.config import PRESETS, describe
from rcseg_ros.cli import Preset, main

ROOT = Path(__file__).resolve().parents[2]
BAGS = ROOT / "bags"
COMMANDS = ["replay", "batch", "calibrate", "segment", "config", "evaluate", "bench", "warmup", "inspect",
            "view"]  # fmt: skip


@pytest.fixture
def rcseg(tmp_path, capsys, monkeypatch):
    """Run the command line in an empty folder; return what it prints."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        assert main([str(argument) for argument in arguments]) == 0
        return capsys.readouterr().out

    return run


def test_replay_prints_a_table_and_where_the_results_are(rcseg, tmp_path):
    write_folder(tmp_path / "drive", depth_entries(2))
    text = rcseg("replay", "drive", "--overlays", "--set", "grouping.max_gap=2")
    assert "2 frames" in text and "regions" in text and "nothing left out" in text
    assert "results in drive_rcseg" in text
    assert len(list((tmp_path / "drive_rcseg" / "overlays").glob("*.png"))) == 2
    assert yaml.safe_load((tmp_path / "drive_rcseg" / "config.yaml").read_text())["grouping"]["max_gap"] == 2


def test_replay_of_the_bundled_sequence_with_truth(rcseg, tmp_path):
    text = rcseg("replay", BAGS / "tabletop", "-o", "out", "--max-frames", 1, "--outputs", "labels")
    assert "correct of truth, labels" in text
    (row,) = json.loads((tmp_path / "out" / "metrics.json").read_text())["frames"]
    assert row["truth"]["labels"]["truth_regions"] > 5
    assert row["truth"]["labels"]["voi_bits"] < 3
    assert row["noise"]["source"] == "estimated" and 0 < row["noise"]["sigma_m"] < 0.05


def test_inspect_lists_frames_and_regions(rcseg, tmp_path):
    write_folder(tmp_path / "in", depth_entries(2))
    rcseg("replay", "in", "-o", "out")
    text = rcseg("inspect", "out")
    assert "/rcseg/regions" in text and "rcseg_msgs/msg/RegionArray" in text and "1700000000.100" in text
    regions = len(segment(scene(1), SegmenterConfig()).regions)
    shown = rcseg("inspect", "out", "--frame", 1)
    assert f"frame 1: {regions} regions" in shown
    assert "surfaces; metres" in shown and "plane" in shown and "normal (" in shown and "offset +-" in shown
    assert "noise (estimated): range " in shown and " mm at the median depth of " in shown
    assert "up: unknown" in shown and "objects; metres" in shown and "other" in shown


def test_inspect_tells_classes_areas_and_objects(rcseg):
    rcseg("replay", BAGS / "tabletop", "-o", "out", "--max-frames", 1)
    shown = rcseg("inspect", "out", "--frame", 0)
    assert "up: (" in shown and "floor 0." in shown and "horizontal 0." in shown
    assert re.search(r"[3-9] objects; metres", shown) and "surface 2" in shown


def check_world(folder, document, expected):
    world = expected.world()
    for name, image in (("object_labels", world.object_labels), ("class_mask", world.class_mask)):
        np.testing.assert_array_equal(cv2.imread(str(folder / f"{name}.png"), cv2.IMREAD_UNCHANGED), image)
    assert (document["up"] is None) == (world.up is None)
    assert [o["label"] for o in document["objects"]] == [o.label for o in world.objects]
    for told, surface in zip(document["surfaces"], expected.surfaces, strict=True):
        assert told["category"] == surface.category
        areas = [p["area_m2"] for p in told["polygons"]]
        assert areas == [p.area for p in surface.polygons]


def check_results(folder, frame):
    expected = segment(frame, SegmenterConfig())
    labels = cv2.imread(str(folder / "labels.png"), cv2.IMREAD_UNCHANGED)
    assert labels.dtype == np.uint16
    np.testing.assert_array_equal(labels, expected.labels)
    surfaces = cv2.imread(str(folder / "surface_labels.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(surfaces, expected.surface_labels)
    assert cv2.imread(str(folder / "overlay.png")).shape == (*labels.shape, 3)
    document = json.loads((folder / "regions.json").read_text())
    assert [r["label"] for r in document["regions"]] == [r.label for r in expected.regions]
    first, region = document["regions"][0], expected.regions[0]
    assert first["pixel_count"] == (labels == 1).sum()
    np.testing.assert_array_equal(first["range_patch"]["control_points"], region.range_patch.control_points)
    np.testing.assert_array_equal(document["camera_matrix"], CAMERA.matrix())
    ends = [r["persistence"] for r in document["regions"]]
    assert ends == [None if r.persistence == np.inf else r.persistence for r in expected.regions]
    assert len(document["surfaces"]) == surfaces.max()
    for told, surface in zip(document["surfaces"], expected.surfaces, strict=True):
        assert told["pixel_count"] == (surfaces == told["label"]).sum()
        assert told["regions"] == list(surface.regions)
        assert told["primitive"]["kind"] == surface.primitive.kind
        if surface.plane is not None:
            assert told["local"]["pose"] == surface.plane.pose.tolist()
            assert told["local"]["covariance"] == surface.plane.covariance.tolist()
            assert told["local"]["systematic"] == surface.plane.systematic.tolist()
        for name, value in surface.primitive.parameters.items():
            np.testing.assert_array_equal(told["primitive"]["parameters"][name], value)
            np.testing.assert_array_equal(
                told["primitive"]["standard_errors"][name], surface.primitive.standard_errors[name]
            )
    assert document["surfaces"][0]["primitive"]["kind"] == "plane"
    check_world(folder, document, expected)
    noise = document["noise"]
    depth, (a, b, c) = noise["median_depth_m"], noise["range_law"][0]
    assert noise["source"] == "estimated" and noise["range_unit"] == "1/m"
    assert noise["sigma_m"] == pytest.approx((a + b / depth + c / depth**2) * depth**2)
    assert noise["tolerance_m"] == pytest.approx(0.004 * depth, rel=1e-6)
    assert len(noise["color"]) == 3 and noise["range_correlation"] >= 1 and noise["color_correlation"] >= 1


def test_segment_of_an_archive(rcseg, tmp_path):
    frame = scene(0)
    np.savez(tmp_path / "frame.npz", points=frame.points, color=frame.color, K=CAMERA.matrix())
    assert "written to frame_rcseg" in rcseg("segment", "frame.npz")
    check_results(tmp_path / "frame_rcseg", frame)


def test_segment_of_pictures(rcseg, tmp_path):
    frame = scene(0)
    stored = np.nan_to_num(frame.depth_m * 5000).round().astype(np.uint16)
    cv2.imwrite(str(tmp_path / "d.png"), stored)
    cv2.imwrite(str(tmp_path / "c.png"), frame.color[..., ::-1])
    intrinsics = f"{CAMERA.fx},{CAMERA.fy},{CAMERA.cx},{CAMERA.cy}"
    images = ("--color", "c.png", "--depth", "d.png", "--intrinsics", intrinsics)
    rcseg("segment", *images, "--depth-unit", 0.0002, "-o", "out")
    same = type(frame).from_depth(stored.astype(np.float32) * np.float32(0.0002), frame.color, CAMERA)
    check_results(tmp_path / "out", same)


def test_config_shows_every_parameter_and_returns_from_its_own_file(rcseg, tmp_path):
    changed = SegmenterConfig().replace({"grouping.range_tolerance": 0.01, "absorption.enabled": False})
    settings = ("--set", "grouping.range_tolerance=0.01", "--set", "absorption.enabled=no")
    text = rcseg("config", *settings).replace("\n", "")
    for parameter in describe(changed):
        assert parameter.key in text
    rcseg("config", *settings, "--yaml", "my.yaml")
    assert SegmenterConfig.from_dict(yaml.safe_load((tmp_path / "my.yaml").read_text())) == changed
    assert rcseg("config", "--config", "my.yaml", "--yaml", "-") == (tmp_path / "my.yaml").read_text()


def printed(rcseg, *arguments):
    return SegmenterConfig.from_dict(yaml.safe_load(rcseg("config", *arguments, "--yaml", "-")))


def test_a_preset_lies_below_the_file_and_the_file_below_single_settings(rcseg, tmp_path):
    fast = SegmenterConfig.preset("fast")
    assert printed(rcseg, "--preset", "fast") == fast != SegmenterConfig()
    (tmp_path / "my.yaml").write_text("grouping: {max_gap: 2, range_tolerance: 0.01}")
    expected = fast.replace({"grouping.range_tolerance": 0.01, "grouping.max_gap": 5})
    given = ("--set", "grouping.max_gap=5", "-c", "my.yaml", "-p", "fast")
    assert printed(rcseg, *given) == expected


def test_a_ros_file_may_name_the_preset_and_the_option_goes_before_it(rcseg, tmp_path):
    file = ROOT / "config" / "fast.yaml"
    assert printed(rcseg, "-c", file) == SegmenterConfig.preset("fast")
    assert printed(rcseg, "-c", file, "-p", "accurate") == SegmenterConfig.preset("accurate")


def completed(line, monkeypatch, capsys):
    """What bash is offered for the last word of a line."""
    words = line.split(" ")
    monkeypatch.setenv("_RCSEG_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", line)
    monkeypatch.setenv("COMP_CWORD", str(len(words) - 1))
    with pytest.raises(SystemExit):
        main([])
    return capsys.readouterr().out.split()


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("rcseg ba", ["batch"]),
        ("rcseg replay x --preset ", list(PRESETS)),
        ("rcseg batch x --runner ", ["local", "ray"]),
        ("rcseg calibrate x --range-from p", ["points"]),
        ("rcseg view --up i", ["imu", "imu:"]),
        ("rcseg replay x --outputs labels,over", ["labels,overlay"]),
        ("rcseg evaluate synthetic --labels su", ["surfaces"]),
        ("rcseg config --set grouping.max_g", ["grouping.max_gap="]),
        ("rcseg evaluate synthetic --families blocks,roo", ["blocks,room"]),
    ],
)
def test_completion_offers_the_words_of_options(line, offered, monkeypatch, capsys):
    assert completed(line, monkeypatch, capsys) == offered


def test_completion_knows_the_presets():
    assert [preset.value for preset in Preset] == list(PRESETS)


@pytest.mark.parametrize("command", ["replay", "segment", "evaluate", "bench", "view", "config"])
def test_commands_that_segment_take_a_preset(rcseg, command):
    assert "--preset" in rcseg(command, "--help")


def test_a_ros_parameter_file_is_a_configuration_too(rcseg, tmp_path):
    text = "/**:\n  ros__parameters:\n    autostart: true\n    sync: {queue: 3}\n    grouping: {max_gap: 2}\n"
    (tmp_path / "ros.yaml").write_text(text)
    printed = yaml.safe_load(rcseg("config", "--config", "ros.yaml", "--yaml", "-"))
    assert SegmenterConfig.from_dict(printed) == SegmenterConfig().replace({"grouping.max_gap": 2})


def test_help_names_every_command_and_loads_no_algorithm():
    program = "import sys; from rcseg_ros.cli import main; main(['--help']); print('numba' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    for command in COMMANDS:
        assert command in done.stdout
    assert done.stdout.strip().endswith("False")


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_explains_itself_with_an_example(rcseg, command):
    text = rcseg(command, "--help")
    assert "Example" in text and f"rcseg {command}" in text
