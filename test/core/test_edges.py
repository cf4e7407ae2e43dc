"""Edges: zero on planes however oblique, firing on creases, steps and colours, rarely on noise."""

import cv2
import numpy as np
import pytest

from rcseg_core import PinholeCamera, RangeColorFrame, SegmenterConfig
from rcseg_core.signal.edges import COLOR, DEPTH, ORIENTATION, detect_edges
from rcseg_core.signal.signals import build_signals

SHAPE = (240, 320)
CAMERA = PinholeCamera(260.0, 260.0, 159.5, 119.5)
ROWS, COLS = np.mgrid[: SHAPE[0], : SHAPE[1]]
SIGMA = 2e-3  # 1/m
BASE = 0.5 + 0 * COLS


def edges_of(w, noise=1.0, seed=0, color=None, valid=None, correlation_px=0.0, **changes):
    """The edge map of inverse depth w (1/m) with white noise of `noise` SIGMA."""
    rng = np.random.default_rng(seed)
    dirt = rng.normal(size=SHAPE)
    if correlation_px:
        dirt = cv2.GaussianBlur(dirt, (0, 0), correlation_px)
        dirt /= dirt.std()
    depth = 1.0 / (w + noise * SIGMA * dirt)
    if valid is not None:
        depth[~valid] = np.nan
    color = np.full((*SHAPE, 3), 128, np.uint8) if color is None else color
    frame = RangeColorFrame.from_depth(depth, color, CAMERA)
    config = SegmenterConfig().replace(changes)
    return detect_edges(build_signals(frame, frame.color, config), config.edges)


def near(edges, bit, at, reach):
    """Share of the rows that carry the bit within `reach` columns of column `at`."""
    return (edges[20:-20, at - reach : at + reach + 1] & bit).any(axis=1).mean()


def away(edges, bit, at, reach):
    """Share of pixels with the bit farther from column `at`."""
    far = np.abs(COLS - at) > reach
    return ((edges & bit) > 0)[far].mean()


@pytest.mark.parametrize("slope", [(0.0, 0.0), (1e-3, 0.0), (-8e-4, 1.2e-3), (2e-3, 1.5e-3)])
def test_a_plane_without_noise_has_no_edge_however_oblique(slope):
    """Inverse depth of a plane is linear: 2e-3 per px at 0.5/m is a plane tilted by 46 degrees and more."""
    w = BASE + slope[0] * (COLS - 160) * 0.8 + slope[1] * (ROWS - 120) * 0.8
    assert w.min() > 0.05
    # at the rim of an exact frame the median is beside the plane by more than its noise, see test_signals
    assert not edges_of(w, noise=0.0)[8:-8, 8:-8].any()


@pytest.mark.parametrize("noise", [0.5, 1.0, 3.0])
def test_white_noise_rarely_makes_an_edge(noise):
    edges = edges_of(BASE + 1e-3 * (COLS - 160), noise=noise)
    assert ((edges & ORIENTATION) > 0).mean() < 0.01
    assert ((edges & DEPTH) > 0).mean() < 0.001
    assert not (edges & COLOR).any()


def test_correlated_noise_rarely_makes_an_edge():
    edges = edges_of(BASE, correlation_px=1.5)
    assert ((edges & ORIENTATION) > 0).mean() < 0.02


def test_a_crease_is_found_where_it_is_and_nowhere_else():
    crease = BASE + 2e-3 * np.abs(COLS - 160)
    edges = edges_of(crease)
    assert near(edges, ORIENTATION, 160, 3) > 0.8
    assert away(edges, ORIENTATION, 160, 8) < 0.01
    assert ((edges & DEPTH) > 0).mean() < 0.001
    valley = edges_of(BASE + 0.4 - 2e-3 * np.abs(COLS - 160))
    assert near(valley, ORIENTATION, 160, 3) > 0.8


def test_white_noise_on_a_steep_plane_rarely_makes_a_step():
    edges = edges_of(BASE + 2.0 + 8e-3 * (COLS - 160), **{"edges.depth_step": 0.0})
    assert ((edges & DEPTH) > 0).mean() < 0.001


def test_a_sharper_crease_is_found_as_surely():
    edges = edges_of(BASE + 8e-3 * np.abs(COLS - 160))
    assert near(edges, ORIENTATION | DEPTH, 160, 3) > 0.8


def test_a_step_is_a_depth_edge_of_both_sides_and_no_crease():
    edges = edges_of(np.where(COLS < 160, 0.5, 0.6))
    assert near(edges, DEPTH, 160, 1) == 1
    assert away(edges, DEPTH, 160, 3) < 0.001
    assert near(edges, ORIENTATION, 160, 10) < 0.1


def test_a_step_below_the_share_of_depth_is_none():
    """depth_step: 2 % of depth is asked for, whatever the noise."""
    small = np.where(COLS < 160, 0.5, 0.507)
    assert not (edges_of(small, noise=0.01) & DEPTH).any()
    assert near(edges_of(small, noise=0.01, **{"edges.depth_step": 0.005}), DEPTH, 160, 1) == 1


def test_a_curved_surface_is_no_crease():
    """A ball of 30 cm at 2 m, away from its rim: the top-hat takes a bend that is everywhere.

    Its slope changes faster towards the rim: .063 of the pixels, .025 when sigma is taken a fifth too large.
    """
    x, y = (COLS - 159.5) / 260 * 2.0, (ROWS - 119.5) / 260 * 2.0
    r2 = x**2 + y**2
    inside = r2 < 0.2**2
    depth = 2.0 - np.sqrt(np.maximum(0.3**2 - r2, 0.01))
    edges = edges_of(1 / depth)
    assert ((edges & ORIENTATION) > 0)[inside].mean() < 0.07
    assert ((edges & DEPTH) > 0)[inside].mean() < 0.001


def test_invalid_pixels_carry_no_range_edge_and_do_not_spread():
    rng = np.random.default_rng(1)
    scattered = rng.random(SHAPE) > 0.2
    edges = edges_of(BASE + 1e-3 * (COLS - 160), valid=scattered)
    assert not edges[~scattered].any()
    assert (edges > 0).mean() < 0.01
    block = np.ones(SHAPE, bool)
    block[60:120, 100:180] = False
    edges = edges_of(BASE, valid=block)
    assert not edges[~block].any()
    assert (edges > 0).mean() < 0.01


def test_a_crease_and_a_step_are_seen_through_drop_out():
    valid = np.random.default_rng(2).random(SHAPE) > 0.3
    crease = edges_of(BASE + 2e-3 * np.abs(COLS - 160), valid=valid)
    assert near(crease, ORIENTATION, 160, 4) > 0.7
    step = edges_of(np.where(COLS < 160, 0.5, 0.6), valid=valid)
    assert near(step, DEPTH, 160, 2) > 0.8


def test_impulses_are_no_edges():
    rng = np.random.default_rng(3)
    w = BASE.copy()
    wild = rng.random(SHAPE) < 0.1
    w[wild] = rng.uniform(0.1, 1.0, wild.sum())
    assert ((edges_of(w) & DEPTH) > 0).mean() < 0.02
    assert ((edges_of(w, **{"edges.outlier_threshold": 0.0}) & DEPTH) > 0).mean() > 0.3


def test_colour_edges_are_the_strongest_channel():
    rng = np.random.default_rng(0)
    color = np.full((*SHAPE, 3), 120.0)
    color[:, 160:, 1] += 70
    noisy = np.clip(color + rng.normal(0, 3, color.shape), 0, 255).astype(np.uint8)
    edges = edges_of(BASE, color=noisy)
    assert near(edges, COLOR, 160, 1) == 1
    assert away(edges, COLOR, 160, 2) < 0.001
    assert not (edges_of(BASE, color=noisy, **{"edges.color_threshold": 120.0}) & COLOR).any()


def test_colour_edges_are_also_found_where_there_is_no_range():
    color = np.full((*SHAPE, 3), 60, np.uint8)
    color[:, 160:] = 200
    valid = ROWS < 120
    edges = edges_of(BASE, color=color, valid=valid)
    assert (edges[130:-5, 159:161] & COLOR).all()
    assert not (edges[~valid] & (DEPTH | ORIENTATION)).any()


def grid_edges(slope, step=0.0):
    """A scanner grid of 1 mm pitch and 0.3 mm noise: a fold of `slope` on both sides, a step of `step`."""
    rng = np.random.default_rng(0)
    points = np.stack(
        [COLS * 1e-3, ROWS * 1e-3, 0.5 + slope * 1e-3 * np.abs(COLS - 160) + step * (ROWS > 180)], -1
    )
    points += rng.normal(0, 3e-4, points.shape)
    frame = RangeColorFrame(points, np.full((*SHAPE, 3), 90, np.uint8), None)
    config = SegmenterConfig()
    return detect_edges(build_signals(frame, frame.color, config), config.edges)


def test_scanner_grids_have_steps():
    edges = grid_edges(0.0, 0.05)
    assert ((edges[180:182] & DEPTH) > 0).any(axis=0).mean() > 0.95
    assert ((edges[20:160, 20:-20] & DEPTH) > 0).mean() < 0.04


def test_scanner_grids_have_creases():
    assert near(grid_edges(0.4), ORIENTATION, 160, 4) > 0.8


@pytest.mark.parametrize("shape", [(3, 3), (5, 5), (4, 40), (16, 64)])
def test_small_images_have_a_map_of_their_size(shape):
    frame = RangeColorFrame.from_depth(np.full(shape, 2.0), np.zeros((*shape, 3), np.uint8), CAMERA)
    config = SegmenterConfig()
    edges = detect_edges(build_signals(frame, frame.color, config), config.edges)
    assert edges.shape == shape and edges.dtype == np.uint8
    assert not edges.any()
