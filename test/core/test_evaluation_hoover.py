"""Hoover's classes against an independent oracle, and by hand for every class."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from oracle import naive_hoover

from rcseg_core.errors import InputError
from rcseg_core.evaluation.hoover import TOLERANCES, classify, contingency, sweep

labels_image = arrays(np.int32, (6, 7), elements=st.integers(0, 4))


def stripes(*widths_and_labels, height=10):
    """A label image of vertical stripes: (width, label) pairs."""
    row = np.concatenate([np.full(width, label) for width, label in widths_and_labels])
    return np.tile(row, (height, 1)).astype(np.int32)


def classes(truth, machine, tolerance=0.8):
    result = classify(contingency(truth, machine), tolerance)
    return result.truth_class, result.machine_class


@given(labels_image, labels_image, st.sampled_from([0.51, 0.6, 0.75, 0.8, 0.9, 1.0]))
@settings(max_examples=300, deadline=None)
def test_classes_are_those_of_the_oracle(truth, machine, tolerance):
    table = contingency(truth, machine)
    result = classify(table, tolerance)
    wanted = naive_hoover.classify(naive_hoover.regions(truth), naive_hoover.regions(machine), tolerance)
    assert dict(zip(table.truth_ids.tolist(), result.truth_class, strict=True)) == wanted[0]
    assert dict(zip(table.machine_ids.tolist(), result.machine_class, strict=True)) == wanted[1]


@given(labels_image, arrays(bool, (6, 7)), st.integers(0, 2**31))
@settings(max_examples=200, deadline=None)
def test_merged_and_split_images_match_the_oracle(truth, split, seed):
    """Machine labels made from the truth by merging and splitting, where every class is frequent."""
    rng = np.random.default_rng(seed)
    machine = rng.integers(0, 4, 5)[truth] * 2 + split.astype(np.int32)
    table = contingency(truth, machine)
    for tolerance in (0.51, 0.7, 0.8):
        result = classify(table, tolerance)
        wanted = naive_hoover.classify(naive_hoover.regions(truth), naive_hoover.regions(machine), tolerance)
        assert list(result.truth_class) == [wanted[0][n] for n in table.truth_ids.tolist()]
        assert list(result.machine_class) == [wanted[1][m] for m in table.machine_ids.tolist()]


@given(labels_image, labels_image)
@settings(max_examples=100, deadline=None)
def test_every_region_is_in_one_class_and_instances_share_none(truth, machine):
    table = contingency(truth, machine)
    for result in sweep(table):
        assert len(result.truth_class) == len(table.truth_ids)
        assert result.correct + result.over + result.under + result.missed == result.truth_regions
        truths = [n for instance in result.instances for n in instance.truth]
        machines = [m for instance in result.instances for m in instance.machine]
        assert len(truths) == len(set(truths))
        assert len(machines) == len(set(machines))
        assert result.noise == len(table.machine_ids) - len(machines)
        assert result.correct <= result.matched


def test_equal_images_are_all_correct_whatever_the_numbers():
    truth = stripes((10, 1), (20, 2), (5, 7))
    machine = stripes((10, 30), (20, 4), (5, 9))
    for result in sweep(contingency(truth, machine), (*TOLERANCES, 1.0)):
        assert (result.correct, result.noise, result.matched) == (3, 0, 3)


def test_correct_holds_up_to_the_tolerance_and_no_further():
    truth = stripes((10, 1), (10, 2))
    assert classes(truth, stripes((8, 1), (12, 2)), 0.8)[0] == ("correct", "correct")
    assert classes(truth, stripes((8, 1), (12, 2)), 0.81)[0] == ("missed", "correct")


def test_over_segmentation():
    truth_class, machine_class = classes(stripes((30, 5)), stripes((10, 1), (10, 2), (10, 3)))
    assert truth_class == ("over",)
    assert machine_class == ("over",) * 3


def test_under_segmentation():
    truth_class, machine_class = classes(stripes((10, 1), (10, 2), (10, 3)), stripes((30, 5)))
    assert truth_class == ("under",) * 3
    assert machine_class == ("under",)


def test_missed_and_noise():
    truth = stripes((10, 1), (10, 0), (10, 2))
    machine = stripes((10, 1), (10, 4), (10, 0))
    assert classes(truth, machine) == (("correct", "missed"), ("correct", "noise"))


def test_parts_that_cover_too_little_are_noise_and_the_truth_is_missed():
    truth_class, machine_class = classes(stripes((30, 1)), stripes((7, 1), (7, 2), (16, 0)))
    assert truth_class == ("missed",)
    assert machine_class == ("noise", "noise")


def test_over_wins_when_the_parts_explain_more_than_the_pair():
    """Region 1 is found as a pair, (.7 + 1)/2, and as two parts, (1 + 1)/2."""
    table = contingency(stripes((10, 1)), stripes((7, 1), (3, 2)))
    result = classify(table, 0.6)
    assert result.truth_class == ("over",)
    assert result.machine_class == ("over", "over")
    assert result.matched == 1


def test_a_part_that_lies_half_elsewhere_is_no_part():
    truth = stripes((100, 1), (30, 2))
    machine = stripes((99, 1), (2, 3), (29, 2))
    assert classes(truth, machine, 0.51)[0] == ("correct", "correct")
    machine[:4, 100] = 2  # 10 of its 16 pixels in region 1: (1 + 1000/1006)/2 > (.99 + 1)/2
    assert classes(truth, machine, 0.51)[0] == ("over", "correct")


def test_correct_wins_when_the_parts_explain_less_than_the_pair():
    """Pair: (55/100 + 1)/2 = .775. Parts: (60/100 + 60/64)/2 = .769, as the second leaks into region 2."""
    truth = stripes((100, 1), (50, 2))
    machine = stripes((55, 1), (40, 0), (9, 3), (46, 2))
    truth_class, machine_class = classes(truth, machine, 0.52)
    assert truth_class == ("correct", "correct")
    assert machine_class == ("correct", "correct", "noise")


def test_under_wins_against_correct_and_leaves_the_loser_without_a_class():
    truth = stripes((70, 1), (30, 2))
    assert classes(truth, stripes((100, 1)), 0.6) == (("under", "under"), ("under",))


def test_unlabelled_pixels_lower_the_overlap():
    truth = stripes((10, 1))
    assert classes(truth, stripes((8, 1), (2, 0)))[0] == ("correct",)
    assert classes(truth, stripes((7, 1), (3, 0)))[0] == ("missed",)


def test_pixels_outside_the_mask_are_nobodys():
    truth, machine = stripes((10, 1), (10, 2)), stripes((5, 1), (15, 2))
    mask = stripes((5, 1), (5, 0), (10, 1)).astype(bool)
    assert classify(contingency(truth, machine, mask), 1.0).correct == 2


def test_crumbs_become_unlabelled_pixels():
    table = contingency(stripes((20, 1)), stripes((17, 1), (2, 2), (1, 3)))
    solid = table.without_crumbs(20)
    assert solid.machine_ids.tolist() == [1, 2]
    assert solid.counts.tolist() == [[0, 0, 0], [10, 170, 20]]
    assert table.without_crumbs(21).counts.tolist() == [[0, 0], [30, 170]]


@pytest.mark.parametrize("tolerance", [0.5, 0.0, 1.01, float("nan")])
def test_a_tolerance_that_makes_no_sense_is_refused(tolerance):
    with pytest.raises(InputError, match="tolerance"):
        classify(contingency(stripes((3, 1)), stripes((3, 1))), tolerance)


def test_bad_labels_are_refused_by_name():
    good = stripes((3, 1))
    with pytest.raises(InputError, match="machine labels: expected integers, got float64"):
        contingency(good, good.astype(float))
    with pytest.raises(InputError, match=r"truth labels.*-1"):
        contingency(-good, good)
    with pytest.raises(InputError, match="one pixel grid"):
        contingency(good, good[:2])
