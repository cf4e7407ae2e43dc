"""Agreement measures against an independent oracle; the conventions of evaluation; pooling."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from oracle import naive_hoover

from rcseg_core.datasets import LabelledFrame
from rcseg_core.errors import InputError
from rcseg_core.evaluation import agreement
from rcseg_core.evaluation.frames import (
    choose_labels,
    evaluate_frame,
    evaluate_labels,
    evaluate_parts,
    evaluate_reconstruction,
    evaluate_scene,
    one_background,
)
from rcseg_core.evaluation.hoover import contingency
from rcseg_core.evaluation.pooling import pool
from rcseg_core.synthetic import make_scene

labels_image = arrays(np.int32, (6, 7), elements=st.integers(0, 3))


@pytest.fixture(scope="module")
def scene():
    return make_scene("room", 3, width=160, height=120)


def result_of(labels, surface_labels=None, **more):
    return SimpleNamespace(
        labels=labels, surface_labels=labels if surface_labels is None else surface_labels, **more
    )


@given(
    arrays(np.int32, (5, 6), elements=st.integers(1, 3)), arrays(np.int32, (5, 6), elements=st.integers(0, 3))
)
@settings(max_examples=100, deadline=None)
def test_measures_are_those_of_the_oracle(truth, machine):
    metrics = evaluate_labels(truth, machine, minimum_area=1)
    split, merge = naive_hoover.information(truth.ravel().tolist(), machine.ravel().tolist())
    assert metrics.voi_split_bits == pytest.approx(split, abs=1e-12)
    assert metrics.voi_merge_bits == pytest.approx(merge, abs=1e-12)
    assert metrics.voi_bits == pytest.approx(split + merge, abs=1e-12)
    assert metrics.rand == pytest.approx(naive_hoover.rand(truth.ravel().tolist(), machine.ravel().tolist()))
    wanted = naive_hoover.covering(naive_hoover.regions(truth), naive_hoover.regions(machine))
    assert metrics.covering == pytest.approx(wanted)
    assert metrics.coverage == pytest.approx(np.mean(machine > 0))


@given(labels_image, labels_image, st.sampled_from([0.0, 1.0, 2.0]))
@settings(max_examples=100, deadline=None)
def test_boundary_recall_is_that_of_the_oracle(truth, machine, within):
    found = agreement.boundary_recall(truth, machine, np.ones(truth.shape, bool), within_px=within)
    wanted = naive_hoover.boundary_recall(truth.tolist(), machine.tolist(), within)
    assert found == pytest.approx(wanted, nan_ok=True)


def test_adjusted_rand_of_the_textbook():
    """Hubert & Arabie 1985, table 1 layout: computed by hand from the pair counts 7, 12, 18 of 66."""
    truth = np.array([[1] * 5 + [2] * 7], np.int32)
    machine = np.array([[1, 1, 1, 2, 2, 2, 2, 2, 2, 3, 3, 3]], np.int32)
    together = 3 + 1 + 6 + 3  # pairs in the cells 3, 2, 4, 3
    rows, cols = 10 + 21, 3 + 15 + 3
    expected = rows * cols / 66
    metrics = evaluate_labels(truth, machine, minimum_area=1)
    assert metrics.adjusted_rand == pytest.approx((together - expected) / ((rows + cols) / 2 - expected))
    assert metrics.rand == pytest.approx((66 + 2 * together - rows - cols) / 66)


def test_slivers_of_the_truth_are_nobodys():
    """A truth region below the least area may be absorbed or found: the figures are the same."""
    truth = np.ones((120, 160), np.int32)
    truth[:, 80:] = 2
    truth[10:12, 10:12] = 3  # 4 of 19200 pixels; the least area is 6.25
    absorbed = np.where(truth == 3, 1, truth)
    for machine in (truth, absorbed):
        metrics = evaluate_labels(truth, machine)
        assert metrics.truth_regions == 2
        assert metrics.at().correct == 2
        assert metrics.voi_bits == 0
        assert metrics.covering == 1


def test_invalid_pixels_are_nobodys():
    truth = np.ones((20, 20), np.int32)
    truth[:, 10:] = 2
    mask = np.ones(truth.shape, bool)
    mask[:, 8:12] = False
    machine = np.where(mask, truth, 5)
    metrics = evaluate_labels(truth, machine, mask=mask, minimum_area=1)
    assert (metrics.at().correct, metrics.at().noise, metrics.machine_regions) == (2, 0, 2)
    assert metrics.voi_bits == 0


def test_a_crumb_is_counted_but_does_not_break_its_region():
    truth = np.ones((100, 100), np.int32)
    truth[:, 50:] = 2
    machine = truth.copy()
    machine[5, 5] = 9
    metrics = evaluate_labels(truth, machine, minimum_area=10)
    assert (metrics.at().correct, metrics.at().noise, metrics.crumbs) == (2, 0, 1)
    assert metrics.voi_bits > 0
    machine[20:30, 20:30] = 10
    assert evaluate_labels(truth, machine, minimum_area=10).at().over == 1


def test_nothing_to_compare_with_is_said():
    with pytest.raises(InputError, match="no region of at least"):
        evaluate_labels(np.zeros((9, 9), np.int32), np.ones((9, 9), np.int32))


def test_a_tolerance_outside_the_sweep_is_said():
    metrics = evaluate_labels(np.ones((9, 9), np.int32), np.ones((9, 9), np.int32), tolerances=(0.8, 0.9))
    with pytest.raises(InputError, match=r"0\.75 was not evaluated; the sweep holds 0\.8, 0\.9"):
        metrics.at(0.75)


# ---- parts of objects


def table_and_box():
    """A table (label 1) with one box of 40 x 40 px (label 20)."""
    truth = np.ones((120, 160), np.int32)
    truth[40:80, 60:100] = 20
    return truth


def test_faces_of_an_object_are_its_parts():
    truth = table_and_box()
    machine = truth.copy()
    machine[40:60, 60:100] = 21
    metrics = evaluate_parts(truth, machine, background=(1,))
    assert metrics.objects == 1
    assert (metrics.parts_per_object, metrics.raw_parts_per_object) == (2, 2)
    assert (metrics.purity, metrics.boundary_recall, metrics.coverage) == (1, 1, 1)
    assert metrics.best_iou == 0.5


def test_crumbs_count_by_their_area():
    """s is 1 % of the box, 16 px: the crumbs of 8, 4 and 1 px count 13/16 together."""
    truth = table_and_box()
    machine = truth.copy()
    machine[50, 70:78], machine[60, 70:74], machine[65, 70] = 31, 32, 33
    metrics = evaluate_parts(truth, machine, background=(1,))
    assert metrics.parts_per_object == pytest.approx(1 + 13 / 16)
    assert metrics.raw_parts_per_object == 4


@given(st.integers(0, 2**31), st.integers(1, 40))
@settings(max_examples=60, deadline=None)
def test_neither_crumbs_nor_holes_lower_the_parts(seed, cells):
    """Breaking a part up or leaving some of it unlabelled is never an improvement."""
    rng = np.random.default_rng(seed)
    truth = table_and_box()
    machine = truth.copy()
    machine[40:60, 60:100] = 21
    before = evaluate_parts(truth, machine, background=(1,)).parts_per_object
    pieces = np.where(truth == 20, rng.integers(0, cells, truth.shape), 0)
    broken = np.where(truth == 20, machine * 100 + pieces, machine)
    assert evaluate_parts(truth, broken, background=(1,)).parts_per_object >= before - 1e-9
    holes = np.where((truth == 20) & (rng.random(truth.shape) < 0.4), 0, machine)
    assert evaluate_parts(truth, holes, background=(1,)).parts_per_object >= before - 1e-9


def test_a_swallowed_object_counts_one_part_and_costs_purity():
    truth = table_and_box()
    metrics = evaluate_parts(truth, np.ones_like(truth), background=(1,))
    assert metrics.parts_per_object == 1
    assert metrics.raw_parts_per_object == 0
    assert metrics.purity == pytest.approx(1 - 1600 / truth.size)
    assert metrics.best_iou == pytest.approx(1600 / truth.size)
    assert metrics.boundary_recall == 0


def test_borders_within_two_pixels_are_found():
    truth = table_and_box()
    for shift, recall in ((2, 1.0), (6, 0.5)):
        machine = np.roll(truth, shift, axis=1)
        assert evaluate_parts(truth, machine, background=(1,)).boundary_recall == pytest.approx(
            recall, abs=0.1
        )


def test_borders_of_invalid_pixels_are_no_borders():
    truth = table_and_box()
    mask = np.ones(truth.shape, bool)
    mask[:, 59:61] = False
    machine = np.where(mask, truth, 0)
    assert agreement.boundary_recall(truth, machine, mask) == 1
    assert not agreement.borders(machine, mask)[50, 61]
    assert agreement.borders(machine, np.ones_like(mask))[50, 61]


def test_only_background_is_said():
    with pytest.raises(InputError, match="no object"):
        evaluate_parts(np.ones((30, 30), np.int32), np.ones((30, 30), np.int32), background=(1,))


# ---- scenes and frames


def test_truth_as_labels_is_perfect(scene):
    for level, truth in (("regions", scene.labels), ("surfaces", scene.surface_labels)):
        metrics = evaluate_scene(scene, result_of(scene.labels, scene.surface_labels), level=level)
        assert metrics.name == "room_003"
        assert metrics.labels.at(0.95).correct == metrics.labels.truth_regions
        assert metrics.labels.voi_bits == 0
        assert metrics.regions == truth.max()
        assert metrics.reconstruction is None


def test_halving_the_image_over_segments_what_it_cuts(scene):
    cut = scene.labels.copy()
    cut[:, 80:] += 1000
    result = evaluate_scene(scene, result_of(cut)).labels.at()
    inside = evaluate_scene(scene, result_of(scene.labels)).labels.at()
    assert result.over > 0
    assert result.correct + result.over == inside.correct


def test_reconstruction_error_is_in_sigmas_and_levels(scene):
    points, color = scene.clean_points.copy(), scene.clean_color.astype(np.uint8)
    points[..., 2] += 0.5 * scene.sigma_range
    metrics = evaluate_reconstruction(points, np.clip(color + np.uint8(7), 7, 255), scene)
    assert metrics.depth_error_sigmas == pytest.approx(0.5, rel=1e-3)
    assert metrics.depth_rms_sigmas == pytest.approx(0.5, rel=1e-3)
    assert metrics.color_error_levels == pytest.approx(7, abs=1)
    assert metrics.completeness == 1
    points[:60] = np.nan
    half = evaluate_reconstruction(points, color, scene)
    assert half.completeness == pytest.approx(0.5)
    assert half.depth_error_sigmas == pytest.approx(0.5, rel=1e-3)


def test_the_measured_frame_itself_errs_by_the_noise(scene):
    """|error| / sigma of Gaussian noise has the median .6745: the truth's sigma is the noise's."""
    metrics = evaluate_reconstruction(scene.frame.points, scene.frame.color, scene)
    assert metrics.depth_error_sigmas == pytest.approx(0.6745, abs=0.02)
    assert metrics.depth_rms_sigmas == pytest.approx(1.0, abs=0.03)


def test_an_empty_reconstruction_is_no_error(scene):
    metrics = evaluate_reconstruction(np.full_like(scene.clean_points, np.nan), scene.frame.color, scene)
    assert metrics.completeness == 0
    assert np.isnan(metrics.depth_error_sigmas)


def test_the_kind_of_truth_decides_the_figures(scene):
    frame = LabelledFrame("a", scene.frame, scene.object_labels, "objects", (1, 2, 3, 4))
    result = result_of(scene.labels, scene.surface_labels)
    metrics = evaluate_frame(frame, result)
    assert metrics.labels is None
    assert metrics.parts.purity == 1
    assert metrics.parts.parts_per_object > 1
    metrics = evaluate_frame(replace(frame, kind="regions", truth=scene.labels), result, level="regions")
    assert metrics.parts is None
    assert metrics.labels.at().missed == 0
    assert metrics.row()["missed"] == 0 and metrics.row()["correct"] == metrics.labels.at().correct > 10
    metrics = evaluate_frame(replace(frame, truth=None), result)
    assert metrics.labels is None and "missed" not in metrics.row()
    assert metrics.parts is None
    assert metrics.labelled == 1
    with pytest.raises(InputError, match="'surfaces' or 'objects'"):
        evaluate_frame(frame, result, level="colours")


def test_objects_are_compared_with_one_background():
    """Walls and floor are one label on both sides; half of one of two objects is lost to it."""
    truth = np.array([[1, 1, 2, 2, 3, 3, 4, 4]] * 8, np.int32)
    machine = np.array([[0, 0, 0, 0, 1, 1, 2, 0]] * 8, np.int32)
    result = SimpleNamespace(labels=truth, surface_labels=truth, object_labels=machine)
    labels = choose_labels(result, "objects")
    assert labels[0].tolist() == [3, 3, 3, 3, 1, 1, 2, 3]
    single, background = one_background(truth, (1, 2))
    assert single[0].tolist() == [1, 1, 1, 1, 3, 3, 4, 4] and background == (1,)
    parts = evaluate_parts(single, labels, background=background, minimum_area=1)
    assert parts.objects == 2 and parts.best_iou == pytest.approx(0.75) and parts.whole == 0.5
    assert one_background(truth, ())[1] == ()


# ---- pooling


def test_pooling_sums_regions_and_averages_the_rest(scene):
    perfect = evaluate_scene(scene, result_of(scene.labels))
    nothing = evaluate_scene(scene, result_of(np.ones_like(scene.labels)))
    pooled = pool("room", [perfect, nothing])
    regions = perfect.labels.truth_regions
    assert pooled.counts[0.8]["truth_regions"] == 2 * regions
    assert pooled.correct() == pytest.approx(0.5)
    assert pooled.means["voi_bits"] == pytest.approx(nothing.labels.voi_bits / 2)
    assert pooled.row()["correct_share"] == pooled.correct()


def test_pooling_weights_objects_and_skips_what_is_not_there(scene):
    truth = table_and_box()
    one = evaluate_parts(truth, truth, background=(1,))
    two = replace(one, objects=3, best_iou=0.2, boundary_recall=float("nan"))
    base = evaluate_scene(scene, result_of(scene.labels))
    frames = [replace(base, labels=None, parts=parts) for parts in (one, two)]
    pooled = pool("objects", frames)
    assert pooled.means["best_iou"] == pytest.approx((1.0 + 3 * 0.2) / 4)
    assert pooled.means["boundary_recall"] == 1
    assert np.isnan(pooled.correct())


def test_the_table_keeps_every_pixel(scene):
    table = contingency(scene.labels, scene.surface_labels)
    assert table.counts.sum() == scene.labels.size
    assert (table.truth_sizes == np.bincount(scene.labels.ravel())[table.truth_ids]).all()
    assert (table.machine_sizes == np.bincount(scene.surface_labels.ravel())[table.machine_ids]).all()
