"""A plane whose error hangs together over tens of pixels, as of stereo on a bare floor, is one surface."""

import cv2
import numpy as np
import pytest

from rcseg_core import PinholeCamera, RangeColorFrame, segment

SHAPE = (240, 320)
SIGMA = 0.0015
BOX = np.s_[150:200, 40:110]


def lumpy_wall(seed, lumps, scale_px, nearer=0.0):
    """A tilted wall with noise of SIGMA, and lumps of so many SIGMA and so wide; a box before it."""
    rng = np.random.default_rng(seed)
    rows, cols = SHAPE
    camera = PinholeCamera(300.0, 300.0, cols / 2 - 0.5, rows / 2 - 0.5)
    x, y = (np.arange(cols) - cols / 2) / 300.0, (np.arange(rows) - rows / 2) / 300.0
    inverse = 1.0 + 0.3 * x[None, :] + 0.5 * y[:, None]
    inverse[BOX] *= 1.0 + nearer
    for rms, blur in ((1.0, 1.2), (lumps, scale_px)):
        wave = cv2.GaussianBlur(rng.normal(size=SHAPE), (0, 0), blur)
        inverse += SIGMA * rms * wave / wave.std()
    color = np.clip(rng.normal(120.0, 3.0, (*SHAPE, 3)), 0, 255).astype(np.uint8)
    return RangeColorFrame.from_depth((1.0 / inverse).astype(np.float32), color, camera)


@pytest.mark.parametrize(("lumps", "scale_px", "seed"), [(3.0, 10, 0), (4.0, 14, 1), (5.0, 20, 1)])
def test_a_wall_with_wide_lumps_is_one_surface_and_its_error_is_told(lumps, scale_px, seed):
    result = segment(lumpy_wall(seed, lumps, scale_px))
    assert [s.pixel_count for s in result.surfaces] == [SHAPE[0] * SHAPE[1]]
    assert result.regions[0].range_patch.degree == 1
    assert result.noise.range_systematic == pytest.approx(lumps, rel=0.15)


def test_a_box_before_a_lumpy_wall_stays_apart():
    result = segment(lumpy_wall(2, 4.0, 14, nearer=0.05))
    wall, box = result.surfaces[:2]
    inside = np.zeros(SHAPE, np.bool_)
    inside[BOX] = True
    assert np.mean(result.surface_labels[inside] == box.label) > 0.97
    assert np.mean(result.surface_labels[~inside] == wall.label) > 0.99
