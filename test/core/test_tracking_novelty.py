"""What is new in each frame, and what no number of frames averages away: simulated errors of known parts."""

import numpy as np
import pytest

from rcseg_core.config import TrackingConfig
from rcseg_core.shapes.plane_forms import LocalPlane
from rcseg_core.tracking.fusion import NO_DRIFT
from rcseg_core.tracking.named_shapes import fixed_shapes, fuse_all
from rcseg_core.tracking.novelty import FIRST, Novelty

FRAMES, PLANES = 60, 80


def tilted(parameters):
    """The plane z = 2 m with its free parameters (tilts, offset) changed, as `LocalPlane` has them."""
    a, b, offset = parameters
    normal = np.array([b, -a, 1.0]) / np.sqrt(1.0 + a * a + b * b)
    x = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = x, np.cross(normal, x), normal
    pose[:3, 3] = 0.0, 0.0, 2.0 + offset
    return pose


def fused_of(share, learns, rng):
    """(share that is told, filters, NEES / 3 of each) of planes whose stated error is new by a share only."""
    sigma = np.array([2e-3, 1e-3, 5e-4])
    covariance = np.diag(sigma**2)
    fixed = np.sqrt(1.0 - share) * sigma * rng.normal(size=(PLANES, 3))
    novelty, filters = Novelty() if learns else None, [None] * (PLANES + 1)
    for _ in range(FRAMES):
        new = np.sqrt(share) * sigma * rng.normal(size=(PLANES, 3))
        forms = [LocalPlane(tilted(e), covariance, np.zeros((3, 3))) for e in fixed + new]
        shapes = fixed_shapes([None, *forms], np.eye(4))
        filters = fuse_all(
            filters, shapes.forms, shapes.planes, np.zeros(3), TrackingConfig(), NO_DRIFT, novelty
        )
    nees = []
    for one in filters[1:]:
        told, axis = one.fused, one.fused.pose[:3, 2]
        error = np.array([-axis[1], axis[0], told.pose[2, 3] - 2.0])
        nees.append(float(error @ np.linalg.solve(told.covariance + told.systematic, error)) / 3.0)
    return (novelty.share if novelty else 1.0), filters, nees, covariance


@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
def test_the_share_that_is_new_is_found_and_the_rest_does_not_average_away(share):
    told, filters, nees, covariance = fused_of(share, True, np.random.default_rng(3))
    assert told == pytest.approx(share, rel=0.1)
    # where all is new, a few hundredths that chance took for repeated make the mean of 60 frames less certain
    assert (0.7 if share < 1.0 else 0.25) < np.mean(nees) < 1.4
    alone = np.linalg.slogdet(covariance)[1]
    assert all(np.linalg.slogdet(f.fused.covariance + f.fused.systematic)[1] <= alone for f in filters[1:])


def test_without_it_a_mean_of_frames_that_repeat_an_error_is_far_too_certain():
    assert np.mean(fused_of(0.5, False, np.random.default_rng(3))[2]) > 10


def test_before_anything_is_told_all_is_new_and_what_moved_tells_little():
    novelty = Novelty()
    assert novelty.share == 1.0
    covariance = np.eye(3) * 1e-8
    here, there = (LocalPlane(tilted((0, 0, d)), covariance, np.zeros((3, 3))) for d in (0.0, 0.5))
    planes = fixed_shapes([here], np.eye(4)).planes
    novelty.add([there], planes, np.zeros((1, 3)))
    assert novelty.share == 1.0  # more than all is not new
    for _ in range(20):
        novelty.add([here], planes, np.zeros((1, 3)))
    assert novelty.share == pytest.approx((FIRST + 4.0) / (FIRST + 21.0))
    novelty.add([], planes._replace(row=planes.row[:0], pose=planes.pose[:0]), np.zeros((0, 3)))
