"""Pairs of messages become registered frames: sizes, cameras, projection, and a reason for every refusal."""

from types import SimpleNamespace

import numpy as np
import pytest

from rcseg_core import InputError, PinholeCamera
from rcseg_ros.frames.assembly import assemble_frame
from rcseg_ros.frames.cloud_frames import project_cloud
from rcseg_ros.frames.conversions import CameraModel, Header, MessageError
from rcseg_ros.results.outputs import cloud_message, depth_message, picture_message

HEIGHT, WIDTH = 30, 40
PINHOLE = PinholeCamera(50.0, 52.0, 19.5, 14.5)
RNG = np.random.default_rng(3)
COLOR = RNG.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
DEPTH = (1 + RNG.random((HEIGHT, WIDTH))).astype(np.float32)
POINTS = PINHOLE.rays(HEIGHT, WIDTH) * DEPTH[..., None]


def make(_, **fields):
    return SimpleNamespace(**fields)


def camera_message(height=HEIGHT, width=WIDTH, pinhole=PINHOLE, d=()):
    roi = SimpleNamespace(x_offset=0, y_offset=0, height=0, width=0)
    return SimpleNamespace(
        header=SimpleNamespace(frame_id="cam"), height=height, width=width, k=pinhole.matrix().ravel(), d=d,
        distortion_model="plumb_bob", binning_x=0, binning_y=0, roi=roi,
    )  # fmt: skip


def image_message(color=COLOR):
    return picture_message(color, Header(0, "cam"), make)


def range_cloud(points=POINTS, color=COLOR, own_color=True):
    shape = points.shape[:2]
    message = cloud_message(
        points, np.broadcast_to(color, points.shape), np.zeros(shape, np.int32), None, make
    )
    message.fields = [f for f in message.fields if own_color or f.name != "rgb"]
    return message


def reason(*arguments):
    with pytest.raises(MessageError) as caught:
        assemble_frame(*arguments)
    return caught.value.reason


def test_depth_image():
    frame = assemble_frame(depth_message(DEPTH, None, make), image_message(), camera_message())
    np.testing.assert_allclose(frame.points, POINTS, rtol=1e-6)
    np.testing.assert_array_equal(frame.color, COLOR)
    assert frame.camera == PINHOLE


def test_organised_cloud_with_image_with_own_colour_and_as_scanner_grid():
    frame = assemble_frame(range_cloud(color=[1, 2, 3]), image_message(), camera_message())
    np.testing.assert_array_equal(frame.points, POINTS)
    np.testing.assert_array_equal(frame.color, COLOR)
    assert frame.camera == PINHOLE
    frame = assemble_frame(range_cloud(), None, None)
    np.testing.assert_array_equal(frame.color, COLOR)
    assert frame.camera is None


def test_unorganised_cloud_is_projected_into_the_image():
    order = RNG.permutation(HEIGHT * WIDTH)
    message = range_cloud(POINTS.reshape(1, -1, 3)[:, order], COLOR.reshape(1, -1, 3)[:, order])
    for image in (None, image_message()):
        frame = assemble_frame(message, image, camera_message())
        np.testing.assert_array_equal(frame.points, POINTS)
        np.testing.assert_array_equal(frame.color, COLOR)


def test_cloud_of_another_grid_is_projected_into_the_image():
    frame = assemble_frame(range_cloud(POINTS[::2, ::3], COLOR[::2, ::3]), image_message(), camera_message())
    assert frame.points.shape == (HEIGHT, WIDTH, 3)
    np.testing.assert_array_equal(frame.points[::2, ::3], POINTS[::2, ::3])
    assert frame.valid.sum() == POINTS[::2, ::3, 0].size


def test_extrinsic_moves_the_cloud_before_projection():
    cloud_to_camera = np.eye(4)
    cloud_to_camera[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]  # x forward, y left, z up to optical axes
    cloud_to_camera[:3, 3] = [0.1, -0.2, 0.3]
    in_robot = (POINTS - cloud_to_camera[:3, 3]) @ cloud_to_camera[:3, :3]
    frame = assemble_frame(
        range_cloud(in_robot.astype(np.float32)), image_message(), camera_message(), cloud_to_camera
    )
    np.testing.assert_allclose(frame.points[frame.valid], POINTS[frame.valid], atol=1e-5)
    assert frame.valid.mean() > 0.98


def test_of_two_points_in_a_pixel_the_nearer_wins_and_then_the_first():
    camera = CameraModel(PINHOLE, HEIGHT, WIDTH)
    ray = PINHOLE.rays(HEIGHT, WIDTH)[7, 9]
    points = np.array([ray * 2, ray * 1, ray * 3, ray * 1], np.float32)
    color = np.arange(12, dtype=np.uint8).reshape(4, 3)
    grid, grid_color = project_cloud(points, camera, color)
    np.testing.assert_allclose(grid[7, 9], ray, rtol=1e-6)
    np.testing.assert_array_equal(grid_color[7, 9], color[1])
    assert np.isfinite(grid).all(axis=2).sum() == 1


def test_points_behind_outside_and_invalid_are_left_out():
    camera = CameraModel(PINHOLE, HEIGHT, WIDTH)
    points = np.array([[0, 0, -1], [0, 0, 0], [np.nan, 0, 1], [50, 0, 1], [1e6, 1e6, 1], [0, 0, np.inf]])
    grid, _ = project_cloud(points, camera)
    assert not np.isfinite(grid).any()


def test_every_refusal_has_its_reason():
    small = image_message(COLOR[:20])
    depth = depth_message(DEPTH, None, make)
    assert reason(depth, image_message(), None) == "no_camera_info"
    assert reason(depth, None, camera_message()) == "no_color"
    assert reason(depth, small, camera_message()) == "size_mismatch"
    assert reason(depth, image_message(), camera_message(height=20)) == "size_mismatch"
    assert reason(range_cloud(), small, None) == "size_mismatch"
    assert reason(range_cloud(), small, camera_message()) == "size_mismatch"
    assert reason(range_cloud(), None, camera_message(width=20)) == "size_mismatch"
    assert reason(range_cloud(own_color=False), None, None) == "no_color"
    assert reason(range_cloud(own_color=False), None, camera_message()) == "no_color"
    flat = range_cloud(POINTS.reshape(1, -1, 3), COLOR.reshape(1, -1, 3))
    assert reason(flat, image_message(), None) == "no_camera_info"
    assert reason(range_cloud(), image_message(), None, np.eye(4)) == "no_camera_info"
    elsewhere = PinholeCamera(150.0, 150.0, 19.5, 14.5)
    assert reason(range_cloud(), image_message(), camera_message(pinhole=elsewhere)) == "camera_mismatch"


def test_a_frame_without_a_valid_pixel_is_refused():
    with pytest.raises(InputError, match="no valid pixel"):
        assemble_frame(depth_message(DEPTH * np.nan, None, make), image_message(), camera_message())
    with pytest.raises(InputError, match="no valid pixel"):
        assemble_frame(range_cloud(POINTS * np.nan), image_message(), camera_message())
