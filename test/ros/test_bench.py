"""`rcseg bench`: tiny runs; files, columns, sums of stages, peers' use, bad options."""

import csv
import json

import cv2
import numpy as np
import pytest

from rcseg_core import SegmenterConfig, segment
from rcseg_core.compute import parallel
from rcseg_core.errors import InputError
from rcseg_core.evaluation.frames import evaluate_scene
from rcseg_core.synthetic import make_scene
from rcseg_ros.bench import report as bench_report
from rcseg_ros.bench import run as bench_module
from rcseg_ros.bench.peers import Peer, installed_peers
from rcseg_ros.bench.probe import STATUS
from rcseg_ros.bench.run import (
    FRAME,
    REGIONS,
    SEGMENT,
    BenchOptions,
    BenchReport,
    Group,
    parse_threads,
    python_calls,
    run_bench,
)
from rcseg_ros.cli import main

COLUMNS = ["group", "width", "height", "threads", "frames", "kind", "what"]
FIGURES = ["runs", "median_ms", "p95_ms", "ratio", "python_calls"]
TINY = ("--families", "room", "--sizes", "80x60,96x72", "--seeds", "100", "--repeat", "1")


def read_rows(path):
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The files of a tiny run on one thread without peers."""
    output = tmp_path_factory.mktemp("bench") / "out"
    assert main(["bench", *TINY, "--threads", "1", "--no-peers", "-o", str(output)]) == 0
    return output


def test_a_run_writes_rows_and_plots(folder):
    rows = read_rows(folder / "bench.csv")
    assert list(rows[0]) == COLUMNS + FIGURES
    assert all((row["what"] == SEGMENT) == (int(row["python_calls"] or 0) > 500) for row in rows)
    assert {(row["group"], row["width"], row["threads"]) for row in rows} == {
        ("room", "80", "1"),
        ("room", "96", "1"),
    }
    document = json.loads((folder / "bench.json").read_text("utf-8"))
    assert [row["what"] for row in document["rows"]] == [row["what"] for row in rows]
    assert document["config"] == json.loads(json.dumps(SegmenterConfig().to_dict()))
    assert document["machine"]["cores"] >= 1
    table = (folder / "bench.md").read_text("utf-8").splitlines()
    assert len(table) == 4 and table[2].startswith("| room | 80x60 | 1 | 1 | ")
    assert {line.count("|") for line in table} == {10}
    assert cv2.imread(str(folder / "stages.png")).shape[1] > 500
    assert cv2.imread(str(folder / "pixels.png")).shape[1] > 500


def test_stages_add_up_to_the_whole(folder):
    rows = [row for row in read_rows(folder / "bench.csv") if row["width"] == "96"]
    times = {row["what"]: float(row["median_ms"]) for row in rows}  # one round: medians are that round
    stages = sum(times[row["what"]] for row in rows if row["kind"] == "stage")
    assert {"signals", "edges", "models", REGIONS} <= set(times)
    assert stages == pytest.approx(times[FRAME], rel=0.1, abs=2)
    assert times[SEGMENT] + times[REGIONS] == pytest.approx(times[FRAME], abs=0.01)


def test_a_fresh_process_tells_its_time_and_memory(folder):
    fresh = json.loads((folder / "bench.json").read_text("utf-8"))["fresh_processes"]
    assert [(probe["group"], probe["width"]) for probe in fresh] == [("room", 80), ("room", 96)]
    for probe in fresh:
        first = probe["import_s"] + probe["first_segment_s"]
        assert 0 < first < probe["start_to_labels_s"] < 120
        assert 0 < probe["second_segment_s"] <= probe["first_segment_s"] * 1.5
        if STATUS.exists():
            assert 0 <= probe["memory_added_mb"] < 500 and probe["memory_before_mb"] > 20


def test_the_screen_shows_recorded_frames_and_peers(tmp_path, capsys, monkeypatch):
    frame = make_scene("blocks", 100, width=64, height=48).frame
    camera = frame.camera
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    np.savez(tmp_path / "seen.npz", points=frame.points, color=frame.color, K=matrix)
    calls = []
    peer = Peer("counting", lambda seen: lambda: calls.append(seen.width))
    monkeypatch.setattr("rcseg_ros.bench.run.installed_peers", lambda: (peer,))
    source = str(tmp_path / "seen.npz")
    assert main(["bench", "--frames", source, "--repeat", "2", "--threads", "1", "--no-probe"]) == 0
    assert calls == [64, 64, 64]  # once to warm up, then in every round
    text = capsys.readouterr().out
    assert "recorded" in text and "64x48" in text and "counting" in text and "signals" in text


def test_labels_that_depend_on_threads_are_named(monkeypatch):
    sums = iter([1, 1, 2, 3])
    monkeypatch.setattr("rcseg_ros.bench.run._measure", lambda *_: next(sums))
    monkeypatch.setattr("rcseg_ros.bench.run.set_threads", lambda _: None)
    options = BenchOptions(
        families=("room",), sizes=((64, 48),), seeds=(1, 2), threads=(1, 2), peers=False, probe=False
    )
    assert run_bench(options, SegmenterConfig()).differing == ["room_002 64x48"]


def group(width, height, times_ms, peer_ms=()):
    made = Group("room", width, height, 1, 1, {SEGMENT: list(times_ms)})
    if peer_ms:
        made.milliseconds["peer"] = list(peer_ms)
        made.ratios["peer"] = [a / b for a, b in zip(times_ms, peer_ms, strict=True)]
    return made


def test_ratio_pairs_the_times_of_one_round():
    rows = group(320, 240, [10, 20, 90], [5, 10, 30]).rows()
    assert [(row["what"], row["kind"], row["median_ms"]) for row in rows] == [
        (SEGMENT, "whole", 20),
        ("peer", "peer", 10),
    ]
    assert np.isnan(rows[0]["ratio"]) and rows[1]["ratio"] == 2


def test_python_calls_are_counted_and_calls_into_c_are_not():
    def swapped(text):
        return text[::-1]

    assert python_calls(lambda: list(map(str.upper, "abc"))) == 1
    assert python_calls(lambda: list(map(swapped, "abc"))) == 4


def test_growth_is_against_the_pixels():
    groups = [group(160, 120, [9]), group(320, 240, [10]), group(640, 480, [44]), group(1280, 960, [192])]
    report = BenchReport(BenchOptions(), SegmenterConfig(), {}, groups)
    assert report.growth(1) == {"room": pytest.approx(1.2)}
    assert report.growth(2) == {}
    assert bench_report.near_vga(groups) == [groups[2]]


@pytest.mark.skipif(not hasattr(cv2, "findPlanes"), reason="findPlanes came with OpenCV 5")
def test_find_planes_really_finds_planes():
    frame = make_scene("room", 100, width=320, height=240).frame
    for peer in installed_peers():
        if peer.name.startswith("cv2"):
            mask, planes = peer.make(frame)()
            assert mask.shape == (240, 320) and (mask != 255).mean() > 0.4 and len(planes) >= 2


@pytest.mark.parametrize("text", ["0", "two", "1,9999", ""])
def test_bad_threads_are_told(text):
    with pytest.raises(InputError, match=r"--threads .*expected all, or numbers from 1"):
        parse_threads(text)


def test_bad_input_is_one_line(tmp_path, capsys):
    for arguments, word in (
        (["--sizes", "640"], "WIDTHxHEIGHT"),
        (["--families", "hall"], "room"),
        (["--frames", str(tmp_path / "nowhere")], "no such file"),
    ):
        assert main(["bench", *arguments]) == 2
        error = capsys.readouterr().err
        assert word in error and error.count("\n") == 1


def test_presets_are_compared_on_time_and_accuracy(tmp_path, capsys):
    where = tmp_path / "out"
    given = (
        "--families",
        "room",
        "--sizes",
        "80x60,160x120",
        "--seeds",
        "3,4",
        "--repeat",
        "2",
        "--no-probe",
    )
    assert (
        main(
            ["bench", *given, "--threads", "1", "--presets", "--set", "grouping.max_gap=2", "-o", str(where)]
        )
        == 0
    )
    shown = capsys.readouterr().out
    rows = json.loads((where / "bench.json").read_text("utf-8"))["presets"]
    assert [row["preset"] for row in rows] == ["fast", "balanced", "accurate"]
    tables = (where / "bench.md").read_text("utf-8").split("\n\n")
    assert len(tables) == 2 and tables[1].startswith("| preset | frames | size | n |")
    for row in rows:
        config = SegmenterConfig.preset(row["preset"]).replace({"grouping.max_gap": 2})
        correct = truth = noise = 0
        for seed in (3, 4):
            scene = make_scene("room", seed, width=160, height=120)
            found = evaluate_scene(scene, segment(scene.frame, config)).labels.at(0.8)
            correct, truth, noise = (
                correct + found.correct, truth + found.truth_regions, noise + found.noise
            )  # fmt: skip
        assert (row["width"], row["frames"]) == (160, 2)
        assert row["correct"] == pytest.approx(correct / truth) and row["noise_regions"] == noise
        assert 0 < row["median_ms"] <= row["p95_ms"]
        assert (row["ratio"] is not None) == bool(installed_peers())
        line = next(line for line in tables[1].splitlines() if line.startswith(f"| {row['preset']} "))
        assert f"{correct / truth:.3f} of {truth}" in line and f"{row['median_ms']:.1f}" in line
        assert f"{correct / truth:.3f} of {truth}" in shown


def test_threads_are_those_of_the_kernels_and_of_opencv():
    before = parallel.threads(), cv2.getNumThreads()
    try:
        bench_module.set_threads(1)
        assert (parallel.threads(), cv2.getNumThreads()) == (1, 1)
    finally:
        parallel.set_threads(before[0])
        cv2.setNumThreads(before[1])
