"""Where the camera of an organised cloud stands, from the grid alone; and frames that lie in other axes."""

import numpy as np
import pytest
from test_assembly import camera_message, image_message, range_cloud

from rcseg_core import PinholeCamera
from rcseg_core.synthetic import make_scene
from rcseg_ros.frames.assembly import assemble_frame
from rcseg_ros.frames.axes import pose_of_grid
from rcseg_ros.frames.conversions import MessageError

LIDAR = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # x ahead, y left, z up, of optical axes


def turn(angle, i, j):
    matrix = np.eye(3)
    matrix[[i, i, j, j], [i, j, i, j]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
    return matrix


TILTED = turn(0.3, 0, 1) @ turn(-0.5, 1, 2) @ LIDAR
POSES = {
    "optical": (np.eye(3), np.zeros(3)),
    "x ahead": (LIDAR, np.zeros(3)),
    "tilted": (TILTED, np.zeros(3)),
    "camera_link": (LIDAR, np.array([0.0, 0.015, 0.02])),
    "base_link": (TILTED, np.array([0.3, -0.1, 1.2])),
    "map": (TILTED, np.array([310.0, -220.0, 14.0])),
}


@pytest.fixture(scope="module", params=["room", "blocks"])
def scene(request):
    return make_scene(request.param, 3, width=160, height=120, noise=2.0, dropout=0.2, outliers=0.05).frame


def placed(scene, rotation, shift):
    return (scene.points @ rotation.T + shift).astype(np.float32)


@pytest.mark.parametrize("name", POSES)
def test_the_pose_is_found_from_the_grid(scene, name):
    rotation, shift = POSES[name]
    points = placed(scene, rotation, shift)
    pose = pose_of_grid(points, scene.camera)
    back = points @ pose[:3, :3].T + pose[:3, 3]
    error = np.abs(back - scene.points)[scene.valid]
    assert np.quantile(error, 0.99) < 2e-4 + 1e-6 * np.abs(shift).max()


@pytest.mark.parametrize("name", ["optical", "x ahead"])
def test_conventions_come_out_exactly(scene, name):
    rotation, _ = POSES[name]
    pose = pose_of_grid(placed(scene, rotation, 0), scene.camera)
    np.testing.assert_array_equal(pose[:3, :3], rotation.T)
    np.testing.assert_array_equal(pose[:3, 3], 0)


@pytest.mark.parametrize("name", POSES)
@pytest.mark.parametrize("factor", [0.6, 1.3])
def test_no_pose_is_invented_for_another_camera(scene, name, factor):
    wrong = PinholeCamera(
        factor * scene.camera.fx, factor * scene.camera.fy, scene.camera.cx, scene.camera.cy
    )
    assert pose_of_grid(placed(scene, *POSES[name]), wrong) is None


def test_a_wall_alone_does_not_tell_another_camera_from_another_place():
    camera = PinholeCamera(150, 150, 79.5, 59.5)
    rays = camera.rays(120, 160).astype(float)
    wall = rays * (2 / (rays @ (0.2, 0.1, 1.0)))[..., None]
    assert pose_of_grid(wall, PinholeCamera(220, 220, 79.5, 59.5)) is None
    np.testing.assert_array_equal(pose_of_grid(wall @ LIDAR.T, camera)[:3, :3], LIDAR.T)


def test_too_few_points_tell_nothing():
    points = np.full((120, 160, 3), np.nan)
    camera = PinholeCamera(150, 150, 79.5, 59.5)
    assert pose_of_grid(points, camera) is None
    points[60] = camera.rays(120, 160)[60]
    assert pose_of_grid(points, camera) is None
    assert pose_of_grid(np.zeros((120, 160, 3)), camera) is None
    rng = np.random.default_rng(0)
    assert pose_of_grid(rng.normal(size=(120, 160, 3)), camera) is None


@pytest.mark.parametrize("name", [name for name in POSES if name != "optical"])
def test_a_cloud_in_other_axes_is_a_scanner_grid_in_its_own_frame(scene, name):
    """It was refused: every point is NaN or has z = 0."""
    points = placed(scene, *POSES[name])
    cloud = range_cloud(points, scene.color)
    camera = camera_message(120, 160, scene.camera)
    frame = assemble_frame(cloud, image_message(scene.color), camera)
    assert frame.camera is None
    np.testing.assert_array_equal(frame.points, points)
    np.testing.assert_array_equal(frame.valid, scene.valid)
    elsewhere = camera_message(120, 160, PinholeCamera(90.0, 90.0, 79.5, 59.5))
    with pytest.raises(MessageError, match="in these axes or others") as caught:
        assemble_frame(cloud, image_message(scene.color), elsewhere)
    assert caught.value.reason == "camera_mismatch"


@pytest.mark.parametrize("frame_id", ["lidar", "map"])
def test_a_sweep_of_a_street_keeps_every_point(shared_data, frame_id):
    """A spinning lidar in its own frame and in that of a map, where its floor lies at z = 0."""
    path = shared_data.parent / "field" / "ouster_os2_1024x128.npz"
    if not path.exists():
        pytest.skip(f"no {path.name}")
    with np.load(path) as arrays:
        points, color = arrays["points"], arrays["color"]
    measured = np.isfinite(points).all(axis=2) & points.any(axis=2)
    if frame_id == "map":
        points = points + np.array([310.0, -220.0, 1.8], np.float32)
        points[measured & (np.abs(points[..., 2]) < 0.2), 2] = 0
        points[~measured] = 0
    frame = assemble_frame(range_cloud(points, color))
    assert frame.camera is None
    np.testing.assert_array_equal(frame.valid, measured)
    np.testing.assert_array_equal(frame.points[measured], points[measured])
