"""Input and output are checked at the door: nobody waits for kernels to hear that a path is of no use."""

import numpy as np
import pytest
from recordings import depth_entries, scene, write_folder

from rcseg_ros.cli import main
from rcseg_ros.evaluation import evaluate, tracks


@pytest.fixture
def at_the_door(tmp_path, capsys, monkeypatch):
    """Run the command line where kernels cannot be had; return the one line with which it refuses."""

    def compile_kernels(config, announce):
        raise AssertionError("compiles before it has looked at its input and output")

    monkeypatch.setattr("rcseg_ros.commands.terminal.warm_up", compile_kernels)
    monkeypatch.setattr("rcseg_ros.batch.report.warm_up", compile_kernels, raising=False)
    monkeypatch.chdir(tmp_path)
    write_folder(tmp_path / "good", depth_entries(2))
    (tmp_path / "bad.mcap").write_bytes(b"nothing")
    (tmp_path / "bad.npz").write_bytes(b"nothing")
    np.savez(tmp_path / "good.npz", points=scene(0).points, color=scene(0).color)
    (tmp_path / "file").write_text("a file")
    (tmp_path / "taken").mkdir()
    for name in ("metrics.json", "bench.json", "regions.json", "sensor.yaml"):
        (tmp_path / "taken" / name).write_text("{}")

    def run(line):
        assert main(line.split()) == 2
        return capsys.readouterr().err

    return run


@pytest.mark.parametrize("bag", ["missing", "bad.mcap"])
@pytest.mark.parametrize(
    "command",
    ["replay {}", "calibrate {}", "evaluate {}", "evaluate {} --tracks", "view {} --port 0", "inspect {}",
     "bench --frames {}"],
)  # fmt: skip
def test_a_recording_that_cannot_be_read(at_the_door, command, bag):
    assert bag in at_the_door(command.format(bag))


@pytest.mark.parametrize("command", ["segment bad.npz", "evaluate bad.npz", "bench --frames bad.npz"])
def test_a_frame_that_cannot_be_read(at_the_door, command):
    assert "bad.npz" in at_the_door(command)


def test_a_batch_of_nothing(at_the_door):
    assert "missing" in at_the_door("batch missing -o out")
    assert "taken" in at_the_door("batch good -o taken")


def test_topics_that_are_not_there(at_the_door):
    assert "/none" in at_the_door("replay good --topics range=/none")
    assert "/none" in at_the_door("calibrate good --topics range=/none")


def test_frames_that_never_pair(at_the_door, tmp_path):
    info, depth, _, _, _, color = depth_entries(2)
    write_folder(tmp_path / "late", [info, depth, color])
    assert "unpaired" in at_the_door("replay late")


@pytest.mark.parametrize(
    "command",
    ["replay good -o taken", "evaluate synthetic --seeds 0 --size 64x48 -o taken", "bench -o taken",
     "evaluate synthetic --tracks --seeds 0 --frames 2 -o taken", "calibrate good -o taken/sensor.yaml",
     "segment good.npz -o taken"],
)  # fmt: skip
def test_a_result_that_is_there_already(at_the_door, command):
    assert "exists already" in at_the_door(command)


@pytest.mark.parametrize(
    "command",
    ["replay good -o file/out", "evaluate synthetic --seeds 0 -o file/out", "calibrate good -o file/a.yaml",
     "evaluate synthetic --seeds 0 --size 64x48 --write-reference file/a.yaml", "batch good -o file/out"],
)  # fmt: skip
def test_a_place_that_cannot_be_written(at_the_door, command):
    assert "file" in at_the_door(command)


def test_evaluate_looks_at_its_output_before_the_first_frame(at_the_door, monkeypatch):
    def segment(*_, **__):
        raise AssertionError("works before it has looked at its output")

    monkeypatch.setattr(evaluate, "segment", segment)
    monkeypatch.setattr(tracks, "evaluate_journey", segment)
    monkeypatch.setattr("rcseg_ros.commands.terminal.warm_up", lambda config, announce: 0.0)
    at_the_door("evaluate synthetic --seeds 0 --size 64x48 -o taken")
    at_the_door("evaluate synthetic --tracks --seeds 0 --frames 2 -o taken")
