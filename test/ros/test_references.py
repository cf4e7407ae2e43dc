"""Reference files: what counts as worse, what is kept when figures are renewed, what a bad file says."""

import copy

import numpy as np
import pytest
import yaml

from rcseg_core.errors import InputError
from rcseg_core.evaluation.metrics import PartMetrics, SceneMetrics
from rcseg_ros.cli import main
from rcseg_ros.evaluation.evaluate import Report
from rcseg_ros.evaluation.references import TOLERANCES, Reference, read_reference, write_reference


def report(*, purity=0.99, parts=2.0, regions=20, names=("mosd_a", "mosd_b"), face_faults=None):
    found = Report(face_faults=face_faults or {})
    for name in names:
        metrics = PartMetrics(purity, 0.9, 1.0, parts, parts, 0.8, 3)
        found.frames.append(SceneMetrics(name, regions, 1.0, "surfaces", (), parts=metrics))
        found.groups[name], found.seconds[name] = "mosd", 0.1
    return found


@pytest.fixture
def reference(tmp_path):
    return write_reference(tmp_path / "reference.yaml", report())


def test_the_same_figures_are_no_fault_and_survive_the_file(tmp_path, reference):
    assert reference.faults(report()) == {}
    assert read_reference(tmp_path / "reference.yaml") == reference


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"purity": 0.97}, "surfaces: purity is 0.97, expected 0.99"),
        ({"parts": 3.5}, "parts_per_object is 3.5, expected 2 and at most 1.2 worse"),
        ({"regions": 40}, "regions is 40"),
        ({"regions": 5}, "regions is 5"),
    ],
)
def test_what_is_worse_by_more_than_the_tolerance_is_told(reference, change, words):
    faults = reference.faults(report(**change))
    assert set(faults) == {"mosd", "mosd_a", "mosd_b"}
    assert all(any(words in text for text in faults[name]) for name in ("mosd_a", "mosd_b"))


@pytest.mark.parametrize("change", [{"purity": 1.0}, {"parts": 1.0}, {"regions": 21}])
def test_what_is_better_or_within_tolerance_is_no_fault(reference, change):
    assert reference.faults(report(**change)) == {}


def test_pooled_figures_are_judged_more_strictly(reference):
    assert set(reference.faults(report(purity=0.986))) == {"mosd"}
    for key, value in TOLERANCES["group"].items():
        if key not in ("noise", "correct"):  # sums
            assert value < TOLERANCES["frame"][key]


def test_a_part_of_the_frames_is_judged_without_its_groups(reference):
    assert set(reference.faults(report(purity=0.9, names=("mosd_a",)))) == {"mosd_a"}
    assert reference.faults(report(purity=0.9, names=("mosd_new",))) == {}


FACES = {"f": {"floor": [[5, 5], [5, 40]], "lid": [[30, 10]]}}


def surfaces():
    labels = np.ones((50, 50), np.int32)
    labels[25:35, :20] = 2
    return labels


def test_faces_are_one_surface_each():
    reference = Reference(faces=FACES)
    assert reference.face_faults("f", surfaces()) == []
    assert reference.face_faults("other", surfaces()) == []
    split = surfaces()
    split[:20, 30:] = 3
    assert reference.face_faults("f", split) == ["face floor: [5, 40] lies on another surface than [5, 5]"]
    merged = np.ones_like(split)
    assert reference.face_faults("f", merged) == ["face lid: [30, 10] lies on the same surface as face floor"]
    merged[25:35, :20] = 0
    assert reference.face_faults("f", merged) == ["face lid: no surface at [30, 10]"]


def test_a_stray_pixel_under_a_point_does_not_count():
    labels = surfaces()
    labels[5, 5], labels[30, 10] = 7, 0
    assert Reference(faces=FACES).face_faults("f", labels) == []


def test_renewing_keeps_faces_tolerances_and_other_frames(tmp_path, reference):
    path = tmp_path / "reference.yaml"
    document = yaml.safe_load(path.read_text())
    document["frames"]["mosd_a"]["faces"] = {"floor": [[1, 2], [3, 4]]}
    document["tolerances"]["frame"]["purity"] = 0.0001
    path.write_text(yaml.safe_dump(document))
    fault = "face floor: no surface at [1, 2]"
    write_reference(path, report(purity=0.95, names=("mosd_a",), face_faults={"mosd_a": [fault]}))
    new = read_reference(path)
    assert new.faces == {"mosd_a": {"floor": [[1, 2], [3, 4]]}}
    assert new.tolerances["frame"]["purity"] == 0.0001
    assert new.frames["mosd_a"]["surfaces"]["purity"] == 0.95
    assert new.frames["mosd_b"]["surfaces"]["purity"] == 0.99
    assert path.read_text().startswith("# What `rcseg evaluate` finds")
    known = report(purity=0.95, names=("mosd_a",), face_faults={"mosd_a": [fault]})
    assert new.faults(known) == {}
    known.face_faults["mosd_a"] = [fault, "face floor: no surface at [3, 4]"]
    assert new.faults(known) == {"mosd_a": ["face floor: no surface at [3, 4]"]}


@pytest.mark.parametrize(
    "spoil",
    [
        lambda d: d.pop("frames"),
        lambda d: d["tolerances"].pop("group"),
        lambda d: d["tolerances"]["frame"].pop("purity"),
        lambda d: d["frames"]["mosd_a"]["surfaces"].update(beauty=1.0),
        lambda d: d["frames"]["mosd_a"]["surfaces"].update(purity="high"),
        lambda d: d["frames"]["mosd_a"].update(faces={"floor": [[1, 2, 3]]}),
    ],
)
def test_a_bad_file_is_one_clear_line(tmp_path, reference, spoil):
    path = tmp_path / "reference.yaml"
    document = copy.deepcopy(yaml.safe_load(path.read_text()))
    spoil(document)
    path.write_text(yaml.safe_dump(document))
    with pytest.raises(InputError, match=r"reference\.yaml: no reference of rcseg evaluate"):
        read_reference(path)
    path.write_text("{")
    with pytest.raises(InputError, match="not a YAML file"):
        read_reference(path)
    with pytest.raises(InputError, match="cannot be read"):
        read_reference(tmp_path / "none.yaml")


def test_the_command_writes_checks_and_says_what_is_worse(tmp_path, capsys):
    rng = np.random.default_rng(1)
    depth = 1 + rng.normal(0, 1e-3, (60, 80))
    depth[:, 40:] += 0.5
    truth = np.where(np.arange(80) < 40, 1, 2) * np.ones((60, 1), np.int32)
    matrix = np.array([[80, 0, 39.5], [0, 80, 29.5], [0, 0, 1.0]])
    color = np.full((60, 80, 3), 90, np.uint8)
    np.savez(tmp_path / "flat.npz", depth=depth, K=matrix, color=color, labels=truth)
    file = tmp_path / "reference.yaml"
    command = ["evaluate", str(tmp_path / "flat.npz"), "--tables-only"]
    assert main([*command, "--write-reference", str(file)]) == 0
    assert read_reference(file).frames["flat"]["surfaces"]["correct"] == 2
    assert main([*command, "--check", str(file)]) == 0
    assert "Nothing is worse" in capsys.readouterr().out
    file.write_text(file.read_text().replace("labelled: 1,", "labelled: 1.5,"))
    capsys.readouterr()
    assert main([*command, "--check", str(file)]) == 1
    assert "flat: surfaces: labelled is 1, expected 1.5 and at most" in capsys.readouterr().out
    assert main([*command, "--check", str(tmp_path / "none.yaml")]) == 2
