"""Holes are filled for the filters only; medians resist impulses."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rcseg_core.signal.cleaning import LINEAR_GAP_PX, color_median, fill_rows, local_median


def filled(image, valid):
    out = np.full(image.shape, np.nan, np.float32)
    fill_rows(image.astype(np.float32), valid, out)
    return out


def plane(shape=(20, 40)):
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    return (3.0 + 0.5 * cols - 0.25 * rows).astype(np.float32)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10**6), st.floats(0.05, 0.95))
def test_valid_pixels_stay_and_everything_is_filled_from_its_row(seed, share):
    rng = np.random.default_rng(seed)
    image = rng.normal(size=(9, 14)).astype(np.float32)
    valid = rng.random(image.shape) < share
    valid[rng.integers(9), rng.integers(14)] = True
    out = filled(np.where(valid, image, np.nan), valid)
    assert np.isfinite(out).all()
    assert np.array_equal(out[valid], image[valid])
    for row in np.nonzero(valid.any(axis=1))[0]:
        known = image[row, valid[row]]
        assert known.min() - 1e-6 <= out[row].min() and out[row].max() <= known.max() + 1e-6


def test_short_gaps_are_bridged_exactly_on_planes():
    valid = np.ones((20, 40), bool)
    valid[:, 10 : 10 + LINEAR_GAP_PX] = False
    np.testing.assert_allclose(filled(plane(), valid), plane(), rtol=1e-6)


def test_long_gaps_take_the_nearer_side_so_that_a_step_stays_a_step():
    image = np.where(np.arange(40) < 20, 1.0, 5.0)[None].repeat(3, 0).astype(np.float32)
    valid = np.ones((3, 40), bool)
    valid[:, 14:26] = False
    assert np.array_equal(filled(image, valid), image)


def test_empty_rows_copy_their_neighbours():
    valid = np.ones((20, 40), bool)
    valid[:3] = valid[8] = valid[-1] = False
    out = filled(plane(), valid)
    assert np.array_equal(out[:3], plane()[[3, 3, 3]])
    assert np.array_equal(out[8], plane()[7])
    assert np.array_equal(out[-1], plane()[-2])
    assert not filled(plane(), np.zeros((20, 40), bool)).any()


def test_the_median_resists_impulses_and_holes_and_keeps_planes():
    rng = np.random.default_rng(0)
    image, valid = plane()[..., None].copy(), rng.random((20, 40)) > 0.2
    wild = rng.random((20, 40)) < 0.15
    image[wild] += 100
    median = np.empty_like(image)
    local_median(image, valid, median)
    median = median[..., 0]
    inner = np.s_[3:-3, 3:-3]
    assert np.median(np.abs(median - plane())[inner]) < 0.5
    assert np.abs(median - plane())[inner].max() < 3.0


@pytest.mark.parametrize("order", ["C", "F"])
def test_the_colour_median_takes_any_layout(order):
    color = np.random.default_rng(0).integers(0, 256, (12, 14, 3)).astype(np.uint8)
    got = np.empty_like(color)
    color_median(np.asarray(color, order=order), got)
    for row in range(2, 10):
        for col in range(2, 12):
            wanted = np.median(color[row - 2 : row + 3, col - 2 : col + 3].reshape(25, 3), axis=0)
            assert np.array_equal(got[row, col], wanted)
