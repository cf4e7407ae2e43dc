"""Bezier patches against direct sums and finite differences; elevation and subdivision leave the surface."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from oracle import naive_patch

from rcseg_core.models.bezier import (
    BezierPatch,
    basis,
    bernstein,
    elevate,
    monomial_to_bernstein,
    power_to_bernstein,
    subdivide,
)

DEGREES = (1, 2, 3, 4)
UNIT = st.floats(0, 1)


def controls(degree, channels=3):
    return hnp.arrays(float, (channels, degree + 1, degree + 1), elements=st.floats(-100, 100))


def patch(control, domain=(3, 7, 22, 30), kind="xyz"):
    channels = control.shape[0]
    return BezierPatch(kind, control.shape[1] - 1, control, np.zeros_like(control), np.eye(channels), domain)


def value(control, u, v):
    return np.array([naive_patch.evaluate(channel, u, v) for channel in control])


@pytest.mark.parametrize("degree", DEGREES)
def test_bernstein_is_equation_9(degree):
    t = np.linspace(-0.3, 1.4, 15)
    wanted = [[naive_patch.bernstein(degree, m, x) for m in range(degree + 1)] for x in t]
    np.testing.assert_allclose(bernstein(degree, t), wanted, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("degree", DEGREES)
def test_bernstein_polynomials_sum_to_one_and_are_not_negative_on_the_domain(degree):
    t = np.linspace(0, 1, 33)
    values = bernstein(degree, t)
    np.testing.assert_allclose(values.sum(axis=1), 1.0, rtol=1e-12)
    assert (values >= 0).all()


@pytest.mark.parametrize("degree", DEGREES)
def test_basis_is_equation_11(degree):
    rng = np.random.default_rng(degree)
    u, v = rng.random(9), rng.random(9)
    np.testing.assert_allclose(basis(degree, u, v), naive_patch.design(degree, u, v), rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("degree", DEGREES)
def test_evaluate_is_the_double_sum_of_equation_8(degree):
    rng = np.random.default_rng(degree)
    made = patch(rng.normal(size=(3, degree + 1, degree + 1)), domain=(3, 7, 22, 30))
    rows, cols = np.array([[3, 22, 10], [5, 0, 40]]), np.array([[7, 30, 12], [9, 0, 33]])
    got = made.evaluate(rows, cols)
    assert got.shape == (2, 3, 3)
    for at in np.ndindex(2, 3):
        u, v = (cols[at] - 7) / 23, (rows[at] - 3) / 19
        np.testing.assert_allclose(got[at], value(made.control_points, u, v), rtol=1e-9, atol=1e-9)


@given(st.sampled_from(DEGREES).flatmap(controls), UNIT, UNIT)
def test_elevation_leaves_the_surface(control, u, v):
    lifted = elevate(control)
    assert lifted.shape == (3, control.shape[1] + 1, control.shape[1] + 1)
    np.testing.assert_allclose(value(lifted, u, v), value(control, u, v), rtol=1e-9, atol=1e-9)


@given(st.sampled_from(DEGREES).flatmap(controls), st.floats(0, 0.5), st.floats(0.6, 1.5), UNIT, UNIT)
def test_subdivision_leaves_the_surface(control, t0, t1, u, v):
    along_u = subdivide(control, t0, t1, axis=0)
    np.testing.assert_allclose(
        value(along_u, u, v), value(control, t0 + (t1 - t0) * u, v), rtol=1e-8, atol=1e-6
    )
    along_v = subdivide(control, t0, t1, axis=1)
    np.testing.assert_allclose(
        value(along_v, u, v), value(control, u, t0 + (t1 - t0) * v), rtol=1e-8, atol=1e-6
    )


@given(st.sampled_from(DEGREES).flatmap(controls), UNIT, UNIT)
def test_a_patch_lies_within_its_control_points(control, u, v):
    got = value(control, u, v)
    flat = control.reshape(3, -1)
    slack = 1e-9 * (1 + np.abs(flat).max())
    assert (got >= flat.min(axis=1) - slack).all()
    assert (got <= flat.max(axis=1) + slack).all()


@pytest.mark.parametrize("degree", DEGREES)
def test_monomials_convert_exactly(degree):
    rng = np.random.default_rng(degree)
    coefficients = rng.normal(size=degree + 1)
    offset, span = -0.7, 2.3
    control = monomial_to_bernstein(degree, offset, span) @ coefficients
    for t in np.linspace(0, 1, 7):
        x = offset + span * t
        wanted = sum(c * x**i for i, c in enumerate(coefficients))
        got = sum(b * naive_patch.bernstein(degree, m, t) for m, b in enumerate(control))
        assert got == pytest.approx(wanted, rel=1e-11, abs=1e-11)
    unit = power_to_bernstein(degree) @ coefficients
    assert unit[0] == pytest.approx(coefficients[0])
    assert unit[-1] == pytest.approx(coefficients.sum())


@settings(deadline=None)
@given(st.sampled_from(DEGREES).flatmap(controls), st.floats(0, 40), st.floats(0, 40))
def test_derivatives_are_the_limits_of_differences(control, row, col):
    made = patch(control)
    by_row, by_col = made.derivatives(row, col)
    h = 1e-4
    size = 1 + np.abs(made.evaluate(np.array([row, row + 1]), np.array([col, col + 1]))).max()
    size += np.abs(by_row).max() + np.abs(by_col).max()
    numeric = (made.evaluate(row + h, col) - made.evaluate(row - h, col)) / (2 * h)
    np.testing.assert_allclose(by_row, numeric, atol=1e-5 * size)
    numeric = (made.evaluate(row, col + h) - made.evaluate(row, col - h)) / (2 * h)
    np.testing.assert_allclose(by_col, numeric, atol=1e-5 * size)


@pytest.mark.parametrize("domain", [(4, 4, 4, 9), (4, 4, 9, 4), (4, 4, 4, 4)])
def test_a_domain_of_one_row_or_column_is_one_pixel_wide(domain):
    made = patch(np.arange(12.0).reshape(3, 2, 2), domain)
    np.testing.assert_allclose(made.evaluate(4, 4), made.control_points[:, 0, 0])
    assert np.isfinite(made.evaluate(np.arange(12), np.arange(12))).all()
    assert all(np.isfinite(d).all() for d in made.derivatives(4, 4))
