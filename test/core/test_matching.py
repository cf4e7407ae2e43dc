"""Which track is which label: overlaps, forbidden pairs, and shapes that cannot be one."""

import numpy as np
import pytest

from rcseg_core import PinholeCamera, RangeColorFrame, segment
from rcseg_core.config import TrackingConfig
from rcseg_core.shapes.local_forms import LocalSphere
from rcseg_core.shapes.plane_forms import LocalPlane
from rcseg_core.tracking import Tracker
from rcseg_core.tracking.matching import COLOR_SIGMA, Side, assign, may_be_one, scores

CAMERA = PinholeCamera(80.0, 80.0, 31.5, 23.5)


def test_scores_are_intersections_over_unions_however_small_and_a_bonus_for_colour():
    common = np.array([[0.5, 0.0], [0.25, 3.0]])
    gray, unknown = np.full((2, 3), 90.0), np.full((2, 3), np.nan)
    config = TrackingConfig(min_overlap=0.02)
    free = np.ones(2, bool)
    share = np.array([[0.5 / 0.75, 0], [0.25 / 4.25, 0.75]])
    tracks, labels = Side(np.array([0.75, 4.0]), gray), Side(np.array([0.5, 3.0]), gray)
    score, allowed = scores(common, tracks, labels, free, config)
    np.testing.assert_allclose(score, np.where(share > 0, share + config.color_weight, 0))
    assert allowed.tolist() == [[True, False], [True, True]]
    score, _ = scores(common, tracks, labels._replace(color=unknown), free, config)
    np.testing.assert_allclose(score, share)
    far = labels._replace(color=gray + np.array([COLOR_SIGMA, 0, 0]))
    score, _ = scores(common, tracks, far, free, config)
    np.testing.assert_allclose(score[1, 1], 0.75 + config.color_weight * np.exp(-0.5))
    score, allowed = scores(common, tracks, labels, np.array([True, False]), TrackingConfig())
    assert allowed.tolist() == [[True, False], [False, False]] and not score[~allowed].any()
    nothing = Side(np.zeros(1), gray[:1])
    assert scores(np.zeros((1, 1)), nothing, nothing, free[:1], config)[0] == 0, "nothing over nothing"


def test_no_pair_of_score_zero_is_made():
    rows, columns = assign(np.array([[0.0, 2.0], [0.0, 3.0]]))
    assert rows.tolist() == [1] and columns.tolist() == [1]
    for empty in (np.zeros((0, 3)), np.zeros((2, 0)), np.zeros((2, 2))):
        assert [len(part) for part in assign(empty)] == [0, 0]


def test_two_kinds_of_shape_tell_nothing_and_two_planes_apart_are_not_one():
    exact, more = 1e-6 * np.eye(3), np.zeros(3)
    plane, other = np.eye(4), np.eye(4)
    other[2, 3] = 0.1
    plane, other = (LocalPlane(pose, exact, 0 * exact) for pose in (plane, other))
    sphere = LocalSphere(np.zeros(3), 1.0, 1e-6 * np.eye(4), np.zeros((4, 4)))
    assert may_be_one(plane, sphere, more, 1e-5) and may_be_one(sphere, plane, more, 1e-5)
    assert may_be_one(plane, plane, more, 1e-5)
    assert not may_be_one(plane, other, more, 1e-5)


def wall(degrees):
    """A wall two metres away that is turned about the vertical axis."""
    cols = np.broadcast_to((np.arange(64) - CAMERA.cx) / CAMERA.fx, (48, 64))
    depth = 2.0 / (1.0 + np.tan(np.deg2rad(degrees)) * cols)
    depth = depth + np.random.default_rng(0).normal(0, 5e-4, depth.shape)
    return RangeColorFrame.from_depth(depth.astype(np.float32), np.full((48, 64, 3), 90, np.uint8), CAMERA)


@pytest.mark.parametrize(("degrees", "same"), [(0.3, True), (10.0, False)])
def test_a_wall_in_place_of_another_has_a_name_of_its_own(degrees, same):
    """All its pixels lie over those of the other: shapes alone tell them apart."""
    tracker = Tracker(TrackingConfig(depth_tolerance=0.5))
    first = tracker.update(segment(wall(0.0)), 0, np.eye(4))
    second = tracker.update(segment(wall(degrees)), 33_000_000, np.eye(4))
    assert len(first.surface_ids) == len(second.surface_ids) == 2
    assert (first.surface_ids[1] == second.surface_ids[1]) == same
