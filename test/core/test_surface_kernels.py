"""Kernels that describe surfaces, against plain NumPy: sums of cells, spread, scores, equations, heights."""

import numpy as np
import pytest

from rcseg_core.compute.small import cross, quantile, square_to
from rcseg_core.models.polynomials import Models
from rcseg_core.shapes.cell_sums import UNUSABLE, Layout, gather, mark_rims
from rcseg_core.shapes.cells import Cells
from rcseg_core.shapes.distances import CYLINDER, PLANE, SPHERE, _complete, _equations, _miss
from rcseg_core.shapes.fitting import Shape, residuals, shape_vector
from rcseg_core.shapes.scores import CLIP, score
from rcseg_core.shapes.spread import spread_of
from rcseg_core.signal.units import UNIT_PX
from rcseg_core.world.ground import _classes, _count_high


def test_small_forms_give_what_numpy_gives():
    rng = np.random.default_rng(0)
    for n in (1, 2, 3, 10, 51):
        a, b, values = rng.normal(size=3), rng.normal(size=3), rng.normal(size=n)
        assert np.array_equal(cross(a, b), np.cross(a, b))
        for share in (0.0, 0.02, 0.1, 0.5, 0.77, 1.0):
            assert quantile(values, share) == np.quantile(values, share)
        unit = a / np.linalg.norm(a)
        assert abs(square_to(unit) @ unit) < 1e-15
        assert np.linalg.norm(square_to(unit)) == pytest.approx(1.0)


def test_spread_is_the_weighted_covariance():
    rng = np.random.default_rng(1)
    points, weight = rng.normal(size=(40, 3)) + 50.0, rng.integers(1, 9, 40).astype(float)
    middle, spread = spread_of(points, weight)
    np.testing.assert_allclose(middle, np.average(points, axis=0, weights=weight), rtol=1e-13)
    expected = np.cov(points.T, aweights=weight, bias=True)
    np.testing.assert_allclose(spread, expected, rtol=1e-11, atol=1e-12)


SHAPES = [
    Shape(PLANE, np.array([0.1, 0.0, 2.0]), np.array([0.0, 0.6, -0.8]), 0.0, np.zeros(3)),
    Shape(SPHERE, np.array([0.1, 0.2, 2.0]), np.array([0.0, 0.0, 1.0]), 0.4, np.zeros(3)),
    Shape(CYLINDER, np.array([0.0, 0.2, 2.0]), np.array([0.8, 0.6, 0.0]), 0.3, np.zeros(3)),
]


def some_cells(columns, seed=2, m=30):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(m, 3)) * 0.2 + (0, 0, 1.8)
    spread = rng.normal(size=(m, 3, columns)) * 0.01
    pixels = rng.integers(2, 30, m).astype(float)
    tolerance2 = rng.uniform(0.5, 2, m)
    return Cells(points, np.full((m, 3), 0.577), spread, pixels, pixels / 1.5, tolerance2, 0.01, 1.3)


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: f"kind {shape.kind}")
@pytest.mark.parametrize("columns", [1, 3])
def test_a_score_is_what_its_names_say(shape, columns):
    cells = some_cells(columns)
    miss, found = residuals(shape, cells.points, cells.spread), score(shape, cells, 0.25)
    excess = cells.worth * (score_budget(cells) + 0.0625 * (1 + cells.tolerance2))
    clipped = np.minimum(miss.whitened**2, CLIP**2 * (1 + excess))
    assert found.chi2 == pytest.approx(clipped.sum())
    assert found.excess == pytest.approx(excess.sum())
    missed, noise = (miss.whitened * miss.sigma) ** 2, miss.sigma**2
    one, beyond = cells.worth * noise / 1.3, 1.3 * (1 - 1 / cells.pixels)
    means = [
        np.average(v, weights=cells.pixels)
        for v in (missed, noise, beyond * one + missed, beyond + missed / one)
    ]
    assert [found.missed, found.noise, found.rms2_m, found.rms2_sigma] == pytest.approx(means)
    np.testing.assert_allclose(found.gradients, miss.gradients, rtol=1e-12)
    outward = np.average((miss.gradients * cells.points).sum(axis=1), weights=cells.pixels)
    assert found.facing == pytest.approx(outward)


def score_budget(cells):
    """Systematic misfit of three coefficients, mean and four deviations: written out."""
    return cells.systematic2 / 3 * (3 + 4 * np.sqrt(6))


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: f"kind {shape.kind}")
def test_equations_along_rays_are_those_of_any_noise(shape):
    cells, q = some_cells(1), (3, 4, 5)[shape.kind]
    frame, gram, right = np.empty((2, 3)), np.zeros((5, 5)), np.zeros(5)
    row, gradient = np.empty(5), np.empty(3)
    _complete(shape.direction, frame)
    vector, limit = shape_vector(shape), np.full(len(cells.points), 3.0)
    cost = _equations(
        shape.kind, vector, frame, cells.points, cells.spread, limit, gram, right, row, gradient
    )
    rows, r = [], []
    for point, spread in zip(cells.points, cells.spread, strict=True):
        r.append(_miss(shape.kind, vector, frame, point, spread, row, gradient)[0])
        rows.append(row[:q].copy())
    rows, r = np.array(rows), np.array(r)
    weight = np.minimum(1.0, limit / np.abs(r))
    assert (weight < 1).any() and (weight == 1).any()
    inner = np.minimum(np.abs(r), limit)
    assert cost == pytest.approx(np.sum(inner * (2 * np.abs(r) - inner)))
    np.testing.assert_allclose(right[:q], rows.T @ (weight * r), rtol=1e-10)
    lower = np.tril_indices(q)
    np.testing.assert_allclose(gram[:q, :q][lower], (rows.T @ (rows * weight[:, None]))[lower], rtol=1e-9)


def test_rims_are_where_another_surface_lies_within_the_margin():
    surfaces = np.random.default_rng(3).integers(0, 3, (9, 11)).astype(np.int32)
    rim = np.empty(surfaces.shape, np.bool_)
    mark_rims(surfaces, 2, rim)
    for row, col in np.ndindex(*surfaces.shape):
        beside = [(row - 2, col), (row + 2, col), (row, col - 2), (row, col + 2)]
        others = [surfaces[r, c] for r, c in beside if 0 <= r < 9 and 0 <= c < 11]
        assert rim[row, col] == any(other not in (0, surfaces[row, col]) for other in others)


@pytest.mark.parametrize("skip", [0, 1])
@pytest.mark.parametrize("n_range", [1, 3])
def test_cells_hold_the_sums_of_their_pixels(skip, n_range):
    rng = np.random.default_rng(4)
    labels = np.zeros((12, 14), np.int32)
    labels[1:11, 1:7], labels[1:11, 7:13] = 1, 2
    surfaces, flags = (labels > 0).astype(np.int32), np.zeros(labels.shape, np.uint8)
    flags[rng.random(labels.shape) < 0.1] = UNUSABLE
    flags[:2] = UNUSABLE  # the box begins below
    signals = rng.normal(size=(*labels.shape, n_range)).astype(np.float32)
    coef = rng.normal(size=(3, n_range, 3, 3))
    models = Models(np.full((3, 2), 6.0), np.array([[1, 1], [1, 1], [2, 1]]), coef)
    box = np.array([[0, 0, 0, 0], [2, 1, 3, 3]])
    layout = Layout(np.array([0, 0, 9]), np.array([0, 4]), box, np.array([0, 0]), np.array([0, skip]))
    owner, sums = np.zeros(9, np.int64), np.zeros((9, 4 + n_range))
    rim, line = np.zeros(labels.shape, np.bool_), np.empty((n_range, 3))
    gather(labels, surfaces, rim, signals, flags, n_range, models, layout, line, owner, sums)
    expected, owners = np.zeros_like(sums), np.zeros_like(owner)
    for row, col in np.argwhere((surfaces > 0) & (flags == 0)):
        if (row | col) & skip:
            continue
        cell, k = (row - 2) // 4 * 3 + (col - 1) // 4, labels[row, col]
        owners[cell] = owners[cell] or k
        if owners[cell] == k:
            x, y, d = (col - 6) / UNIT_PX, (row - 6) / UNIT_PX, models.degree[k, 0] + 1
            table = coef[k, :, :d, :d] * x ** np.arange(d)[:, None] * y ** np.arange(d)
            misses = signals[row, col] - table.sum(axis=(1, 2))
            expected[cell] += [1, row, col, (misses**2).sum(), *misses]
    assert np.array_equal(owner, owners) and owners.max() == 2
    np.testing.assert_allclose(sums, expected, rtol=1e-9, atol=1e-9)


def test_ground_is_what_lies_within_a_step_of_its_plane():
    points = np.zeros((1, 5, 3), np.float32)
    points[0, :, 2] = 1.0, 1.04, 1.2, np.nan, 1.0
    surfaces, table = np.array([[1, 1, 1, 1, 2]], np.int32), np.full((3, 4), np.nan)
    table[1] = 0, 0, 1, 1
    out = np.empty((1, 5), np.uint8)
    _classes(points, np.isfinite(points[..., 2]), surfaces, table, np.float32(0.05), out)
    assert out.tolist() == [[1, 1, 2, 0, 2]]
    assert _count_high(points, surfaces, 1, np.array([0.0, 0, 1]), 1.0, 0.05) == (3, 1)
