"""Ground and obstacles against rooms of which is known where one may stand."""

import cv2
import numpy as np
import pytest

from rcseg_core import SegmenterConfig, segment
from rcseg_core.synthetic import SensorOptions, make_terrain
from rcseg_core.synthetic.terrain import GROUND as TRUE_GROUND
from rcseg_core.synthetic.terrain import OBSTACLE as TRUE_OBSTACLE
from rcseg_core.world import GROUND, NO_DEPTH, OBSTACLE

SEEDS = (1, 3, 4)


@pytest.fixture(scope="module")
def rooms():
    made = [make_terrain(seed, width=320, height=240) for seed in SEEDS]
    return [(room, segment(room.scene.frame)) for room in made]


def figures(room, ground):
    """Share of the floor and of all ground that is found; wrong pixels off the ground's own rim."""
    valid = room.scene.frame.valid
    rim = cv2.dilate((room.ground != TRUE_OBSTACLE).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    floor = np.mean(ground[room.floor & valid] == GROUND)
    found = np.mean(ground[(room.ground == TRUE_GROUND) & valid] == GROUND)
    return floor, found, np.count_nonzero(ground[(room.ground == TRUE_OBSTACLE) & valid & ~rim] == GROUND)


def test_the_truth_of_a_room_is_what_its_heights_say():
    room = make_terrain(3, width=160, height=120)
    pose = room.scene.pose
    height = room.scene.clean_points @ pose[2, :3] + pose[2, 3]
    assert np.abs(height[room.floor]).max() < 1e-9
    assert np.allclose(room.up, pose[2, :3])
    low = room.scene.object_labels == 3  # the low step: all of it may be stood on
    assert (room.ground[low] == TRUE_GROUND).all() and height[low].max() == pytest.approx(0.03)
    high = room.scene.object_labels == 4
    assert set(np.unique(room.ground[high])) <= {0, TRUE_OBSTACLE}


def test_floor_ramps_and_low_steps_are_ground_and_no_obstacle_is(rooms):
    for room, result in rooms:
        floor, found, wrong = figures(room, result.world().ground)
        assert floor > 0.99 and found > 0.98 and wrong == 0


def test_a_wrong_up_is_named_and_does_no_harm(rooms):
    room, result = rooms[0]
    told = room.up + np.tan(np.deg2rad(3.0)) * np.cross(room.up, [0.0, 0.0, 1.0])
    world = result.world(up=told, source="tf")
    assert not world.tilt.expected
    floor, found, wrong = figures(room, world.ground)
    assert floor > 0.99 and found > 0.98 and wrong == 0


def test_what_has_no_depth_is_neither():
    room = make_terrain(4, width=160, height=120, options=SensorOptions(dropout=0.2))
    ground = segment(room.scene.frame).world().ground
    assert (ground[~room.scene.frame.valid] == NO_DEPTH).all()
    assert set(np.unique(ground[room.scene.frame.valid])) == {GROUND, OBSTACLE}


def test_limits_decide_what_can_be_taken(rooms):
    room, _ = rooms[0]
    strict = SegmenterConfig().replace({"world.step_height": 0.01, "world.slope_limit": 3.0})
    wide = SegmenterConfig().replace({"world.step_height": 0.2, "world.slope_limit": 20.0})
    frame, numbers = room.scene.frame, room.scene.object_labels
    narrow, broad = segment(frame, strict).world().ground, segment(frame, wide).world().ground
    assert np.mean(narrow[room.floor] == GROUND) > 0.98
    assert (
        np.mean(narrow[numbers == 3] == GROUND) < 0.1
    )  # 3 cm are too high now, and so is the ramp too steep
    assert np.mean(narrow[numbers == 5] == GROUND) < 0.1
    assert np.mean(broad[numbers == 4] == GROUND) > 0.9  # 15 cm may be climbed


def test_without_a_floor_all_is_obstacle(rooms):
    room, result = rooms[0]
    world = result.world(up=-room.up)
    assert world.floor == 0 and world.tilt is None
    assert (world.ground[room.scene.frame.valid] == OBSTACLE).all()
