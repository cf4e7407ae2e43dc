"""The configuration: round trips, every bound, errors that name the key, the value and what is allowed."""

import dataclasses

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from rcseg_core import ConfigError, RcsegError, SegmenterConfig
from rcseg_core.config import PRESETS, GroupingConfig, SeedsConfig, describe

PARAMETERS = {p.key: p for p in describe(SegmenterConfig())}
NUMBERS = [key for key, p in PARAMETERS.items() if p.type in (int, float)]
CHOICES = [key for key, p in PARAMETERS.items() if p.choices]
BOOLS = [key for key, p in PARAMETERS.items() if p.type is bool]
WINDOWS = [key for key in NUMBERS if key.endswith("_window")]


def refused(key, value):
    """The message with which a value is refused; it must name the key and the value."""
    with pytest.raises(ConfigError) as error:
        SegmenterConfig().replace({key: value})
    text = str(error.value)
    assert key in text and repr(value) in text
    assert "\n" not in text
    return text


def legal(parameter):
    """A strategy of values that a parameter takes."""
    if parameter.choices:
        return st.sampled_from(parameter.choices)
    if parameter.type is bool:
        return st.booleans()
    if parameter.key.endswith("_window"):
        return st.integers(parameter.low // 2, (parameter.high - 1) // 2).map(lambda k: 2 * k + 1)
    if parameter.type is int:
        return st.integers(int(parameter.low), int(parameter.high))
    return st.floats(parameter.low, parameter.high)


def together(changes):
    """Without what is refused although each value is within its bounds."""
    if changes.get("seeds.min_window", 3) > changes.get("seeds.max_window", 11):
        changes = {k: v for k, v in changes.items() if not k.startswith("seeds.m")}
    if not any(changes.get(f"world.up_{axis}", float(axis == "y")) for axis in "xyz"):
        changes = changes | {"world.up_from": "floor"}
    return changes


configs = st.fixed_dictionaries({}, optional={key: legal(p) for key, p in PARAMETERS.items()}).map(together)


def test_an_up_that_points_nowhere_is_refused_where_it_is_used():
    zero = {f"world.up_{axis}": 0.0 for axis in "xyz"}
    SegmenterConfig().replace(zero)
    with pytest.raises(ConfigError, match=r"world\.up_x"):
        SegmenterConfig().replace({**zero, "world.up_from": "parameter"})


def test_every_parameter_is_described():
    for parameter in PARAMETERS.values():
        assert parameter.doc and parameter.value == parameter.default
        assert type(parameter.default) is parameter.type
        if parameter.type in (int, float):
            assert parameter.low <= parameter.default <= parameter.high
            assert parameter.unit or not parameter.key.endswith(("_m", "_px"))
        if parameter.choices:
            assert parameter.default in parameter.choices


@settings(max_examples=60, deadline=None)
@given(configs)
def test_round_trips_lose_nothing(changes):
    config = SegmenterConfig().replace(changes)
    nested = config.to_dict()
    assert SegmenterConfig.from_dict(nested) == config
    assert SegmenterConfig.from_dict(yaml.safe_load(yaml.safe_dump(nested))) == config
    flat = {p.key: p.value for p in describe(config)}
    assert SegmenterConfig().replace(flat) == config
    assert SegmenterConfig().replace({key: str(value) for key, value in flat.items()}) == config
    for key, value in changes.items():
        assert flat[key] == value


@pytest.mark.parametrize("key", NUMBERS)
def test_bounds_are_enforced_on_both_sides(key):
    parameter = PARAMETERS[key]
    config = SegmenterConfig()
    for bound in (parameter.low, parameter.high):
        value = parameter.type(bound)
        if key in WINDOWS and value % 2 == 0:
            continue
        if key == "seeds.min_window" and value > config.seeds.max_window:
            config = config.replace({"seeds.max_window": value})
        if key == "seeds.max_window":
            config = config.replace({"seeds.min_window": 3})
        assert getattr(getattr(config.replace({key: value}), key.split(".")[0]), key.split(".")[1]) == value
    step = 2 if parameter.type is int else 1e-3 * (parameter.high - parameter.low)
    for value in (parameter.type(parameter.low - step), parameter.type(parameter.high + step)):
        text = refused(key, value)
        assert str(parameter.low) in text and str(parameter.high) in text


@pytest.mark.parametrize("key", [key for key in NUMBERS if PARAMETERS[key].type is float])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), "nan"])
def test_numbers_that_are_none_are_refused(key, value):
    with pytest.raises(ConfigError, match=key):
        SegmenterConfig().replace({key: value})


@pytest.mark.parametrize("key", WINDOWS)
def test_windows_are_odd(key):
    assert "odd" in refused(key, 4)


@pytest.mark.parametrize("key", CHOICES)
def test_choices_are_listed_when_another_is_asked_for(key):
    text = refused(key, "of course")
    for choice in PARAMETERS[key].choices:
        assert choice in text
        assert SegmenterConfig().replace({key: choice})


@pytest.mark.parametrize("key", list(PARAMETERS))
@pytest.mark.parametrize("value", [None, [], {}, object, b"3"])
def test_wrong_types_are_refused(key, value):
    assert "expected" in refused(key, value)


@pytest.mark.parametrize("key", NUMBERS)
def test_a_truth_value_is_no_number(key):
    refused(key, True)


@pytest.mark.parametrize("key", [key for key in NUMBERS if PARAMETERS[key].type is int])
def test_a_fraction_is_no_whole_number(key):
    refused(key, 5.5)
    refused(key, 5.0)
    refused(key, "5.5")


@pytest.mark.parametrize("key", BOOLS)
def test_truth_values_have_words(key):
    group, name = key.split(".")
    for words, wanted in (
        (("true", "Yes", "on", "1", True), True),
        (("false", "NO", "off", "0", False), False),
    ):
        for word in words:
            assert getattr(getattr(SegmenterConfig().replace({key: word}), group), name) is wanted
    refused(key, "maybe")
    refused(key, 1)


def test_whole_numbers_may_stand_for_others():
    assert SegmenterConfig().replace({"grouping.color_tolerance": 20}).grouping.color_tolerance == 20.0
    assert SegmenterConfig().replace({"seeds.subsets": "300"}).seeds.subsets == 300


@pytest.mark.parametrize(
    ("key", "hint"),
    [
        ("grouping.range_tolerence", "did you mean grouping.range_tolerance?"),
        ("range_tolerance", "did you mean"),
        ("nothing.like.it.at.all", "`rcseg config` lists all parameters"),
    ],
)
def test_unknown_keys_are_named_with_a_hint(key, hint):
    with pytest.raises(ConfigError) as error:
        SegmenterConfig().replace({key: 1})
    assert key in str(error.value) and hint in str(error.value)


@pytest.mark.parametrize(
    ("nested", "text"),
    [
        ({"grouping": {"colour_tolerance": 3.0}}, "grouping.colour_tolerance"),
        ({"groups": {"color_tolerance": 3.0}}, "groups.color_tolerance"),
        ({"grouping": None}, "grouping: expected a mapping of parameters, got None"),
        ({"grouping": 3}, "grouping: expected a mapping of parameters, got 3"),
        ([1, 2], "a configuration is a mapping of groups, got list"),
        (None, "a configuration is a mapping of groups, got NoneType"),
        (
            {"seeds": {"min_window": 9, "max_window": 5}},
            "seeds.min_window = 9 is larger than seeds.max_window = 5",
        ),
        ({3: {4: 5}}, "unknown parameter 3.4"),
    ],
)
def test_nested_mistakes_are_named(nested, text):
    with pytest.raises(ConfigError, match=text.replace(".", r"\.")):
        SegmenterConfig.from_dict(nested)


def test_groups_made_by_hand_are_checked_too():
    with pytest.raises(ConfigError, match=r"grouping\.range_tolerance = 7\.0"):
        SegmenterConfig(grouping=GroupingConfig(range_tolerance=7.0))
    with pytest.raises(ConfigError, match=r"seeds\.fit = 'best'"):
        SegmenterConfig(seeds=SeedsConfig(fit="best"))


def test_nothing_can_be_changed_in_place():
    config = SegmenterConfig()
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.grouping.range_tolerance = 0.1
    config.to_dict()["grouping"]["range_tolerance"] = 0.1
    assert config == SegmenterConfig()
    assert hash(config) == hash(SegmenterConfig())


def test_the_literal_form_departs_wherever_there_is_a_switch():
    literal = SegmenterConfig.literal()
    assert literal.signal.kind == "xyz"
    assert literal.grouping.order == "joint"
    assert literal.grouping.criterion == "bayes"
    assert not literal.grouping.edge_gate
    assert literal.seeds.fit == "lms"
    assert literal.generalization.hypothesis == "region"
    assert literal.generalization.test == "f"
    assert literal.generalization.alpha == 0.1
    assert literal.seeds.max_window == 11 and literal.seeds.min_window == 3


def test_presets_are_the_default_and_what_their_table_changes():
    assert list(PRESETS) == ["fast", "balanced", "accurate"]
    assert SegmenterConfig.preset("balanced") == SegmenterConfig()
    for name, changes in PRESETS.items():
        values = {p.key: p.value for p in describe(SegmenterConfig.preset(name))}
        differing = {key: value for key, value in values.items() if value != PARAMETERS[key].default}
        assert differing == dict(changes), f"{name}: a change that changes nothing, or one too many"
    assert SegmenterConfig.preset("fast") != SegmenterConfig.preset("accurate")


@pytest.mark.parametrize("name", ["quick", "Fast", "", None, ["fast"]])
def test_an_unknown_preset_is_refused_with_the_names_of_all(name):
    with pytest.raises(ConfigError, match="expected one of fast, balanced, accurate") as error:
        SegmenterConfig.preset(name)
    assert repr(name) in str(error.value)


def test_a_mapping_goes_over_its_base():
    base = SegmenterConfig.preset("fast")
    config = SegmenterConfig.from_dict({"grouping": {"max_gap": 2}}, base)
    assert config == base.replace({"grouping.max_gap": 2})


def test_errors_are_one_family():
    assert issubclass(ConfigError, RcsegError) and issubclass(RcsegError, ValueError)
