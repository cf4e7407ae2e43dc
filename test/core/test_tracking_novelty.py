"""What is new in each frame, and what no number of frames averages away: simulated errors of known parts."""

import numpy as np
import pytest

from rcseg_core.config import TrackingConfig
from rcseg_core.shapes.plane_forms import LocalPlane
from rcseg_core.tracking.named_shapes import FusedShapes, fixed_shapes
from rcseg_core.tracking.novelty import FIRST, Novelty
from rcseg_core.tracking.planes import Planes, misses

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
    """(share told, fused planes, NEES / 3 of each) of planes whose stated error is new by a share only."""
    sigma = np.array([2e-3, 1e-3, 5e-4])
    covariance = np.diag(sigma**2)
    fixed = np.sqrt(1.0 - share) * sigma * rng.normal(size=(PLANES, 3))
    novelty, tracks = Novelty() if learns else None, FusedShapes()
    tracks.append(PLANES)
    ids = np.arange(PLANES + 1)
    for _ in range(FRAMES):
        new = np.sqrt(share) * sigma * rng.normal(size=(PLANES, 3))
        forms = [LocalPlane(tilted(e), covariance, np.zeros((3, 3))) for e in fixed + new]
        shapes = fixed_shapes([None, *forms], np.eye(4))
        tracks.fuse(ids - 1, ids.tolist(), shapes, np.zeros(3), TrackingConfig(), novelty)
    nees, planes = [], tracks.told(ids[1:].tolist(), None)
    for told in planes:
        axis = told.pose[:3, 2]
        error = np.array([-axis[1], axis[0], told.pose[2, 3] - 2.0])
        nees.append(float(error @ np.linalg.solve(told.covariance + told.systematic, error)) / 3.0)
    return (novelty.share if novelty else 1.0), planes, nees, covariance


@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
def test_the_share_that_is_new_is_found_and_the_rest_does_not_average_away(share):
    told, planes, nees, covariance = fused_of(share, True, np.random.default_rng(3))
    assert told == pytest.approx(share, rel=0.1)
    # where all is new, a few hundredths that chance took for repeated make the mean of 60 frames less certain
    assert (0.7 if share < 1.0 else 0.25) < np.mean(nees) < 1.4
    alone = np.linalg.slogdet(covariance)[1]
    assert all(np.linalg.slogdet(plane.covariance + plane.systematic)[1] <= alone for plane in planes)


def test_without_it_a_mean_of_frames_that_repeat_an_error_is_far_too_certain():
    assert np.mean(fused_of(0.5, False, np.random.default_rng(3))[2]) > 10


def test_before_anything_is_told_all_is_new_and_what_moved_tells_little():
    novelty = Novelty()
    assert novelty.share == 1.0
    far = np.array([1e9])
    novelty.add(far)
    assert novelty.share == 1.0  # more than all is not new
    for _ in range(20):
        novelty.add(np.zeros(1))
    assert novelty.share == pytest.approx((FIRST + 4.0) / (FIRST + 21.0))
    novelty.add(np.array([np.inf, np.nan]))  # turned over; nothing before
    assert novelty.share == pytest.approx((FIRST + 8.0) / (FIRST + 22.0))
    novelty.add(np.zeros(0))


def test_measurements_of_one_plane_differ_by_the_random_parts_of_both():
    covariance = np.diag([4e-6, 1e-6, 2.5e-7])
    step = np.array([1e-3, -2e-3, 5e-4])
    tracks = FusedShapes()
    tracks.append(2)
    rows, more = np.array([1, 0]), np.zeros((2, 3))
    for parameters in (np.zeros(3), step):
        plane = LocalPlane(tilted(parameters), covariance, np.eye(3))
        shapes = fixed_shapes([None, plane], np.eye(4))
        seen = Planes(rows, *(np.concatenate([part, part]) for part in shapes.planes[1:]))
        told = misses(rows, tracks.planes, seen, more)
        tracks.fuse(np.array([0, 1]), [0, 7], shapes, np.zeros(3), TrackingConfig())
    np.testing.assert_allclose(told[0], step @ np.linalg.solve(2 * covariance, step), rtol=1e-3)
    assert np.isnan(told[1])  # a track that was no plane
