"""The runner behind `rcseg evaluate`: files, tables, pictures, bad options, interruption."""

import csv
import json

import cv2
import numpy as np
import pytest
from rich.console import Console

import rcseg_ros.evaluation.evaluate as evaluate
from rcseg_core import SegmenterConfig
from rcseg_core.errors import InputError
from rcseg_core.synthetic import FAMILIES, make_scene
from rcseg_ros.evaluation.evaluate import run_evaluate
from rcseg_ros.evaluation.options import (
    SyntheticOptions,
    parse_families,
    parse_level,
    parse_seeds,
    parse_size,
)
from rcseg_ros.evaluation.reports import markdown_tables

SMALL = SyntheticOptions(families=("room", "painting"), seeds=(0, 1), width=160, height=120)


@pytest.fixture
def console(tmp_path):
    with (tmp_path / "screen.txt").open("w", encoding="utf-8") as file:
        yield Console(file=file)


def screen(tmp_path):
    return (tmp_path / "screen.txt").read_text("utf-8")


def test_a_run_writes_figures_plot_and_pictures(tmp_path, console):
    output = tmp_path / "out"
    report = run_evaluate(
        "synthetic", config=SegmenterConfig(), console=console, output=output, synthetic=SMALL
    )
    document = json.loads((output / "metrics.json").read_text())
    assert [row["frame"] for row in document["frames"]] == [
        "room_000",
        "room_001",
        "painting_000",
        "painting_001",
    ]
    for group, row in zip(report.pooled, document["pooled"], strict=True):
        frames = [f for f in document["frames"] if f["frame"].startswith(group.name)]
        assert row["correct"] == sum(f["correct"] for f in frames)
        assert row["correct_share"] == row["correct"] / sum(f["truth_regions"] for f in frames)
        assert row["depth_error_sigmas"] == pytest.approx(np.mean([f["depth_error_sigmas"] for f in frames]))
    assert document["settings"]["synthetic"]["seeds"] == [0, 1]
    assert document["config"] == json.loads(json.dumps(SegmenterConfig().to_dict()))
    assert set(document["correct_over_tolerance"]["regions"]["room"]) >= {"0.51", "0.8", "0.95"}
    with (output / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(r["correct"]) for r in rows] == [f["correct"] for f in document["frames"]]
    assert cv2.imread(str(output / "correct.png")).shape[2] == 3
    assert sorted(p.name for p in (output / "pictures").iterdir()) == [
        "painting_000.png",
        "painting_001.png",
        "room_000.png",
        "room_001.png",
    ]
    console.file.flush()
    text = screen(tmp_path)
    assert "Regions, truth of regions, overlap 0.8" in text
    assert "labelled:" not in text, "the legend explains what the tables show"
    assert f"{report.pooled[0].correct():.3f}" in text


def test_recorded_frames_of_each_kind_of_truth(tmp_path, console):
    scene = make_scene("room", 1, width=160, height=120)
    data = tmp_path / "data"
    (data / "objects").mkdir(parents=True)
    camera = scene.frame.camera
    meta = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy, "background_labels": [1]}
    (data / "objects" / "meta.json").write_text(json.dumps(meta))
    depth = np.round(1000 * np.nan_to_num(scene.frame.depth_m)).astype(np.uint16)
    cv2.imwrite(str(data / "objects" / "depth.png"), depth)
    cv2.imwrite(str(data / "objects" / "rgb.png"), scene.frame.color[..., ::-1])
    cv2.imwrite(str(data / "objects" / "labels.png"), scene.object_labels.astype(np.uint8))
    np.savez(
        data / "planes.npz", points=scene.frame.points, color=scene.frame.color, labels=scene.surface_labels
    )
    np.savez(data / "alone.npz", points=scene.frame.points, color=scene.frame.color)
    output = tmp_path / "out"
    report = run_evaluate(
        str(data), config=SegmenterConfig(), console=console, output=output, level="surfaces"
    )
    assert report.groups == {"alone": "alone", "objects": "objects", "planes": "planes"}
    alone, objects, planes = report.frames
    assert alone.labels is None and alone.parts is None
    assert 0.5 < objects.parts.purity <= 1
    assert planes.labels.truth_regions > 3
    assert len(list((output / "pictures").iterdir())) == 3
    only = run_evaluate(str(data), config=SegmenterConfig(), console=console, match="pla*", pictures=False)
    assert [(f.name, f.level) for f in only.frames] == [("planes", "surfaces"), ("planes", "regions")]
    page = (output / "index.html").read_text("utf-8")
    for name in ("alone", "objects", "planes"):
        assert f'<h2 id="{name}">' in page and f'src="pictures/{name}.png"' in page
    assert "Surfaces, truth of objects" in page and "<script" not in page
    text = markdown_tables(report, 0.8)
    (row,) = [line for line in text.splitlines() if line.startswith("| planes |")]
    assert f" {planes.labels.at().correct} " in row and "| **planes** | 1 |" in text
    assert "**planes**" not in markdown_tables(report, 0.8, pooled_only=True)
    overview = cv2.imread(str(output / "overview.png"))
    assert overview.shape[1] == 3 * 320
    sheets = {n: cv2.imread(str(output / "pictures" / f"{n}.png")) for n in ("alone", "objects")}
    assert sheets["alone"].shape == sheets["objects"].shape and sheets["alone"].shape[1] == 5 * 480


def test_both_levels_have_their_own_rows_and_pools(tmp_path, console):
    output = tmp_path / "out"
    report = run_evaluate(
        "synthetic", config=SegmenterConfig(), console=console, output=output, synthetic=SMALL, level="both"
    )
    document = json.loads((output / "metrics.json").read_text())
    assert [(row["name"], row["labels"]) for row in document["pooled"]] == [
        ("room", "surfaces"),
        ("painting", "surfaces"),
        ("room", "regions"),
        ("painting", "regions"),
    ]
    truth = {(row["labels"], row["name"]): row["truth_regions"] for row in document["pooled"]}
    assert truth["surfaces", "painting"] < truth["regions", "painting"]
    assert set(document["correct_over_tolerance"]) == {"surfaces", "regions"}
    assert report.frames[0].blobs is not None and report.frames[1].blobs is None


def test_objects_have_a_table_figures_and_a_picture(tmp_path, console):
    report = run_evaluate(
        "synthetic",
        config=SegmenterConfig(),
        console=console,
        output=tmp_path / "out",
        synthetic=SyntheticOptions(families=("room",), seeds=(21,), width=160, height=120),
        level="objects",
    )
    (row,) = report.frame_rows(0.8)
    assert row["labels"] == "objects" and row["objects"] >= 2 and 0 <= row["whole"] <= 1
    assert row["best_iou"] > 0.7 and "correct" not in row
    console.file.flush()
    assert "whole" in screen(tmp_path) and "voi_bits" not in row
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["pooled"][0]["labels"] == "objects"


def test_recognised_planes_have_a_table_and_figures_of_their_own(tmp_path, console):
    output = tmp_path / "out"
    run_evaluate(
        "synthetic", config=SegmenterConfig(), console=console, output=output, synthetic=SMALL, planes=True
    )
    document = json.loads((output / "metrics.json").read_text())
    assert {row["labels"] for row in document["frames"] + document["pooled"]} == {"planes"}
    room, _ = document["pooled"]
    frames = [row for row in document["frames"] if row["group"] == "room"]
    assert room["matched"] == sum(row["matched"] for row in frames) > 4
    assert room["panoptic"] == pytest.approx(np.mean([row["panoptic"] for row in frames]))
    for row in frames:
        assert row["panoptic"] == pytest.approx(row["mean_iou"] * row["f_score"])
        assert row["precision"] == row["matched"] / row["machine_planes"]
    console.file.flush()
    text = screen(tmp_path)
    assert "Planes, by the rules of EVOPS" in text and f"{room['panoptic']:.3f}" in text
    assert "truth of planes" not in text and (output / "index.html").exists()


def test_planes_of_frames_without_truth_are_counted(tmp_path, console):
    scene = make_scene("room", 1, width=160, height=120)
    np.savez(tmp_path / "alone.npz", points=scene.frame.points, color=scene.frame.color)
    report = run_evaluate(str(tmp_path), config=SegmenterConfig(), console=console, planes=True)
    (alone,) = report.frames
    assert alone.planes is None and alone.regions > 3 and 0.5 < alone.labelled <= 1


def test_stated_errors_are_compared_with_the_truth(tmp_path, console):
    output = tmp_path / "out"
    arguments = {"config": SegmenterConfig(), "console": console, "synthetic": SMALL, "uncertainty": True}
    report = run_evaluate("synthetic", output=output, **arguments)
    assert report.frames == [] and len(report.checks) > 10
    document = json.loads((output / "metrics.json").read_text())
    pooled = {(row["what"], row["by"], row["class"]): row for row in document["uncertainty"]["pooled"]}
    planes = [c for c in document["uncertainty"]["checks"] if c["what"] == "plane"]
    assert pooled["plane", "all", ""]["count"] == len(planes)
    assert pooled["plane", "all", ""]["nees"] == pytest.approx(np.mean([c["nees"] for c in planes]))
    assert pooled["control points", "family", "painting"]["count"] > 1
    with (output / "uncertainty.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(pooled)
    console.file.flush()
    assert "Stated errors of planes" in screen(tmp_path) and "family painting" in screen(tmp_path)
    with pytest.raises(InputError, match=r"--uncertainty: .* give `synthetic`"):
        run_evaluate(str(tmp_path), **arguments)


def test_levels_that_labels_asks_for():
    assert parse_level("auto", synthetic=True) == ("regions",)
    assert parse_level("auto", synthetic=False) == parse_level("both", synthetic=True)
    assert parse_level("surfaces", synthetic=True) == ("surfaces",)
    assert parse_level("objects", synthetic=False) == ("objects",)
    assert parse_level("auto", synthetic=True, planes=True) == ("planes",)
    assert parse_level("both", synthetic=True, planes=True) == ("surfaces", "regions", "planes")
    assert parse_level("auto", synthetic=True, uncertainty=True) == ()


def test_an_interrupted_run_keeps_what_was_finished(tmp_path, console, monkeypatch):
    real, calls = evaluate.segment, []

    def interrupt(frame, config):
        calls.append(frame)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return real(frame, config)

    monkeypatch.setattr(evaluate, "segment", interrupt)
    output = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        run_evaluate("synthetic", config=SegmenterConfig(), console=console, output=output, synthetic=SMALL)
    document = json.loads((output / "metrics.json").read_text())
    assert [row["frame"] for row in document["frames"]] == ["room_000", "room_001"]


def test_a_run_that_fails_at_once_leaves_nothing(tmp_path, console, monkeypatch):
    def fail(frame, config):
        raise RuntimeError("broken")

    monkeypatch.setattr(evaluate, "segment", fail)
    with pytest.raises(RuntimeError, match="broken"):
        run_evaluate(
            "synthetic", config=SegmenterConfig(), console=console, output=tmp_path / "out", synthetic=SMALL
        )
    assert [p.name for p in tmp_path.iterdir()] == ["screen.txt"]


@pytest.mark.parametrize(
    ("text", "seeds"), [("7", (7,)), ("100-102", (100, 101, 102)), ("1, 5,4-6", (1, 5, 4, 6))]
)
def test_seeds_are_numbers_and_ranges(text, seeds):
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize("text", ["", "x", "5-", "-5", "9-3", "1;2"])
def test_bad_seeds_are_one_clear_line(text):
    with pytest.raises(InputError, match="--seeds"):
        parse_seeds(text)


def test_families_sizes_and_levels():
    assert parse_families("all") == FAMILIES
    assert parse_families("all", structured_light=True) == ("room", "blocks", "curved")
    assert parse_families("room, blocks") == ("room", "blocks")
    assert parse_size("320x240") == (320, 240)
    with pytest.raises(InputError, match="'kitchen' is none of"):
        parse_families("kitchen")
    for text in ("640", "x", "640x", "-1x5"):
        with pytest.raises(InputError, match="--size"):
            parse_size(text)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"dataset": "/nowhere"}, "no such file"),
        ({"level": "faces"}, "--labels faces"),
        ({"tolerance": 0.5}, "--tolerance 0.5"),
    ],
)
def test_bad_options_are_refused_before_anything_is_written(tmp_path, console, options, text):
    arguments = {"dataset": "synthetic", "synthetic": SMALL, **options}
    with pytest.raises(InputError, match=text):
        run_evaluate(
            arguments.pop("dataset"),
            config=SegmenterConfig(),
            console=console,
            output=tmp_path / "out",
            **arguments,
        )
    assert [p.name for p in tmp_path.iterdir()] == ["screen.txt"]
