"""segment() on scenes with truth and on input that is hard: what it promises holds for every frame."""

import time

import numpy as np
import pytest
from oracle.invariants import check_invariants

from rcseg_core import (
    ConfigError,
    InputError,
    PinholeCamera,
    RangeColorFrame,
    SegmenterConfig,
    pipeline,
    segment,
)
from rcseg_core.evaluation.frames import evaluate_labels
from rcseg_core.partition.parting import split_creases
from rcseg_core.partition.partition import Partition
from rcseg_core.signal.edges import ORIENTATION
from rcseg_core.signal.signals import MISFIT, build_signals
from rcseg_core.stages import linking, passes
from rcseg_core.synthetic import FAMILIES, make_scene

SMALL = {"width": 160, "height": 120}
DEFAULT = SegmenterConfig()
CONFIGS = {
    "default": DEFAULT,
    "joint": DEFAULT.replace({"grouping.order": "joint"}),
    "range_only": DEFAULT.replace({"grouping.order": "range_only"}),
    "literal": SegmenterConfig.literal(),
}


def found(truth, labels, mask=None):
    """(correctly detected, truth regions) at 80 % overlap, slivers left out as in the reports."""
    counts = evaluate_labels(truth, labels, mask=mask).at(0.8).counts()
    return counts["correct"], counts["truth_regions"]


def camera(height, width):
    return PinholeCamera(0.8 * width, 0.8 * width, (width - 1) / 2, (height - 1) / 2)


def frame(depth, color=None, *, scanner=False):
    depth = np.asarray(depth)
    color = np.full((*depth.shape, 3), 120, np.uint8) if color is None else color
    made = RangeColorFrame.from_depth(depth, color, camera(*depth.shape))
    return RangeColorFrame(made.points, color, None) if scanner else made


def noisy(shape, z=2.0, sigma=0.005, seed=0):
    return z + sigma * np.random.default_rng(seed).normal(size=shape)


def only(shape, where, z=2.0):
    """Depth z on some pixels, nothing elsewhere."""
    depth = np.full(shape, np.nan)
    depth[where] = z
    return depth


def scattered(seed=1):
    rng = np.random.default_rng(seed)
    return only((48, 64), (rng.integers(0, 48, 6), rng.integers(0, 64, 6)), rng.uniform(1, 3, 6))


RNG = np.random.default_rng(7)
HARD = {
    "three by three": np.full((3, 3), 2.0),
    "five by five": noisy((5, 5)),
    "one valid pixel": only((20, 30), (7, 9)),
    "a few valid pixels": scattered(),
    "one row": only((40, 64), np.s_[20]),
    "one column": only((40, 64), np.s_[:, 20]),
    "two rows far apart": only((40, 64), np.s_[[3, 30]]),
    "constant": np.full((48, 64), 2.0),
    "wide": noisy((16, 1280)),
    "tall": noisy((300, 8)),
    "every other pixel": np.where(np.add.outer(np.arange(48), np.arange(64)) % 2, 2.0, np.nan),
    "all outliers": RNG.uniform(0.5, 5, (48, 64)),
    "very far": noisy((32, 40), 1e6, 1.0),
    "very near": noisy((32, 40), 1e-6, 1e-9),
    "near and far": np.where(RNG.random((48, 64)) < 0.5, 1e-3, 1e4),
    "one pixel at infinity": np.where(np.arange(48 * 64).reshape(48, 64) == 1000, 1e30, 2.0),
    "one pixel at the lens": np.where(np.arange(48 * 64).reshape(48, 64) == 1000, 1e-30, 2.0),
    "float32": noisy((48, 64)).astype(np.float32),
}


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
@pytest.mark.parametrize("scanner", [False, True], ids=["camera", "scanner"])
@pytest.mark.parametrize("name", HARD)
def test_promises_hold_for_hard_frames(name, scanner, config):
    made = frame(HARD[name], scanner=scanner)
    check_invariants(segment(made, config), made)


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
def test_promises_hold_for_random_colours(config):
    color = RNG.integers(0, 256, (48, 64, 3)).astype(np.uint8)
    made = frame(noisy((48, 64)), color)
    check_invariants(segment(made, config), made)


@pytest.mark.parametrize("z", [1e-40, 1e200])
def test_depth_beyond_any_sensor_is_refused_or_handled(z):
    points = np.full((32, 40, 3), z)
    try:
        made = RangeColorFrame(points, np.zeros((32, 40, 3), np.uint8), camera(32, 40))
    except InputError:
        return
    check_invariants(segment(made), made)


@pytest.fixture(scope="module")
def scenes():
    return {family: make_scene(family, 101, **SMALL) for family in FAMILIES}


@pytest.fixture(scope="module")
def results(scenes):
    return {family: segment(scene.frame) for family, scene in scenes.items()}


@pytest.mark.parametrize("family", FAMILIES)
def test_promises_hold_for_every_family(scenes, results, family):
    check_invariants(results[family], scenes[family].frame, levels=(0, 0.3, 0.7, 1, 1.3, 2, 3, 5, 10, 30))


@pytest.mark.parametrize("family", FAMILIES)
def test_most_truth_regions_are_found(scenes, results, family):
    """A sixteenth of the pixels that the targets are set at; two thirds of the regions all the same."""
    scene = scenes[family]
    correct, regions = found(scene.labels, results[family].labels)
    assert correct >= 2 / 3 * regions


@pytest.mark.parametrize("family", ["room", "blocks", "curved"])
def test_the_reconstruction_is_nearer_to_the_truth_than_the_measurement(scenes, results, family):
    scene = scenes[family]
    points, _ = results[family].reconstruct()
    known = np.isfinite(points[..., 2]) & np.isfinite(scene.clean_points[..., 2]) & scene.frame.valid
    assert known.mean() > 0.95
    made = np.abs(points[..., 2] - scene.clean_points[..., 2])[known]
    measured = np.abs(scene.frame.depth_m - scene.clean_points[..., 2])[known]
    assert np.median(made) < 0.35 * np.median(measured)


def test_invalid_pixels_and_impulses_leave_the_regions_whole():
    scene = make_scene("room", 103, **SMALL, outliers=0.1, dropout=0.2)
    result = segment(scene.frame)
    check_invariants(result, scene.frame)
    correct, regions = found(scene.labels, result.labels, scene.frame.valid)
    assert correct >= 0.5 * regions


CHANGES = {
    "signal.kind": ("xyz", "inverse_depth"),
    "noise.range_model": ("constant", "law", "kinect_v1", "realsense_d435"),
    "noise.range_prior": ("kinect_v1", "realsense_d435"),
    "reflectance.mode": ("active",),
    "seeds.fit": ("lms",),
    "grouping.order": ("joint", "range_only"),
    "grouping.criterion": ("chow", "bayes"),
    "grouping.edge_gate": (False,),
    "generalization.hypothesis": ("region",),
    "generalization.test": ("f",),
    "generalization.creases": (False,),
    "borders.sharpen": (False,),
    "borders.flying": ("nearest", "unassigned"),
}


@pytest.mark.parametrize(
    ("key", "value"), [(key, value) for key, values in CHANGES.items() for value in values]
)
def test_every_choice_runs_and_finds_some_of_the_room(scenes, key, value):
    scene = scenes["room"]
    result = segment(scene.frame, DEFAULT.replace({key: value}))
    check_invariants(result, scene.frame)
    truth = scene.surface_labels if value == "range_only" else scene.labels
    correct, regions = found(truth, result.labels)
    least = {"bayes": 0.25, "lms": 0.5, "region": 0.4, "xyz": 0.4, "active": 0.1}.get(
        value, 0.6
    )  # passive light
    assert correct >= least * regions


def test_every_choice_of_the_configuration_is_tried():
    from rcseg_core.config import describe

    tried = {(key, value) for key, values in CHANGES.items() for value in values}
    for parameter in describe(DEFAULT):
        options = parameter.choices or ((True, False) if parameter.type is bool else ())
        for option in options:
            if option != parameter.default and (parameter.key, option) not in tried:
                # these have tests of their own below
                assert (parameter.key, option) in {
                    ("reflectance.mode", "calibrated"),
                    ("absorption.enabled", False),
                } or parameter.key == "world.up_from"  # labels do not depend on it: test_world_up


@pytest.mark.parametrize(
    "changes",
    [
        {"seeds.max_window": 31}, {"seeds.max_window": 3}, {"seeds.min_window": 11}, {"seeds.subsets": 1},
        {"seeds.min_valid": 0.1}, {"seeds.min_valid": 1.0}, {"grouping.range_tolerance": 0.0},
        {"grouping.range_tolerance": 0.5}, {"grouping.color_tolerance": 0.0},
        {"grouping.color_tolerance": 255.0},
        {"grouping.noise_share": 0.0}, {"grouping.relief_tolerance": 0.0}, {"grouping.relief_tolerance": 1.0},
        {"grouping.max_gap": 1}, {"grouping.max_gap": 15}, {"edges.outlier_threshold": 0.0},
        {"edges.orientation_window": 3}, {"edges.orientation_window": 15}, {"absorption.max_cost": 1e-9},
        {"absorption.refine_passes": 0}, {"absorption.small_region": 0}, {"absorption.min_region": 10000},
        {"absorption.speck": 1}, {"generalization.max_range_degree": 1},
        {"generalization.max_color_degree": 4},
        {"generalization.max_range_degree": 3, "generalization.max_color_degree": 1},
        {"generalization.test": "f", "generalization.alpha": 1e-6}, {"noise.color_sigma": 64.0},
        {"noise.range_model": "constant", "noise.range_sigma": 1.0},
        {"noise.range_model": "constant", "noise.range_sigma": 1e-7},
    ],
    ids=str,
)  # fmt: skip
def test_promises_hold_at_the_bounds_of_the_parameters(scenes, changes):
    check_invariants(segment(scenes["room"].frame, DEFAULT.replace(changes)), scenes["room"].frame)


@pytest.mark.parametrize("order", ["surfaces_first", "joint", "range_only"])
def test_promises_hold_without_absorption(scenes, order):
    config = DEFAULT.replace({"absorption.enabled": False, "grouping.order": order})
    result = segment(scenes["room"].frame, config)
    check_invariants(result, scenes["room"].frame)
    assert (result.labels == 0).any()


def test_a_calibrated_frame_needs_its_white_board(scenes):
    config = DEFAULT.replace({"reflectance.mode": "calibrated"})
    with pytest.raises(InputError, match="white-reference frame is needed"):
        segment(scenes["room"].frame, config)
    white = frame(np.full((120, 160), 1.5), np.full((120, 160, 3), 200, np.uint8))
    check_invariants(segment(scenes["room"].frame, config, white_reference=white), scenes["room"].frame)


@pytest.mark.parametrize("order", ["surfaces_first", "range_only", "joint"])
def test_a_pixel_that_fitted_nowhere_counts_for_no_final_model(monkeypatch, order):
    """Whichever pass found it out: what a pass marks is marked in the result."""
    seen, settle = [], passes.settle

    def spied(partition, signals, config):
        models = settle(partition, signals, config)
        seen.append(signals.flags.copy())
        return models

    monkeypatch.setattr(pipeline, "settle", spied)
    monkeypatch.setattr(linking, "settle", spied)
    scene = make_scene("room", 3, structured_light=True, width=320, height=240)
    result = segment(scene.frame, DEFAULT.replace({"grouping.order": order}))
    marked = np.bitwise_or.reduce(seen) & MISFIT != 0
    left = marked & (result.signals.flags & MISFIT != 0)
    assert marked.sum() > 50
    assert left.sum() >= 0.99 * marked.sum()
    # no region is left without a pixel that counts
    counting = np.bincount(result.labels[result.signals.flags == 0], minlength=result.labels.max() + 1)
    assert (counting[1:] > 0).all()


@pytest.mark.parametrize("order", ["surfaces_first", "range_only"])
def test_creases_that_were_found_are_edges_of_the_result(monkeypatch, order):
    seen = []

    def spied(*arguments):
        divided, creases = split_creases(*arguments)
        seen.append(creases)
        return divided, creases

    monkeypatch.setattr(passes, "split_creases", spied)
    scene = make_scene("blocks", 3, structured_light=True, width=320, height=240)
    result = segment(scene.frame, DEFAULT.replace({"grouping.order": order}))
    creases = np.bitwise_or.reduce(seen)
    assert (creases & ORIENTATION != 0).sum() > 50
    assert np.array_equal(result.edges & creases, creases)


def test_range_only_ignores_colour(scenes):
    scene = scenes["room"]
    other = RangeColorFrame(scene.frame.points, np.zeros_like(scene.frame.color), scene.frame.camera)
    config = DEFAULT.replace({"grouping.order": "range_only"})
    assert np.array_equal(segment(scene.frame, config).labels, segment(other, config).labels)


def test_regions_lie_on_the_surfaces_that_range_alone_gives(scenes, results):
    surfaces = segment(scenes["room"].frame, DEFAULT.replace({"grouping.order": "range_only"}))
    ours = results["room"].surface_labels
    correct, regions = found(surfaces.labels, ours)
    assert correct >= 0.7 * regions


def test_the_frame_is_not_touched(scenes):
    scene = scenes["room"]
    points, color = scene.frame.points.copy(), scene.frame.color.copy()
    segment(RangeColorFrame(points, color, scene.frame.camera), CONFIGS["literal"])
    assert np.array_equal(points, scene.frame.points, equal_nan=True)
    assert np.array_equal(color, scene.frame.color)


def layouts(array):
    """The same values read only, strided, reversed and in Fortran order."""
    wide = np.zeros((array.shape[0] * 2, *array.shape[1:]), array.dtype)
    wide[::2] = array
    frozen = array.copy()
    frozen.flags.writeable = False
    return {
        "read only": frozen,
        "every other row": wide[::2],
        "reversed channels": np.ascontiguousarray(array[..., ::-1])[..., ::-1],
        "fortran": np.asfortranarray(array),
    }


@pytest.mark.parametrize("layout", ["read only", "every other row", "reversed channels", "fortran"])
def test_the_layout_in_memory_does_not_matter(scenes, results, layout):
    scene = scenes["room"]
    made = RangeColorFrame(
        layouts(scene.frame.points)[layout], layouts(scene.frame.color)[layout], scene.frame.camera
    )
    result = segment(made)
    assert np.array_equal(result.labels, results["room"].labels)
    np.testing.assert_allclose(result.regions[0].centroid, results["room"].regions[0].centroid)


def test_float64_and_float32_points_give_the_same_labels(scenes, results):
    scene = scenes["room"]
    made = RangeColorFrame(scene.frame.points.astype(float), scene.frame.color, scene.frame.camera)
    result = segment(made)
    assert (result.labels == results["room"].labels).mean() > 0.999


@pytest.mark.parametrize("config", ["default", {"grouping": {}}, 3])
def test_a_configuration_is_one(scenes, config):
    with pytest.raises(ConfigError, match="config: expected a SegmenterConfig"):
        segment(scenes["room"].frame, config)


@pytest.mark.parametrize(("width", "height"), [(80, 60), (160, 120), (640, 480)])
def test_a_face_has_enough_pixels_for_its_shape_in_any_image(monkeypatch, width, height):
    """Areas scale with the image; the six coefficients of a quadric do not."""
    seen = []
    monkeypatch.setattr(
        passes, "split_creases", lambda partition, signals, least: seen.append(least) or (0, None)
    )
    frame = make_scene("blocks", 5, width=width, height=height).frame
    signals = build_signals(frame, frame.color, DEFAULT).range_only()
    partition = Partition(np.ones((height, width), np.int32), 1)
    config = DEFAULT.replace({"absorption.enabled": False})
    passes.divide_creases(partition, signals, np.zeros((height, width), np.uint8), config)
    assert seen[0] >= 12


@pytest.mark.parametrize("top", [1, 2, 3, 4])
@pytest.mark.parametrize("hypothesis", ["pair", "region"])
def test_the_highest_degree_is_one_that_grouping_tries(scenes, top, hypothesis):
    config = DEFAULT.replace(
        {"generalization.max_range_degree": top, "generalization.hypothesis": hypothesis}
    )  # fmt: skip
    frame = scenes["room"].frame
    signals = build_signals(frame, frame.color, config).range_only()
    tried = passes.degrees(config, signals)
    assert tried[0] == 1 and tried[-1] == top


@pytest.mark.parametrize("order", ["surfaces_first", "range_only", "joint"])
def test_each_stage_has_a_time_of_its_own(scenes, monkeypatch, order):
    """What links the signals and settles pixels is no part of the final models."""
    names = ("link_signals", "settle_flying", "fill_small_holes")
    during = []
    for name in names:
        inner = getattr(pipeline, name)

        def slow(*arguments, inner=inner):
            time.sleep(0.1)
            during.append(inner)
            return inner(*arguments)

        monkeypatch.setattr(pipeline, name, slow)
    result = segment(scenes["room"].frame, DEFAULT.replace({"grouping.order": order}))
    assert result.timings["link"] >= 0.1 * len(during)
    assert len(during) == 2


def test_no_configuration_is_the_default_one(scenes, results):
    assert np.array_equal(segment(scenes["room"].frame, DEFAULT).labels, results["room"].labels)
