"""Bars and cables of a few pixels before a wall, and strips of paint on it, stay regions of their own."""

import numpy as np
import pytest

from rcseg_core import PinholeCamera, RangeColorFrame, SegmenterConfig, segment
from rcseg_core.signal.signals import RANGE_OUTLIER, build_signals
from rcseg_core.synthetic.sensor import flying_pixels, white_noise

SHAPE = (160, 200)
CAMERA = PinholeCamera(525.0, 525.0, 99.5, 79.5)
#: 1/m, Kinect; and its quantum of 1/8 px.
SIGMA, QUANTUM = 1.425e-3, 0.125 / (525 * 0.075)
TURNS = {"upright": 0.0, "oblique": 0.5, "level": np.pi / 2}
GREY, BLUE = np.array([150.0, 140.0, 130.0]), np.array([60.0, 90.0, 160.0])


def before_a_wall(width, turn, step, *, color=GREY, structured_light=False, seed=0):
    """A bar of `width` px, nearer than the wall at 2 m by a share `step` of depth; the frame and its mask."""
    rng = np.random.default_rng(seed)
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    x, y = cols - 95.3, rows - 78.4
    across = x * np.cos(turn) + y * np.sin(turn)
    along = y * np.cos(turn) - x * np.sin(turn)
    bar = (np.abs(across) < width / 2) & (np.abs(along) < 60)
    wall_m = 1.0 / (0.5 + 1e-4 * cols)
    depth_m = np.where(bar, wall_m * (1.0 - step), wall_m)
    if structured_light:
        depth_m, _ = flying_pixels(rng, depth_m)
    inverse = 1.0 / depth_m + SIGMA * white_noise(rng, SHAPE, 1.5 if structured_light else 0.0)
    if structured_light:
        inverse = np.round(inverse / QUANTUM) * QUANTUM
    paint = np.where(bar[..., None], color, GREY) + rng.normal(scale=3.0, size=(*SHAPE, 3))
    paint = np.clip(np.round(paint), 0, 255).astype(np.uint8)
    return RangeColorFrame.from_depth((1.0 / inverse).astype(np.float32), paint, CAMERA), bar


def kept(labels, bar):
    """Share of the bar in its largest label that is not that of the wall."""
    sizes = np.bincount(labels[bar], minlength=2)
    sizes[[0, np.bincount(labels[~bar]).argmax()]] = 0
    return sizes.max() / bar.sum()


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("step", [0.06, 0.4])
@pytest.mark.parametrize(("width", "least"), [(2, 0.5), (3, 0.97), (4, 0.97), (6, 0.97)])
def test_a_bar_of_the_colour_of_the_wall_is_a_surface(width, least, step, turn):
    frame, bar = before_a_wall(width, TURNS[turn], step)
    result = segment(frame)
    assert kept(result.labels, bar) >= least
    assert kept(result.surface_labels, bar) >= least
    assert (result.surface_labels[~bar] == 1).mean() > 0.999


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize(("width", "least"), [(4, 0.5), (5, 0.6), (6, 0.9)])
def test_a_bar_is_seen_by_a_sensor_that_blurs_its_edges(width, least, turn):
    """Six of ten pixels of the two outer columns report depths between the bar and the wall."""
    frame, bar = before_a_wall(width, TURNS[turn], 0.06, structured_light=True)
    assert kept(segment(frame).surface_labels, bar) >= least


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("width", [2, 3, 4, 6])
def test_a_painted_strip_is_a_region_of_the_wall(width, turn):
    frame, strip = before_a_wall(width, TURNS[turn], 0.0, color=BLUE)
    result = segment(frame)
    assert kept(result.labels, strip) >= 0.97
    assert (result.surface_labels == 1).mean() > 0.999


def test_pixels_in_company_are_no_impulses():
    """A bar of two pixels is a thing; one pixel, or two beside each other, are not."""
    frame, bar = before_a_wall(2, 0.0, 0.4)
    points = frame.points.copy()
    alone = np.zeros(SHAPE, bool)
    alone[30, 30], alone[100, 150:152] = True, True
    points[alone] *= np.float32(0.6)
    signals = build_signals(RangeColorFrame(points, frame.color, CAMERA), frame.color, SegmenterConfig())
    flagged = signals.flags & RANGE_OUTLIER != 0
    assert flagged[alone].all()
    assert flagged[bar].mean() < 0.05
