"""Planes in closed form against least squares on the pixels of two regions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import naive_patch

from rcseg_core.models.moments import accumulate
from rcseg_core.models.planes import add_planes, center_planes, joint_shape, joint_signal, rise, slopes
from rcseg_core.signal.units import UNIT_PX

PLANE = [(0, 0), (1, 0), (0, 1)]


def two_regions(seed, boxes):
    rng = np.random.default_rng(seed)
    rows, cols = np.mgrid[:40, :50]
    image = rng.normal(size=(40, 50, 3)) + np.stack([0.3 * cols, -0.2 * rows, 0.01 * cols * rows], -1)
    labels = np.zeros((40, 50), np.int32)
    for k, (r0, c0, r1, c1) in enumerate(boxes, 1):
        labels[r0:r1, c0:c1] = k
    flags = np.where(rng.random((40, 50)) < 0.15, 2, 0).astype(np.uint8)
    return image.astype(np.float32), flags, labels


def pixels(image, flags, labels):
    rows, cols = np.nonzero((labels > 0) & (flags == 0))
    return cols / UNIT_PX, rows / UNIT_PX, image[rows, cols].astype(float), labels[rows, cols]


def compared(planes, i, j):
    shape, signal = np.empty(6), np.empty((3, 5))
    joint_shape(planes, i, j, shape)
    out = []
    for c in range(3):
        joint_signal(planes, i, j, c, shape, signal[c])
        out.append((rise(planes, i, c, shape, signal[c]), rise(planes, j, c, shape, signal[c])))
    return shape, signal, np.array(out)


boxes = st.tuples(st.integers(0, 30), st.integers(0, 40), st.integers(3, 10), st.integers(3, 10)).map(
    lambda b: (b[0], b[1], b[0] + b[2], b[1] + b[3])
)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10**6), boxes, boxes)
def test_rise_is_the_difference_of_residual_sums_on_pixels(seed, one, other):
    image, flags, labels = two_regions(seed, [one, other])
    x, y, values, label = pixels(image, flags, labels)
    if (label == 1).sum() < 6 or (label == 2).sum() < 6:
        return
    planes = center_planes(accumulate(image, flags, labels, 2, 1))
    _, _, rises = compared(planes, 1, 2)
    everything = np.ones(label.size, bool)
    for c in range(3):
        for side in (1, 2):
            mask = label == side
            if np.linalg.matrix_rank(naive_patch.monomials(x[mask], y[mask], PLANE)) < 3:
                continue
            wanted = naive_patch.rise(x, y, values[:, c], mask, PLANE, everything)
            energy = (values[mask, c] ** 2).sum()
            assert rises[c, side - 1] == pytest.approx(wanted, rel=1e-7, abs=1e-9 * energy)
            assert rises[c, side - 1] >= -1e-12 * energy


def test_the_joint_plane_is_that_of_all_pixels():
    image, flags, labels = two_regions(3, [(2, 3, 12, 15), (14, 8, 30, 40)])
    x, y, values, label = pixels(image, flags, labels)
    planes = center_planes(accumulate(image, flags, labels, 2, 1))
    shape, signal, _ = compared(planes, 1, 2)
    assert shape[0] == label.size
    np.testing.assert_allclose(shape[1:3], [x.mean(), y.mean()])
    spread = [
        ((x - x.mean()) ** 2).sum(),
        ((x - x.mean()) * (y - y.mean())).sum(),
        ((y - y.mean()) ** 2).sum(),
    ]
    np.testing.assert_allclose(shape[3:], spread)
    table = naive_patch.monomials(x - x.mean(), y - y.mean(), PLANE)
    fits = np.linalg.lstsq(table, values, rcond=None)[0]
    np.testing.assert_allclose(signal[:, 0], fits[0], rtol=1e-10)
    np.testing.assert_allclose(signal[:, 3:], fits[1:].T, rtol=1e-8, atol=1e-8)


def test_adding_planes_is_summing_their_pixels():
    image, flags, labels = two_regions(4, [(2, 3, 12, 15), (14, 8, 30, 40)])
    planes = center_planes(accumulate(image, flags, labels, 2, 1))
    add_planes(planes, 1, 2, np.empty(6), np.empty((3, 5)))
    whole = center_planes(accumulate(image, flags, (labels > 0).astype(np.int32), 1, 1))
    np.testing.assert_allclose(planes.shape[1], whole.shape[1], rtol=1e-11)
    np.testing.assert_allclose(planes.signal[1], whole.signal[1], rtol=1e-8, atol=1e-9)


def test_slopes_of_a_line_of_pixels_are_the_shortest_and_of_a_point_zero():
    x = np.arange(5.0) - 2
    assert slopes(10.0, 0.0, 0.0, float((x * 3 * x).sum()), 0.0) == pytest.approx((3.0, 0.0))
    # along the diagonal only the sum of the slopes shows; the shortest pair shares it
    assert slopes(10.0, 10.0, 10.0, 40.0, 40.0) == pytest.approx((2.0, 2.0))
    assert slopes(0.0, 0.0, 0.0, 0.0, 0.0) == (0.0, 0.0)
