"""Borders lie where the models of their surfaces intersect: planes and bowls whose crossing is known."""

import numpy as np
import pytest
from crafted import crafted_signals
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import naive_borders

from rcseg_core import SegmenterConfig, segment
from rcseg_core.models.moments import accumulate
from rcseg_core.models.polynomials import fit_models
from rcseg_core.pixels.borders import Sides, parts, sharpen
from rcseg_core.signal.edges import DEPTH
from rcseg_core.signal.signals import COLOR_OUTLIER, RANGE_OUTLIER
from rcseg_core.synthetic import make_scene

SHAPE = (40, 56)
ROWS, COLS = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
REACH = 5
NOISE = 0.3


def two_sides(first, second, truth, *, noise=NOISE, seed=0, degree=1, colors=None):
    """Signals of a scene that shows `first` (H, W) where truth is 1 and `second` elsewhere; models of both.

    The models are fitted to the surfaces themselves, continued over the whole image: they are exact.
    """
    rng = np.random.default_rng(seed)
    value = np.where(truth == 1, first, second) + noise * rng.normal(size=SHAPE)
    color = np.zeros((*SHAPE, 3)) if colors is None else np.where((truth == 1)[..., None], *colors)
    image = np.concatenate([value[..., None], color], -1)
    exact = []
    for surface, paint in zip((first, second), (None, None) if colors is None else colors, strict=True):
        flat = np.zeros((*SHAPE, 3)) if paint is None else np.broadcast_to(paint, (*SHAPE, 3))
        whole = np.concatenate([surface[..., None], flat], -1).astype(np.float32)
        ones = np.ones(SHAPE, np.int32)
        exact.append(
            fit_models(
                accumulate(whole, np.zeros(SHAPE, np.uint8), ones, 1, degree), np.full((2, 2), degree), 1
            )
        )
    models = type(exact[0])(*(np.concatenate([a, b[1:]]) for a, b in zip(*exact, strict=True)))
    return crafted_signals(image, 1), models


def sharpened(signals, models, labels, *, edges=None, doubt=0.16, reach=REACH, surface_of=(0, 1, 2)):
    """The label image after `sharpen`, its leaves checked."""
    labels = np.array(labels, np.int32)
    leaves = labels * 10
    before = labels.copy()
    edges = np.zeros(SHAPE, np.uint8) if edges is None else edges
    surface_of = np.array(surface_of)
    sides = Sides(surface_of, models, np.full(surface_of.max() + 1, doubt))
    regions = type(models)(*(a[surface_of] for a in models))
    moved = sharpen(signals, edges, labels, leaves, sides, regions, reach)
    assert moved >= np.count_nonzero(labels != before)
    assert np.array_equal(leaves, labels * 10), "a pixel does not carry the leaf of the region it joined"
    return labels


def jagged(truth, seed, depth_px=3):
    """`truth` (1, 2) with a border that wanders by up to `depth_px` from column to column and row to row."""
    rng = np.random.default_rng(seed)
    labels = truth.copy()
    for _ in range(depth_px):
        other = np.zeros(SHAPE, bool)
        for axis in (0, 1):
            for step in (-1, 1):
                other |= np.roll(labels, step, axis) != labels
        other[[0, -1]] = False
        other[:, [0, -1]] = False
        labels = np.where(other & (rng.random(SHAPE) < 0.5), 3 - labels, labels)
    return largest_parts(labels)


def largest_parts(labels):
    """Each of the labels 1 and 2 in one 4-connected piece: smaller pieces go to the other."""
    for k in (1, 2):
        pieces = naive_borders.components(labels == k)
        keep = np.bincount(pieces[pieces > 0]).argmax()
        labels = np.where((pieces > 0) & (pieces != keep), 3 - k, labels)
    return labels


LINES = {
    "upright": COLS - 27.3,
    "level": ROWS - 18.6,
    "oblique": 0.8 * (COLS - 27.2) + 0.6 * (ROWS - 20.1),
    "falling": 0.5 * (COLS - 30.0) - 0.87 * (ROWS - 17.77),
}


@pytest.mark.parametrize("kind", ["ridge", "valley"])
@pytest.mark.parametrize("line", LINES)
def test_two_planes_end_on_the_line_where_they_meet(line, kind):
    """d is the distance to the line: w = -s |d| over a tilted plane is a ridge of depth, + a valley."""
    d = LINES[line]
    truth = np.where(d < 0, 1, 2)
    sign = 0.25 if kind == "valley" else -0.25
    tilt = 0.1 * COLS - 0.05 * ROWS
    signals, models = two_sides(tilt - sign * d, tilt + sign * d, truth)
    for seed in range(3):
        labels = jagged(truth, seed)
        assert (labels != truth).sum() > 30
        assert np.array_equal(sharpened(signals, models, labels), truth)


def test_a_curved_surface_ends_where_a_plane_cuts_it():
    bowl = 0.02 * ((COLS - 27.3) ** 2 + (ROWS - 20.4) ** 2)
    plane = np.full(SHAPE, 4.0)
    truth = np.where(bowl < plane, 1, 2)
    signals, models = two_sides(bowl, plane, truth, degree=2)
    labels = jagged(truth, 1)
    assert (labels != truth).sum() > 20
    assert np.array_equal(sharpened(signals, models, labels), truth)


def test_noise_decides_nothing_that_the_models_know():
    """A border drawn pixel by pixel where the noise is a multiple of the difference between the planes."""
    d = LINES["oblique"]
    truth = np.where(d < 0, 1, 2)
    signals, models = two_sides(-0.15 * d, 0.15 * d, truth, noise=1.0)
    value = signals.image[..., 0]
    nearer = np.where(np.abs(value + 0.15 * d) < np.abs(value - 0.15 * d), 1, 2)
    labels = largest_parts(np.where(np.abs(d) < 3, nearer, truth))
    assert (labels != truth).sum() > 60
    assert (sharpened(signals, models, labels) != truth).sum() <= 4  # those that their own range holds back


def test_a_border_moves_only_where_the_intersection_is_within_reach():
    d = LINES["upright"]
    truth = np.where(d < 0, 1, 2)
    signals, models = two_sides(-0.05 * d, 0.05 * d, truth, noise=0.0)
    labels = np.where(COLS - 33.3 < 0, 1, 2)  # 33 is the last column of 1, 5.7 px beyond the line
    assert np.array_equal(sharpened(signals, models, labels, reach=5), labels)
    assert np.array_equal(sharpened(signals, models, labels, reach=6), truth)


def test_surfaces_that_pass_each_other_keep_their_border():
    """A step: the planes are parallel, or cross far from where the nearer one ends."""
    for slope in (0.0, 0.3):
        near, far = 50.0 - slope * COLS, np.zeros(SHAPE)
        truth = np.where(COLS < 27, 1, 2)
        signals, models = two_sides(near, far, truth)
        labels = jagged(truth, 2)
        assert np.array_equal(sharpened(signals, models, labels), labels)


def test_nothing_moves_on_a_step_of_depth():
    d = LINES["upright"]
    truth = np.where(d < 0, 1, 2)
    signals, models = two_sides(-0.25 * d, 0.25 * d, truth)
    labels = jagged(truth, 3)
    edges = np.zeros(SHAPE, np.uint8)
    edges[:20] = DEPTH
    moved = sharpened(signals, models, labels, edges=edges)
    assert np.array_equal(moved[:20], labels[:20])
    assert np.array_equal(moved[21:], truth[21:])


def test_the_range_of_a_pixel_has_a_veto_and_an_impulse_has_none():
    """Sides of the crossing are given; some pixels measure the other plane, four sigmas away."""
    d = LINES["upright"]
    truth = np.where(d < 0, 1, 2)
    signals, models = two_sides(-1.2 * d, 1.2 * d, truth, noise=0.0)
    labels = truth.copy()
    bump = (slice(15, 25), slice(28, 30))  # on side 2, labelled 1 and measured on 1: there is a true bump
    labels[bump] = 1
    signals.image[..., 0][bump] = (-1.2 * d)[bump]
    assert np.array_equal(sharpened(signals, models, labels)[bump][:, 1:], labels[bump][:, 1:])
    signals.flags[bump] = RANGE_OUTLIER
    assert np.array_equal(sharpened(signals, models, labels), truth)


def test_colour_decides_where_the_crossing_is_in_doubt():
    """The planes differ by little; the paint changes two pixels beside their line: there ends the region."""
    d = LINES["upright"]
    truth = np.where(COLS < 30, 1, 2)
    colors = (np.array([4.0, 0.0, 0.0]), np.array([0.0, 4.0, 0.0]))
    signals, models = two_sides(-0.05 * d, 0.05 * d, truth, noise=0.0, colors=colors)
    labels = np.where(COLS < 28, 1, 2)
    assert np.array_equal(sharpened(signals, models, labels), truth)
    signals.flags[:] = COLOR_OUTLIER
    assert np.array_equal(sharpened(signals, models, labels), np.where(d < 0, 1, 2))


def test_regions_of_one_surface_and_unlabelled_pixels_are_left_alone():
    d = LINES["upright"]
    truth = np.where(d < 0, 1, 2)
    signals, models = two_sides(-0.25 * d, 0.25 * d, truth)
    labels = jagged(truth, 4)
    assert np.array_equal(sharpened(signals, models, labels, surface_of=(0, 1, 1)), labels)
    labels[10:20, 20:35] = 0
    moved = sharpened(signals, models, labels)
    assert np.array_equal(moved == 0, labels == 0)
    assert (moved != labels).any()


def test_a_border_without_a_clear_side_stays():
    """Two stripes of surface 2 in surface 1, on both sides of the line: the votes are even."""
    d = LINES["upright"]
    labels = np.where((np.abs(d) > 2) & (np.abs(d) < 14), 1, 2)
    signals, models = two_sides(-0.25 * d, 0.25 * d, labels)
    assert np.array_equal(sharpened(signals, models, labels), labels)


@pytest.mark.parametrize("ring", range(256))
def test_connectivity_of_every_neighbourhood(ring):
    """Against counting: parts of the ring of eight that touch the pixel by a side; none when all is full."""
    window = np.zeros((3, 3), np.int32)
    for i, (r, c) in enumerate(naive_borders.RING):
        window[r, c] = ring >> i & 1
    window[1, 1] = 1
    assert parts(window, 1, np.arange(2), 1, 1) == naive_borders.parts_through_center(window)


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10**6), st.sampled_from([0.05, 0.25, 1.0]))
def test_no_region_is_torn_and_none_appears(seed, slope):
    """Any partition into connected regions, whatever the models: the regions stay connected."""
    rng = np.random.default_rng(seed)
    d = LINES[rng.choice(list(LINES))]
    truth = np.where(d < 0, 1, 2)
    signals, models = two_sides(-slope * d, slope * d, truth, noise=1.0, seed=seed)
    labels = jagged(truth, seed, depth_px=4)
    moved = sharpened(signals, models, labels)
    for k in (1, 2):
        assert naive_borders.components(moved == k).max() == 1
    assert set(np.unique(moved)) == {1, 2}


@pytest.mark.parametrize(("family", "seeds", "share"), [("blocks", (0, 1), 0.6), ("room", (0, 3, 5, 6), 0.9)])
def test_creases_of_scenes_lie_nearer_to_the_truth(family, seeds, share):
    """Pixels on the wrong side of a crease, within 8 px of it, with and without."""
    wrong = {False: 0, True: 0}
    for seed in seeds:
        scene = make_scene(family, seed, width=320, height=240)
        for on in wrong:
            result = segment(scene.frame, SegmenterConfig().replace({"borders.sharpen": on}))
            wrong[on] += naive_borders.wrong_beside_creases(
                scene.surface_labels, scene.clean_points[..., 2], result.surface_labels
            )
    assert wrong[False] > 150
    assert wrong[True] < share * wrong[False]
