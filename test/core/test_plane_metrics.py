"""The rules of EVOPS against an independent oracle and by hand; what counts as a plane."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from oracle import naive_evops

from rcseg_core import segment
from rcseg_core.evaluation.plane_evaluation import planes_of_frame, planes_of_scene
from rcseg_core.evaluation.plane_metrics import evaluate_planes, flat_labels, plane_labels
from rcseg_core.evaluation.pooling import pool
from rcseg_core.synthetic import make_scene

labels_image = arrays(np.int32, (6, 7), elements=st.integers(0, 4))


def stripes(*widths_and_labels, height=10):
    row = np.concatenate([np.full(width, label) for width, label in widths_and_labels])
    return np.tile(row, (height, 1)).astype(np.int32)


def agree(truth, machine, mask=None):
    found = evaluate_planes(truth, machine, mask)
    wanted = naive_evops.figures(naive_evops.planes(truth, mask), naive_evops.planes(machine, mask))
    assert found.counts() == {key: wanted[key] for key in found.counts()}
    for key in ("precision", "recall", "f_score", "mean_iou", "panoptic"):
        assert getattr(found, key) == pytest.approx(wanted[key]), key


@given(labels_image, labels_image, arrays(bool, (6, 7)))
@settings(max_examples=200, deadline=None)
def test_figures_are_those_of_the_oracle(truth, machine, mask):
    agree(truth, machine)
    agree(truth, machine, mask)


@given(labels_image, arrays(bool, (6, 7)), st.integers(0, 2**31))
@settings(max_examples=300, deadline=None)
def test_merged_and_split_images_match_the_oracle(truth, split, seed):
    """Machine labels made from the truth by merging and splitting, where every case is frequent."""
    machine = np.random.default_rng(seed).integers(0, 4, 5)[truth] * 2 + split.astype(np.int32)
    agree(truth, machine)


def test_a_match_needs_three_quarters_and_the_mean_is_of_matches():
    truth = stripes((8, 1), (8, 2), (4, 0))
    found = evaluate_planes(truth, stripes((6, 5), (2, 0), (8, 6), (4, 0)))
    assert (found.matched, found.precision, found.recall, found.f_score) == (2, 1.0, 1.0, 1.0)
    assert found.mean_iou == pytest.approx((6 / 8 + 1) / 2) and found.panoptic == found.mean_iou
    less = evaluate_planes(truth, stripes((5, 5), (3, 0), (8, 6), (4, 0)))
    assert (less.matched, less.mean_iou, less.missed, less.noise) == (1, 1.0, 1, 1)
    assert less.panoptic == pytest.approx(0.5)


def test_over_and_under():
    over = evaluate_planes(stripes((20, 3)), stripes((10, 1), (10, 2)))
    assert (over.over, over.under, over.missed, over.noise, over.matched) == (1, 0, 0, 0, 0)
    under = evaluate_planes(stripes((10, 1), (10, 2)), stripes((20, 3)))
    assert (under.over, under.under, under.missed, under.noise, under.matched) == (0, 1, 0, 0, 0)


def test_nothing_found_and_nothing_there():
    none = evaluate_planes(stripes((20, 3)), stripes((20, 0)))
    assert (none.precision, none.recall, none.f_score, none.panoptic, none.missed) == (0, 0, 0, 0, 1)
    assert evaluate_planes(stripes((20, 0)), stripes((20, 4))).noise == 1


def test_only_recognised_planes_count():
    surfaces = [
        SimpleNamespace(label=label, primitive=SimpleNamespace(kind=kind))
        for label, kind in enumerate(("plane", "sphere", "plane", "none"), start=1)
    ]
    labels = stripes((2, 0), (2, 1), (2, 2), (2, 3), (2, 4))
    assert np.unique(plane_labels(labels, surfaces)).tolist() == [0, 1, 3]
    assert not plane_labels(np.zeros((3, 4), np.int32), []).any()


def test_balls_and_cylinders_of_the_truth_are_no_planes():
    for seed in range(2):
        scene = make_scene("curved", seed, width=160, height=120)
        flat = flat_labels(scene.surface_labels, scene.normals)
        for label in range(1, int(scene.surface_labels.max()) + 1):
            normals = scene.normals[scene.surface_labels == label].astype(float)
            spread = np.linalg.norm(normals - normals[0], axis=1).max()
            assert (flat[scene.surface_labels == label] > 0).all() == (spread < 1e-3), label
    room = make_scene("room", 0, width=160, height=120)
    assert (flat_labels(room.surface_labels, room.normals) > 0).mean() > 0.5


def test_a_scene_and_a_frame_are_judged_on_recognised_planes_alone():
    scene = make_scene("room", 1, width=160, height=120)
    result = segment(scene.frame)
    found = planes_of_scene(scene, result)
    assert found.level == "planes" and found.labels is None and found.planes.matched > 2
    assert found.regions == sum(s.primitive.kind == "plane" for s in result.surfaces)
    pixels = sum(s.pixel_count for s in result.surfaces if s.primitive.kind == "plane")
    assert found.labelled == pytest.approx(pixels / scene.frame.valid.sum())
    recorded = SimpleNamespace(
        name="one", frame=scene.frame, kind="regions", truth_of=lambda level: scene.surface_labels
    )
    assert planes_of_frame(recorded, result).planes.matched >= found.planes.matched
    recorded.kind = "objects"
    assert planes_of_frame(recorded, result).planes is None


def test_pooled_counts_are_sums_and_figures_means():
    scene = make_scene("room", 1, width=160, height=120)
    one = planes_of_scene(scene, segment(scene.frame))
    both = pool("room", [one, one]).row()
    assert both["matched"] == 2 * one.planes.matched and both["truth_planes"] == 2 * one.planes.truth_planes
    assert both["panoptic"] == pytest.approx(one.planes.panoptic)
    assert both["under_ratio"] == pytest.approx(one.planes.under / one.planes.machine_planes)
    empty = replace(one, planes=evaluate_planes(stripes((5, 0)), stripes((5, 0))))
    assert np.isnan(empty.row()["panoptic"]), "no plane, and none was found"
    assert pool("room", [one, empty]).row()["panoptic"] == pytest.approx(one.planes.panoptic)
