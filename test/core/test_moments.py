"""Moments against direct sums: they add, shift and solve like the pixels themselves (eq. 12-14)."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import naive_patch

from rcseg_core.models.moments import (
    accumulate,
    mean_square_gradient,
    plane_exponents,
    region_boxes,
    residual,
    shift_grid,
    solve,
    tensor_exponents,
)
from rcseg_core.signal.units import UNIT_PX

DEGREES = (1, 2, 3, 4)


def blobs(seed, shape=(24, 31), count=4, flagged=0.1):
    """A random image, flags, and labels 0..count in irregular pieces."""
    rng = np.random.default_rng(seed)
    image = rng.normal(size=(*shape, 3)).astype(np.float32)
    flags = np.where(rng.random(shape) < flagged, rng.integers(1, 8, shape), 0).astype(np.uint8)
    labels = rng.integers(0, count + 1, (shape[0] // 4 + 1, shape[1] // 5 + 1)).repeat(4, 0).repeat(5, 1)
    return image, flags, np.ascontiguousarray(labels[: shape[0], : shape[1]]).astype(np.int32)


def pixels(image, flags, labels, center, k):
    """x, y (UNIT_PX about a centre) and values of the usable pixels of a region."""
    rows, cols = np.nonzero((labels == k) & (flags == 0))
    return (cols - center[0]) / UNIT_PX, (rows - center[1]) / UNIT_PX, image[rows, cols].astype(float)


def solved(moments, k, exponents, channels=3):
    p = len(exponents)
    gram, coef = np.empty((p + 1, p)), np.zeros((channels, p))
    rank = solve(moments.power[k], moments.cross[k], 0, channels, exponents, gram, coef)
    rss = residual(moments.power[k], moments.cross[k], moments.energy[k], 0, channels, exponents, coef)
    return coef, rank, rss


@pytest.mark.parametrize("degree", DEGREES)
def test_accumulate_is_the_direct_sum_over_pixels(degree):
    image, flags, labels = blobs(1)
    moments = accumulate(image, flags, labels, 4, degree)
    assert not moments.power[0].any() and not moments.cross[0].any() and not moments.energy[0].any()
    for k in range(1, 5):
        x, y, values = pixels(image, flags, labels, moments.center[k], k)
        assert moments.count[k] == x.size
        for a in range(2 * degree + 1):
            for b in range(2 * degree + 1):
                assert moments.power[k, a, b] == pytest.approx((x**a * y**b).sum(), rel=1e-11, abs=1e-11)
        for a in range(degree + 1):
            for b in range(degree + 1):
                wanted = (x[:, None] ** a * y[:, None] ** b * values).sum(axis=0)
                np.testing.assert_allclose(moments.cross[k, :, a, b], wanted, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(moments.energy[k], (values**2).sum(axis=0), rtol=1e-12)


def test_boxes_are_inclusive_and_empty_labels_are_marked():
    labels = np.zeros((6, 8), np.int32)
    labels[2:4, 3:7] = 1
    labels[5, 0] = 3
    box = region_boxes(labels, 3)
    assert box[1].tolist() == [2, 3, 3, 6]
    assert box[3].tolist() == [5, 0, 5, 0]
    assert box[2, 2] == -1


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10**6), st.sampled_from(DEGREES))
def test_moments_of_a_union_are_the_sum_of_moments(seed, degree):
    image, flags, labels = blobs(seed)
    parts = accumulate(image, flags, labels, 4, degree)
    union = accumulate(image, flags, (labels > 0).astype(np.int32), 1, degree)
    power, cross = np.zeros_like(union.power[1]), np.zeros_like(union.cross[1])
    for k in range(1, 5):
        if parts.count[k] == 0:
            continue
        dx, dy = (parts.center[k] - union.center[1]) / UNIT_PX
        out = np.empty_like(power)
        shift_grid(parts.power[k], dx, dy, out, np.empty_like(power))
        power += out
        for c in range(3):
            part = np.empty_like(cross[c])
            shift_grid(parts.cross[k, c], dx, dy, part, np.empty_like(part))
            cross[c] += part
    np.testing.assert_allclose(power, union.power[1], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(cross, union.cross[1], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(parts.energy.sum(axis=0), union.energy[1], rtol=1e-12)


@settings(deadline=None, max_examples=30)
@given(st.floats(-8, 8), st.floats(-8, 8), st.integers(0, 1000))
def test_a_shift_is_the_sum_about_another_origin_and_can_be_undone(dx, dy, seed):
    rng = np.random.default_rng(seed)
    x, y, weight = rng.uniform(-1, 1, (3, 40))
    size = 5
    direct = np.array([[(weight * x**a * y**b).sum() for b in range(size)] for a in range(size)])
    moved = np.array(
        [[(weight * (x + dx) ** a * (y + dy) ** b).sum() for b in range(size)] for a in range(size)]
    )
    out, back, work = np.empty((3, size, size))
    shift_grid(direct, dx, dy, out, work)
    reach = np.outer((1 + abs(dx)) ** np.arange(size), (1 + abs(dy)) ** np.arange(size)) * 40
    assert (np.abs(out - moved) <= 1e-12 * reach).all()
    shift_grid(out, -dx, -dy, back, work)
    far = np.outer((1 + 2 * abs(dx)) ** np.arange(size), (1 + 2 * abs(dy)) ** np.arange(size)) * 40
    assert (np.abs(back - direct) <= 1e-11 * far).all()


@pytest.mark.parametrize("exponents", [plane_exponents(), *map(tensor_exponents, DEGREES)], ids=len)
def test_solve_is_least_squares_on_the_pixels(exponents):
    image, flags, labels = blobs(5)
    moments = accumulate(image, flags, labels, 4, 4)
    for k in range(1, 5):
        x, y, values = pixels(image, flags, labels, moments.center[k], k)
        coef, rank, rss = solved(moments, k, exponents)
        table = naive_patch.monomials(x, y, exponents)
        wanted = np.linalg.lstsq(table, values, rcond=None)[0]
        assert rank == len(exponents)
        # coefficients of high powers of small x are large: compare what they predict
        np.testing.assert_allclose(table @ coef.T, table @ wanted, atol=1e-6)
        assert rss == pytest.approx(((values - table @ wanted) ** 2).sum(), rel=1e-9)


@pytest.mark.parametrize("degree", DEGREES)
def test_residual_of_any_model_is_equation_14(degree):
    """tr(T T^T - 2 A V^T + A R A^T) for coefficients that are not the optimum: eq. (18) needs just that."""
    image, flags, labels = blobs(7)
    moments = accumulate(image, flags, labels, 4, degree)
    exponents = tensor_exponents(degree)
    coef = np.random.default_rng(3).normal(size=(3, len(exponents)))
    for k in range(1, 5):
        x, y, values = pixels(image, flags, labels, moments.center[k], k)
        wanted = ((values - naive_patch.monomials(x, y, exponents) @ coef.T) ** 2).sum(axis=0)
        for first, last in ((0, 3), (0, 1), (1, 3)):
            got = residual(
                moments.power[k], moments.cross[k], moments.energy[k], first, last, exponents, coef
            )
            assert got == pytest.approx(wanted[first:last].sum(), rel=1e-10)


@pytest.mark.parametrize(("height", "width"), [(1, 9), (9, 1), (1, 1), (2, 2), (1, 2)])
def test_too_few_or_collinear_pixels_lose_rank_but_fit_what_they_can(height, width):
    rng = np.random.default_rng(0)
    image = rng.normal(size=(12, 12, 3)).astype(np.float32)
    labels = np.zeros((12, 12), np.int32)
    labels[2 : 2 + height, 3 : 3 + width] = 1
    moments = accumulate(image, np.zeros((12, 12), np.uint8), labels, 1, 2)
    x, y, values = pixels(image, np.zeros((12, 12), np.uint8), labels, moments.center[1], 1)
    for exponents in (plane_exponents(), tensor_exponents(1), tensor_exponents(2)):
        coef, rank, rss = solved(moments, 1, exponents)
        table = naive_patch.monomials(x, y, exponents)
        assert rank == np.linalg.matrix_rank(table)
        assert np.isfinite(coef).all()
        wanted = naive_patch.rss_of_fit(x, y, values, exponents)
        assert rss == pytest.approx(wanted, rel=1e-7, abs=1e-7)


def test_a_region_of_full_vga_size_is_solved_as_well():
    """The reason for local domains: image coordinates have a condition of 1e17 here."""
    rows, cols = np.mgrid[:480:6, :640:8]
    rng = np.random.default_rng(2)
    x, y = (cols - 319.5) / UNIT_PX, (rows - 239.5) / UNIT_PX
    truth = rng.normal(size=(5, 5)) / 10.0 ** np.add.outer(np.arange(5), np.arange(5))
    value = sum(truth[a, b] * x**a * y**b for a in range(5) for b in range(5))
    image = np.zeros((480, 640, 1), np.float32)
    labels = np.zeros((480, 640), np.int32)
    image[rows, cols, 0] = value
    labels[rows, cols] = 1
    moments = accumulate(image, np.zeros((480, 640), np.uint8), labels, 1, 4)
    coef, rank, rss = solved(moments, 1, tensor_exponents(4), channels=1)
    assert rank == 25
    x, y, values = pixels(image, np.zeros_like(labels), labels, moments.center[1], 1)
    predicted = naive_patch.monomials(x, y, tensor_exponents(4)) @ coef[0]
    assert np.abs(predicted - values[:, 0]).max() < 1e-4 * np.abs(values).max()
    assert rss >= 0


def test_mean_square_gradient_is_that_of_the_pixels():
    image, flags, labels = blobs(11)
    moments = accumulate(image, flags, labels, 4, 3)
    exponents = tensor_exponents(3)
    coef = np.random.default_rng(1).normal(size=len(exponents))
    for k in range(1, 5):
        x, y, _ = pixels(image, flags, labels, moments.center[k], k)
        by_x = sum(c * a * x ** max(a - 1, 0) * y**b for c, (a, b) in zip(coef, exponents, strict=True))
        by_y = sum(c * b * x**a * y ** max(b - 1, 0) for c, (a, b) in zip(coef, exponents, strict=True))
        got = mean_square_gradient(moments.power[k], exponents, coef)
        assert got == pytest.approx((by_x**2 + by_y**2).mean(), rel=1e-10)
