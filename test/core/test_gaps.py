"""Pixels that no surface explains: mid-air pixels at a step, holes inside of a surface."""

import numpy as np
import pytest
from crafted import crafted_signals

from rcseg_core import PinholeCamera, RangeColorFrame, SegmenterConfig, segment
from rcseg_core.models.moments import accumulate
from rcseg_core.models.polynomials import fit_models
from rcseg_core.pixels.gaps import fill_holes, treat_flying
from rcseg_core.signal.signals import INVALID

SHAPE = (24, 32)
ROWS, COLS = np.mgrid[: SHAPE[0], : SHAPE[1]]
TRUTH = np.where(COLS < 15, 1, 2).astype(np.int32)
PAINT = np.array([[0.0, 0.0, 0.0], [30.0, 0.0, 0.0], [0.0, 30.0, 0.0]])


def step(flying, weight, *, painted=True, labels=TRUTH):
    """A near plane (100 sigma) left of a far one (0), with exact models; `flying` pixels are a mixture."""
    value = np.where(TRUTH == 1, 100.0, 0.0) + 0.1 * ROWS
    color = PAINT[TRUTH] if painted else np.zeros((*SHAPE, 3))
    image = np.concatenate([value[..., None], color], -1)
    exact = crafted_signals(image, 1)
    moments = accumulate(exact.image, exact.flags, TRUTH, 2, 1)
    models = fit_models(moments, np.ones((3, 2), np.int64), 1)
    image[..., 0][flying] = (100.0 * weight + 0.1 * ROWS)[flying]
    return crafted_signals(image, 1), models, labels.copy(), labels * 10


@pytest.mark.parametrize("weight", [0.2, 0.5, 0.8])
def test_colour_decides_on_which_side_a_pixel_in_mid_air_is(weight):
    """One column on each side of the step flies; by their range they would all go to one side."""
    flying = (COLS == 14) | (COLS == 15)
    nearest = np.where(flying, 1 if weight > 0.5 else 2, TRUTH).astype(np.int32)
    signals, models, labels, leaves = step(flying, weight, labels=nearest)
    assert treat_flying(signals, labels, leaves, models, "color") == flying.sum()
    assert np.array_equal(labels, TRUTH)
    assert np.array_equal(leaves, labels * 10), "a pixel does not carry the leaf of the region it joined"


@pytest.mark.parametrize("weight", [0.2, 0.5, 0.8])
def test_pixels_in_mid_air_may_stay_without_a_region(weight):
    flying = (COLS == 14) & (ROWS % 3 > 0)
    signals, models, labels, leaves = step(flying, weight)
    assert treat_flying(signals, labels, leaves, models, "unassigned") == flying.sum()
    assert np.array_equal(labels, np.where(flying, 0, TRUTH))
    assert np.array_equal(leaves, labels * 10)


def test_without_a_difference_of_colour_company_decides():
    """A pixel alone on the other side of a straight border goes back; a straight border stays."""
    flying = (COLS == 14) & (ROWS == 10)
    wrong = np.where(flying, 2, TRUTH).astype(np.int32)
    signals, models, labels, leaves = step(flying, 0.5, painted=False, labels=wrong)
    treat_flying(signals, labels, leaves, models, "color")
    assert np.array_equal(labels, TRUTH)
    signals, models, labels, leaves = step(COLS == 14, 0.5, painted=False)
    treat_flying(signals, labels, leaves, models, "color")
    assert np.array_equal(labels, TRUTH)


def test_what_a_surface_explains_does_not_fly():
    """Noise on both surfaces, an impulse inside of one, one beyond both, and invalid pixels."""
    signals, models, labels, leaves = step(np.zeros(SHAPE, bool), 0.5)
    rng = np.random.default_rng(0)
    signals.image[..., 0] += np.clip(rng.normal(size=SHAPE), -2.9, 2.9)
    signals.image[5, 5, 0] = 50.0  # far from the step: an impulse, not a mixture
    signals.image[9, 14, 0] = 180.0  # nearer than both
    signals.image[12, 15, 0] = 50.0
    signals.flags[12, 15] = INVALID
    before = labels.copy()
    for mode in ("unassigned", "color"):
        assert treat_flying(signals, labels, leaves, models, mode) == 0
        assert np.array_equal(labels, before)


def holes():
    """Two surfaces of two regions each (1, 2 on 1; 3, 4 on 2) and what is to be filled at 12 px."""
    labels = (1 + (COLS >= 16) * 2 + (ROWS >= 12)).astype(np.int32)
    full = labels.copy()
    labels[3:6, 3:7] = 0  # 12 px inside of region 1
    labels[10:14, 8] = 0  # across the border of two regions of one surface
    labels[4, 15:17] = 0  # between the surfaces
    labels[20:24, 10] = 0  # open to the rim
    labels[16:20, 20:24] = 0  # 16 px: too large
    labels[7, 20], labels[8, 21] = 0, 0  # they touch at a corner only: two holes
    wanted = full.copy()
    for part in (np.s_[4, 15:17], np.s_[20:24, 10], np.s_[16:20, 20:24]):
        wanted[part] = 0
    return labels, wanted


def test_small_holes_get_the_labels_around_them():
    labels, wanted = holes()
    leaves = labels * 10
    free = np.count_nonzero(labels == 0) - np.count_nonzero(wanted == 0)
    assert fill_holes(labels, leaves, np.array([0, 1, 1, 2, 2]), 12) == free
    assert np.array_equal(labels, wanted)
    assert np.array_equal(leaves, labels * 10)


def test_a_hole_between_two_surfaces_stays_open():
    labels, _ = holes()
    leaves = labels * 10
    fill_holes(labels, leaves, np.arange(5), 1000)
    assert not labels[10:14, 8].any()
    assert not labels[4, 15:17].any()
    assert labels[16:20, 20:24].all()
    assert (labels[3:6, 3:7] == 1).all()


def plane_with_holes():
    """A tilted wall, a hole of 5 x 6 px, one of 20 x 20 px, and a missing corner."""
    camera = PinholeCamera(150.0, 150.0, 63.5, 47.5)
    cols = np.arange(128.0)[None].repeat(96, 0)
    exact = 1.0 / (0.5 + 0.001 * cols)
    depth = exact + 0.001 * np.random.default_rng(3).normal(size=exact.shape)
    depth[40:45, 30:36] = np.nan
    depth[60:80, 80:100] = 0.0
    depth[:10, :10] = np.nan
    return RangeColorFrame.from_depth(depth, np.full((96, 128, 3), 120, np.uint8), camera), exact


@pytest.mark.parametrize("order", ["surfaces_first", "joint", "range_only"])
def test_filled_holes_take_their_depth_from_the_model(order):
    frame, exact = plane_with_holes()
    config = SegmenterConfig().replace({"grouping.order": order})
    kept = segment(frame, config)
    assert np.array_equal(kept.labels > 0, frame.valid), "holes are kept unless asked otherwise"
    result = segment(frame, config.replace({"borders.fill_holes_px": 30}))
    hole = np.zeros(frame.valid.shape, bool)
    hole[40:45, 30:36] = True
    assert np.array_equal(result.labels > 0, frame.valid | hole)
    assert np.array_equal(result.surface_labels > 0, frame.valid | hole)
    assert (result.labels[hole] == 1).all()
    assert np.abs(result.reconstruct()[0][hole][:, 2] - exact[hole]).max() < 0.001
    assert result.regions[0].pixel_count == np.count_nonzero(result.labels == 1)
    assert result.labels_at(0.5)[hole].all()
    everything = segment(frame, config.replace({"borders.fill_holes_px": 10000})).labels
    assert everything[60:80, 80:100].all()
    assert not everything[:10, :10].any(), "a corner is no hole"


@pytest.mark.parametrize("width", [3, 4, 6, 8])
def test_missing_columns_part_a_wall_only_where_they_are_wider_than_the_gap(width):
    """A gap of 1 reaches over 2 px, one of 7 over 8; windows, which reach over any, are kept off."""
    frame, _ = plane_with_holes()
    points = frame.points.copy()
    points[:, 60 : 60 + width] = np.nan
    parted = RangeColorFrame(points, frame.color, frame.camera)
    whole = SegmenterConfig().replace({"seeds.min_valid": 1.0, "grouping.max_gap": 7})
    surfaces = segment(parted, whole).surface_labels
    assert surfaces[20, 30] == surfaces[20, 100]
    surfaces = segment(parted, whole.replace({"grouping.max_gap": 1})).surface_labels
    assert surfaces[20, 30] != surfaces[20, 100]
