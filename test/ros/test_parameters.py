"""Parameters: the whole config with descriptors, taken between two frames and as whole sets, or refused
with a reason."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
import yaml

from rcseg_core import SegmenterConfig
from rcseg_core.config import PRESETS, describe
from rcseg_ros.options import NODE_PARAMETERS, all_parameters, default_yaml

ROOT = Path(__file__).parents[2]
stamps = itertools.count(1_720_000_000_000_000_000, 1_000_000_000)


def test_the_default_file_is_up_to_date():
    assert (ROOT / "config/default.yaml").read_text() == default_yaml(), (
        "run: python -m rcseg_ros.options > config/default.yaml"
    )


def test_the_default_file_gives_the_defaults():
    values = yaml.safe_load(default_yaml())["/**"]["ros__parameters"]
    algorithm = {g.key.split(".")[0] for g in describe(SegmenterConfig())}
    assert SegmenterConfig.from_dict({g: v for g, v in values.items() if g in algorithm}) == SegmenterConfig()
    for parameter in NODE_PARAMETERS:
        value = values
        for part in parameter.key.split("."):
            value = value[part]
        assert (tuple(value) if isinstance(value, list) else value) == parameter.default
        assert type(value) is (list if parameter.type is tuple else parameter.type)


@pytest.mark.parametrize("path", sorted((ROOT / "config").rglob("*.yaml")), ids=lambda p: p.stem)
def test_every_file_in_config_holds_known_parameters_within_bounds(path):
    values = yaml.safe_load(path.read_text())
    if "/**" not in values:
        pytest.skip("not a parameter file")
    known = {p.key: p for p in all_parameters()}
    changes = {}
    for group, content in values["/**"]["ros__parameters"].items():
        for name, value in content.items() if isinstance(content, dict) else [(None, content)]:
            key = f"{group}.{name}" if name else group
            parameter = known[key]
            expected = list if parameter.type is tuple else parameter.type
            assert type(value) is expected, f"{key} = {value!r}: ROS wants exactly {expected.__name__}"
            if parameter.choices and parameter.type is str:
                assert value in parameter.choices
            if key in {p.key for p in describe(SegmenterConfig())}:
                changes[key] = value
    SegmenterConfig().replace(changes)


def test_every_parameter_is_declared_with_its_descriptor(live, peer):
    from rcl_interfaces.srv import DescribeParameters

    parameters = all_parameters()
    request = DescribeParameters.Request(names=[p.key for p in parameters])
    descriptors = peer.call(DescribeParameters, "describe_parameters", request).descriptors
    for parameter, descriptor in zip(parameters, descriptors, strict=True):
        assert descriptor.name == parameter.key
        assert descriptor.description.startswith(parameter.doc)
        assert parameter.unit in descriptor.description
        assert descriptor.read_only == (parameter.key in ("autostart", "preset"))
        ranges = [*descriptor.integer_range, *descriptor.floating_point_range]
        if parameter.type in (int, float):
            assert (ranges[0].from_value, ranges[0].to_value) == (parameter.low, parameter.high)
        if parameter.choices:
            assert all(choice in descriptor.additional_constraints for choice in parameter.choices)


def test_a_change_takes_effect_with_the_next_frame(live, peer):
    frame, stamp = live.scene(), next(stamps)
    peer.send(frame, stamp)
    before = live.image_array(peer.wait_for("labels", stamp))
    changes = {
        "grouping.color_tolerance": 120.0,
        "edges.color_threshold": 255.0,
        "absorption.min_region": 2000,
    }
    try:
        results = peer.set_parameters(**{k.replace(".", "__"): v for k, v in changes.items()})
        assert all(r.successful for r in results), results
        stamp = next(stamps)
        peer.send(frame, stamp)
        after = live.image_array(peer.wait_for("labels", stamp))
    finally:
        defaults = {p.key: p.default for p in all_parameters()}
        peer.set_parameters(**{k.replace(".", "__"): defaults[k] for k in changes})
    np.testing.assert_array_equal(after, live.expected_labels(frame, **changes))
    assert not np.array_equal(before, after), "the change was meant to show"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"grouping__range_tolerance": 2.0}, "out of range"),
        ({"grouping__range_tolerance": 1}, "out of range"),
        ({"grouping__range_tolerance": "wide"}, "expected 'Type.DOUBLE'"),
        ({"seeds__min_window": 3.5}, "expected 'Type.INTEGER'"),
        ({"sync__offset_ms": "later"}, "expected a number or auto"),
        ({"grouping__criterion": "guess"}, "expected one of bounded, chow, bayes"),
        ({"seeds__min_window": 4}, "expected an odd whole number from 3 to 31 px"),
        ({"seeds__min_window": 13}, "larger than seeds.max_window"),
        ({"qos__depth": 7}, "read at configure"),
        ({"sync__slop_ms": 7.0}, "read at configure"),
        ({"autostart": False}, "read-only"),
        ({"preset": "fast"}, "read-only"),
    ],
)
def test_refusals_give_the_reason_and_change_nothing(peer, changes, words):
    names = [name.replace("__", ".") for name in changes]
    before = peer.get_parameters(*names)
    (result,) = peer.set_parameters(**changes)
    assert not result.successful and words in result.reason
    assert peer.get_parameters(*names) == before


def test_whole_numbers_are_taken_for_numbers_and_the_other_way_round(run):
    """As users write them: `-p sync.slop_ms:=30`, `ros2 param set ... grouping.color_tolerance 20`."""
    given = {
        "autostart": False, "sync.slop_ms": 30, "qos.depth": 7.0, "edges.color_threshold": 40,
        "input.extrinsic_translation": [0, 0, 1], "sync.offset_ms": 12,
    }  # fmt: skip
    _, peer = run("whole", given, (), active=False)
    values = peer.get_parameters("sync.slop_ms", "qos.depth", "edges.color_threshold", "sync.offset_ms")
    assert [values[0].double_value, values[2].double_value, values[3].double_value] == [30.0, 40.0, 12.0]
    assert values[1].integer_value == 7
    (moved,) = peer.get_parameters("input.extrinsic_translation")
    assert list(moved.double_array_value) == [0.0, 0.0, 1.0]
    results = peer.set_parameters(
        sync__slop_ms=25,
        seeds__min_window=5.0,
        sync__offset_ms="auto",
        input__extrinsic_translation=[0, 1, 0],
    )
    assert all(r.successful for r in results), results
    assert peer.set_parameters_atomically(grouping__color_tolerance=21, sync__offset_ms=-3).successful
    assert peer.get_parameters("grouping.color_tolerance")[0].double_value == 21.0


def test_a_preset_fills_in_what_was_not_given(live, run):
    """At start: parameters that are given go before the preset, the preset before the defaults."""
    from rclpy.parameter import parameter_value_to_python

    key, value = next(iter(PRESETS["accurate"].items()))
    values = {p.key: p.value for p in describe(SegmenterConfig.preset("accurate"))}
    _, peer = run("preset", {"preset": "accurate", "grouping.max_gap": 2, "autostart": False}, active=False)
    expected = {**values, "grouping.max_gap": 2}
    found = [parameter_value_to_python(v) for v in peer.get_parameters(*expected)]
    assert dict(zip(expected, found, strict=True)) == expected and expected[key] == value
    assert peer.set_parameters(grouping__max_gap=4)[0].successful, "a preset fixes nothing"


def test_whole_groups_are_taken_or_refused_together(live, peer):
    windows = {"seeds__min_window": 13, "seeds__max_window": 15}
    refused = peer.set_parameters_atomically(**windows, grouping__criterion="guess")
    assert not refused.successful and "grouping.criterion" in refused.reason
    assert peer.get_parameters("seeds.min_window")[0].integer_value == 3
    try:
        assert peer.set_parameters_atomically(**windows).successful  # alone, min_window = 13 would be refused
        frame, stamp = live.scene(), next(stamps)
        peer.send(frame, stamp)
        labels = live.image_array(peer.wait_for("labels", stamp))
    finally:
        assert peer.set_parameters_atomically(seeds__min_window=3, seeds__max_window=11).successful
    expected = live.expected_labels(frame, **{"seeds.min_window": 13, "seeds.max_window": 15})
    np.testing.assert_array_equal(labels, expected)


def test_each_frame_is_segmented_under_one_whole_configuration(live, peer):
    """Sets that switch back and forth under load: every result is that of one set or of the other."""
    frame = live.scene()
    sets = [
        {"grouping.color_tolerance": 20.0, "absorption.min_region": 30},
        {"grouping.color_tolerance": 120.0, "absorption.min_region": 2000},
    ]
    allowed = [live.expected_labels(frame, **changes) for changes in sets]
    sent = [next(stamps) for _ in range(30)]
    for i, stamp in enumerate(sent):
        changes = {k.replace(".", "__"): v for k, v in sets[i % 2].items()}
        peer.send(frame, stamp)
        assert peer.set_parameters_atomically(**changes).successful
    peer.wait_for("labels", sent[-1])
    peer.set_parameters_atomically(grouping__color_tolerance=20.0, absorption__min_region=30)
    results = [m for m in peer.received["labels"] if live.stamp_of(m) in sent]
    assert len(results) > 1
    for message in results:
        labels = live.image_array(message)
        assert any(np.array_equal(labels, one) for one in allowed)
