"""Which way is up by transforms and IMUs: oracles are rotations whose up is known by construction."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rcseg_ros.frames.extrinsic import TransformTree
from rcseg_ros.frames.up import ImuFilter, UpSettings, UpSource, up_of_orientation, up_of_transform

SECOND = 1_000_000_000
# An optical frame (x right, y down, z forward) that looks along the x axis of a body (x forward, z up).
OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def imu(stamp_ns, acceleration=(0.0, 0.0, 9.81), orientation=None, frame_id="imu"):
    x, y, z, w = (0.0, 0.0, 0.0, 1.0) if orientation is None else orientation
    sec, nanosec = divmod(stamp_ns, SECOND)
    return SimpleNamespace(
        header=SimpleNamespace(frame_id=frame_id, stamp=SimpleNamespace(sec=sec, nanosec=nanosec)),
        orientation=SimpleNamespace(x=x, y=y, z=z, w=w),
        orientation_covariance=np.full(9, -1.0 if orientation is None else 0.0),
        linear_acceleration=SimpleNamespace(**dict(zip("xyz", acceleration, strict=True))),
    )


def tree(*links):
    """A TransformTree of (parent, child, rotation matrix) links."""
    made = TransformTree()
    for parent, child, matrix in links:
        x, y, z, w = Rotation.from_matrix(matrix).as_quat()
        stamped = SimpleNamespace(
            header=SimpleNamespace(frame_id=parent, stamp=SimpleNamespace(sec=0, nanosec=0)),
            child_frame_id=child,
            transform=SimpleNamespace(
                translation=SimpleNamespace(x=0.3, y=-0.2, z=1.1),
                rotation=SimpleNamespace(x=x, y=y, z=z, w=w),
            ),
        )
        made.add(SimpleNamespace(transforms=[stamped]), fixed=True)
    return made


def test_a_level_camera_has_up_along_minus_y():
    source = UpSource(UpSettings(frame="base"), tree(("base", "camera", OPTICAL)))
    np.testing.assert_allclose(source.at("tf", "camera", 0).vector, (0, -1, 0), atol=1e-12)


@pytest.mark.parametrize("degrees", [-40.0, 25.0, 90.0])
def test_a_camera_that_looks_down_sees_up_behind_it(degrees):
    pitch = Rotation.from_euler("y", degrees, degrees=True).as_matrix()  # positive: nose down
    told = UpSource(
        UpSettings(frame="odom"), tree(("odom", "base", np.eye(3)), ("base", "camera", pitch @ OPTICAL))
    )
    angle = np.deg2rad(degrees)
    np.testing.assert_allclose(
        told.at("tf", "/camera", 5).vector, (0, -np.cos(angle), -np.sin(angle)), atol=1e-12
    )


def test_an_unknown_transform_is_told_with_what_there_is():
    told = UpSource(UpSettings(frame="map"), tree(("base", "camera", OPTICAL))).at("tf", "camera", 0)
    assert told.vector is None
    assert told.reason == "no transform from camera to map (up.frame); known frames: base, camera"


@pytest.mark.parametrize("source", ["floor", "parameter", "none"])
def test_of_other_sources_nothing_is_told(source):
    told = UpSource().at(source, "camera", 0)
    assert told.vector is None and not told.reason


def test_up_does_not_turn_about_the_vertical():
    for yaw in (0.0, 1.0, -2.5):
        turned = Rotation.from_euler("ZYX", [yaw, 0.3, -0.2])
        matrix = np.eye(4)
        matrix[:3, :3] = turned.as_matrix()
        expected = Rotation.from_euler("ZYX", [0.0, 0.3, -0.2]).inv().apply([0, 0, 1])
        np.testing.assert_allclose(up_of_transform(matrix), expected, atol=1e-12)
        np.testing.assert_allclose(up_of_orientation(turned.as_quat()), expected, atol=1e-12)


def test_acceleration_is_averaged_over_the_time_constant():
    """White noise s at rate f through a first-order low pass of time t keeps s / sqrt(2 f t)."""
    rng = np.random.default_rng(5)
    rate, seconds, true = 200, 0.5, np.array([3.0, -8.0, 4.0])
    true *= 9.81 / np.linalg.norm(true)
    imus, errors = ImuFilter(UpSettings(imu_low_pass_s=seconds)), []
    for i in range(2000):
        stamp = i * SECOND // rate
        imus.add(imu(stamp, true + rng.normal(0, 0.5, 3)))
        if stamp > 5 * seconds * SECOND:
            errors.append(imus.at(stamp) * 9.81 - true)
    across = np.std(np.array(errors) @ np.linalg.svd(true[None])[2][1:].T)
    assert across == pytest.approx(0.5 / np.sqrt(2 * rate * seconds), rel=0.25)


def test_a_step_of_acceleration_is_followed_within_its_time():
    imus = ImuFilter(UpSettings(imu_low_pass_s=0.5))
    for i in range(101):
        imus.add(
            imu(i * SECOND // 100, (0, 0, 9.81) if i == 0 else (9.81 * np.sin(0.1), 0, 9.81 * np.cos(0.1)))
        )
    angle = np.arctan2(*imus.at(SECOND)[[0, 2]])
    assert angle == pytest.approx(0.1 * (1 - np.exp(-2)), rel=0.01)


def test_the_orientation_goes_before_the_acceleration_where_there_is_one():
    turned = Rotation.from_euler("x", 0.4)
    samples = [imu(SECOND, (0, 0, 9.81), turned.as_quat())]
    expected = {
        "auto": turned.inv().apply([0, 0, 1]),
        "orientation": turned.inv().apply([0, 0, 1]),
        "acceleration": [0, 0, 1],
    }
    for how, up in expected.items():
        imus = ImuFilter(UpSettings(imu_from=how))
        for sample in samples:
            imus.add(sample)
        np.testing.assert_allclose(imus.at(SECOND), up, atol=1e-12)


@pytest.mark.parametrize(
    ("settings", "message", "words"),
    [
        ({}, imu(0, (0, 0, 1.0)), "mean acceleration is 1.00 m/s^2, not gravity's"),  # in g
        ({}, imu(0, (0, 0, 0.0)), "mean acceleration is 0.00"),
        ({}, imu(0, (np.nan, 0, 9.81)), "not finite"),
        ({"imu_from": "orientation"}, imu(0), "gives no orientation"),
        ({"imu_from": "orientation"}, imu(0, orientation=(0, 0, 0, 0)), "gives no orientation"),
        ({}, None, "no message of the IMU yet"),
        ({}, imu(9 * SECOND), "the nearest IMU message is -8.0 s from the frame"),
    ],
)
def test_what_an_imu_does_not_tell_is_said(settings, message, words):
    source = UpSource(UpSettings(**settings), tree(("camera", "imu", np.eye(3))))
    if message is not None:
        source.imu.add(message)
    told = source.at("imu", "camera", SECOND)
    assert told.vector is None and words in told.reason


def test_an_imu_of_another_frame_is_turned_into_the_cameras():
    source = UpSource(transforms=tree(("base", "imu", np.eye(3)), ("base", "camera", OPTICAL)))
    source.imu.add(imu(SECOND))
    np.testing.assert_allclose(source.at("imu", "camera", SECOND).vector, (0, -1, 0), atol=1e-12)
    assert source.at("imu", "imu", SECOND).vector[2] == pytest.approx(1)
    assert source.at("imu", "other", SECOND).reason == "no transform from the IMU's frame imu to other"


def test_the_sample_nearest_to_the_frame_counts_and_time_may_go_back():
    imus = ImuFilter(UpSettings(imu_low_pass_s=1e-3))
    for i, x in enumerate((0.0, 3.0, -3.0)):
        imus.add(imu((10 + i) * SECOND // 10, (x, 0, 9.3)))
    assert imus.at(SECOND + SECOND // 10)[0] > 0.2 and imus.at(SECOND + SECOND // 5)[0] < -0.2
    imus.add(imu(0, (0, 0, 9.81)))
    assert imus.at(SECOND + SECOND // 5) is None and imus.at(0)[2] == pytest.approx(1)
