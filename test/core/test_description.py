"""Patches against least squares on pixels: control points, covariance and errors (eq. 12-15), normals."""

from dataclasses import replace

import numpy as np
import pytest
from oracle import naive_patch

from rcseg_core import PinholeCamera, RangeColorFrame, SegmenterConfig
from rcseg_core.graph.adjacency import find_pairs
from rcseg_core.models.moments import accumulate, region_boxes
from rcseg_core.models.polynomials import fit_models
from rcseg_core.result.description import describe_regions
from rcseg_core.signal.signals import build_signals

CAMERA = PinholeCamera(60.0, 62.0, 31.5, 23.5)
SHAPE = (48, 64)


def wavy_depth(noise=0.0, seed=0):
    """A curved surface, depth in m, with noise that is white in inverse depth."""
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    w = 0.5 + 0.002 * cols - 0.001 * rows + 2e-5 * (cols - 30.0) ** 2 + 1e-5 * (rows - 20.0) * (cols - 10.0)
    return 1.0 / (w + noise * np.random.default_rng(seed).normal(size=SHAPE))


def color(seed=0):
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    base = np.stack([100 + cols, 150 - rows, 80 + 0.02 * (cols - 30) ** 2], -1)
    return np.clip(base + np.random.default_rng(seed).normal(0, 4, base.shape), 0, 255).astype(np.uint8)


def blocks():
    """Three regions: a rectangle, an L and a diagonal strip; some pixels in none."""
    labels = np.zeros(SHAPE, np.int32)
    labels[3:30, 2:22] = 1
    labels[2:46, 28:40] = 2
    labels[32:46, 28:62] = 2
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    labels[(np.abs(rows - cols + 30) < 6) & (labels == 0) & (cols > 42)] = 3
    return labels


def described(frame, degree, labels=None, white=False):
    """Regions of a given label image, all models of one degree; white: the noise is said to be."""
    labels = blocks() if labels is None else labels
    count = int(labels.max())
    signals = build_signals(frame, frame.color, SegmenterConfig())
    if white:  # waves as short as the windows that measure the noise look like correlation to them
        signals = replace(signals, noise=replace(signals.noise, range_correlation=1.0))
    moments = accumulate(signals.image, signals.flags, labels, count, degree)
    degrees = np.full((count + 1, 2), degree, np.int64)
    models = fit_models(moments, degrees, signals.n_range)
    boxes = region_boxes(labels, count)
    pairs = find_pairs(labels, count, np.zeros(SHAPE, np.uint8), 3)
    surface_of = np.arange(count + 1)
    return (
        signals,
        labels,
        describe_regions(frame, signals, labels, surface_of, moments, models, boxes, pairs),
    )


def frame_of(depth, kind):
    frame = RangeColorFrame.from_depth(depth, color(), CAMERA)
    return frame if kind == "inverse_depth" else RangeColorFrame(frame.points, frame.color, None)


def signal_of(frame, rows, cols, kind):
    """(n, C) sensor signal of pixels as the product reads it, in float32."""
    points = frame.points[rows, cols].astype(np.float32)
    return (1 / points[:, 2:]).astype(float) if kind == "inverse_depth" else points.astype(float)


@pytest.mark.parametrize("kind", ["inverse_depth", "xyz"])
@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_control_points_and_errors_are_those_of_least_squares_on_pixels(kind, degree):
    frame = frame_of(wavy_depth(noise=2e-3), kind)
    signals, labels, regions = described(frame, degree)
    for region in regions:
        rows, cols = np.nonzero((labels == region.label) & (signals.flags == 0))
        for patch, values, together in (
            (region.range_patch, signal_of(frame, rows, cols, kind), signals.noise.range_correlation),
            (region.color_patch, frame.color[rows, cols].astype(float), signals.noise.color_correlation),
        ):
            wanted = [naive_patch.fit(degree, rows, cols, v, region.box) for v in values.T]
            covariance = naive_patch.residual_covariance(degree, rows, cols, values, wanted, region.box)
            # float32 whitened images: errors of 1e-6 of the signal
            size = np.abs(values).max()
            u, v = naive_patch.local(rows, cols, region.box)
            table = naive_patch.design(degree, u, v)
            made = table @ patch.control_points.reshape(len(values.T), -1).T
            np.testing.assert_allclose(
                made, table @ np.reshape(wanted, (len(values.T), -1)).T, atol=2e-5 * size
            )
            typical = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
            np.testing.assert_allclose(patch.covariance, covariance, rtol=1e-3, atol=1e-3 * typical.max())
            for c in range(values.shape[1]):
                errors = naive_patch.standard_errors(degree, rows, cols, covariance[c, c], region.box)
                np.testing.assert_allclose(patch.standard_errors[c], np.sqrt(together) * errors, rtol=2e-3)


def test_standard_errors_are_the_spread_over_repeated_measurements():
    """Monte Carlo on eq. (15): over 150 frames the spread of each control point is what it claims."""
    runs, claims = [], []
    for seed in range(150):
        frame = frame_of(wavy_depth(noise=2e-3, seed=seed), "inverse_depth")
        signals, _, regions = described(frame, 2, white=True)
        assert not signals.flags.all()
        runs.append([region.range_patch.control_points[0] for region in regions])
        claims.append([region.range_patch.standard_errors[0] for region in regions])
    spread = np.std(runs, axis=0, ddof=1)
    claimed = np.mean(claims, axis=0)
    ratio = spread / claimed
    # 150 runs know a standard deviation to 6 %; 27 of them are looked at
    assert ratio.min() > 0.78 and ratio.max() < 1.25, ratio
    assert np.median(ratio) == pytest.approx(1.0, abs=0.06)


def test_a_singular_fit_says_that_it_knows_nothing():
    labels = np.zeros(SHAPE, np.int32)
    labels[10, 5:25] = 1
    labels[20:40, 5:25] = 2
    _, _, (line, area) = described(frame_of(wavy_depth(noise=1e-3), "inverse_depth"), 1, labels)
    assert np.isnan(line.range_patch.standard_errors).any()
    assert np.isfinite(line.range_patch.control_points).all()
    assert np.isfinite(area.range_patch.standard_errors).all()


def test_covariance_of_colour_keeps_what_channels_have_in_common():
    rng = np.random.default_rng(4)
    common, own = rng.normal(0, 6, SHAPE), rng.normal(0, 3, (*SHAPE, 3))
    image = np.clip(120 + common[..., None] + own, 0, 255).astype(np.uint8)
    frame = RangeColorFrame.from_depth(wavy_depth(), image, CAMERA)
    _, _, regions = described(frame, 1)
    covariance = regions[1].color_patch.covariance
    np.testing.assert_allclose(np.diag(covariance), 45, rtol=0.25)
    np.testing.assert_allclose(covariance[np.triu_indices(3, 1)], 36, rtol=0.25)


@pytest.mark.parametrize("kind", ["inverse_depth", "xyz"])
@pytest.mark.parametrize("normal", [(0.0, 0.0, -1.0), (0.5, 0.2, -0.8), (-0.8, 0.1, -0.6), (0.1, -0.9, -0.4)])
def test_normals_of_oblique_planes_are_exact(kind, normal):
    normal = np.array(normal) / np.linalg.norm(normal)
    if kind == "inverse_depth":
        rays = CAMERA.rays(*SHAPE).astype(float)
        along = rays @ normal  # plane n.X = n_z 4, seen wherever the ray meets it in front
        with np.errstate(divide="ignore"):
            depth = np.where(normal[2] * 4 / along > 0.2, normal[2] * 4 / along, np.nan)
        frame = frame_of(depth, kind)
    else:
        rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
        x, y = cols * 0.002, rows * 0.002
        z = 0.5 - (normal[0] * x + normal[1] * y) / normal[2]
        frame = RangeColorFrame(np.stack([x, y, z], -1), color(), None)
    labels = np.where(frame.valid, blocks(), 0).astype(np.int32)
    labels[labels == 3] = 0
    for region in described(frame, 1, labels)[2]:
        angle = np.arccos(np.clip(region.normal @ normal, -1, 1))
        assert np.degrees(angle) < 0.2, (region.label, region.normal, normal)


def test_centroid_is_the_mean_of_the_measured_points():
    frame = frame_of(wavy_depth(noise=1e-3), "inverse_depth")
    signals, labels, regions = described(frame, 1)
    for region in regions:
        mean = frame.points[(labels == region.label) & (signals.flags == 0)].mean(axis=0)
        np.testing.assert_allclose(region.centroid, mean, rtol=1e-5, atol=1e-5)
    assert [region.neighbors for region in regions] == [(), (3,), (2,)]
