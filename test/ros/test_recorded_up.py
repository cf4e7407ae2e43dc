"""Up from recordings: moving transforms, an IMU of another frame, what is missing; replay says the same."""

from __future__ import annotations

import numpy as np
import pytest
from recordings import FRAME_ID, Entry, cloud_entries, stamps, write_folder
from scipy.spatial.transform import Rotation

from rcseg_core import SegmenterConfig
from rcseg_core.errors import InputError
from rcseg_ros.commands.replay import ReplayRequest, replay
from rcseg_ros.frames.conversions import Header
from rcseg_ros.frames.extrinsic import recorded_transforms
from rcseg_ros.recordings.bag import Recording
from rcseg_ros.recordings.result_bag import make_message
from rcseg_ros.recordings.up import parse_up, recorded_up
from rcseg_ros.results.outputs import header_message

# The camera of these recordings looks along the x axis of the body, which pitches by a degree a frame.
OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def pitched(i):
    return Rotation.from_euler("y", i, degrees=True)


def expected(i):
    return np.array([0.0, -np.cos(np.deg2rad(i)), -np.sin(np.deg2rad(i))])


def transform(topic, parent, child, turn, stamp):
    x, y, z, w = turn.as_quat().tolist()
    stamped = make_message(
        "geometry_msgs/msg/TransformStamped",
        header=header_message(Header(stamp, parent), make_message),
        child_frame_id=child,
        transform=make_message(
            "geometry_msgs/msg/Transform",
            translation=make_message("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=1.0),
            rotation=make_message("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        ),
    )
    return Entry(topic, make_message("tf2_msgs/msg/TFMessage", transforms=[stamped]), stamp)


def imu(stamp, up):
    x, y, z = (9.81 * up).tolist()
    message = make_message(
        "sensor_msgs/msg/Imu",
        header=header_message(Header(stamp, "imu_link"), make_message),
        orientation=make_message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=np.array([-1.0, *[0.0] * 8]),
        angular_velocity=make_message("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=make_message("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
        linear_acceleration_covariance=np.zeros(9),
    )
    return Entry("/imu", message, stamp)


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    entries = [transform("/tf_static", "body", FRAME_ID, Rotation.from_matrix(OPTICAL), stamps(1)[0])]
    entries.append(transform("/tf_static", "body", "imu_link", Rotation.identity(), stamps(1)[0]))
    for i, stamp in enumerate(stamps(3)):
        entries.append(transform("/tf", "odom", "body", pitched(i), stamp))
        entries.append(imu(stamp, pitched(i).inv().apply([0.0, 0.0, 1.0])))
    return write_folder(tmp_path_factory.mktemp("up") / "bag", entries + cloud_entries())


def up_of(bag, text):
    config, request = parse_up(text, SegmenterConfig())
    up_from = config.world.up_from
    with Recording(bag) as recording:
        transforms = recorded_transforms(recording, "/camera/points", None)
        source = recorded_up(recording, "/camera/points", up_from, request, transforms)
        return [source.at(up_from, FRAME_ID, stamp) for stamp in stamps(3)]


def test_moving_transforms_are_followed(bag):
    for i, told in enumerate(up_of(bag, "tf:odom")):
        np.testing.assert_allclose(told.vector, expected(i), atol=1e-12)
    np.testing.assert_allclose([t.vector for t in up_of(bag, "tf:body")], [(0, -1, 0)] * 3, atol=1e-12)


@pytest.mark.parametrize("text", ["imu", "imu:/imu"])
def test_an_imu_is_followed_at_its_pace(bag, text):
    told = [t.vector for t in up_of(bag, text)]
    np.testing.assert_allclose(told[0], expected(0), atol=1e-9)
    assert 0 < np.arccos(told[2] @ told[0]) < np.deg2rad(2)  # the mean lags behind


def test_what_is_not_there_is_named(bag, tmp_path):
    assert "no transform from camera_optical_frame to map" in up_of(bag, "tf:map")[0].reason
    with pytest.raises(InputError, match=r"no sensor_msgs/msg/Imu on /other in .*; it has /imu"):
        up_of(bag, "imu:/other")
    bare = write_folder(tmp_path / "bare", cloud_entries(1))
    with pytest.raises(InputError, match="it has no topic of that type"):
        up_of(bare, "imu")


@pytest.mark.parametrize("text", ["tf", "tf:", "up", "1,2", "0,nan,x"])
def test_words_that_say_no_up_are_refused(text):
    with pytest.raises(InputError, match="expected tf:FRAME, imu, imu:TOPIC, X,Y,Z, floor or none"):
        parse_up(text, SegmenterConfig())


def test_words_of_the_configuration():
    config, _ = parse_up("0,-2,0.5", SegmenterConfig())
    assert (config.world.up_from, config.world.up_y, config.world.up_z) == ("parameter", -2.0, 0.5)
    assert parse_up("none", SegmenterConfig())[0].world.up_from == "none"
    assert parse_up("", config)[0] is config


@pytest.mark.parametrize(("text", "there"), [("tf:odom", True), ("none", False)])
def test_replay_writes_the_outputs_for_robots(bag, tmp_path, text, there):
    from rcseg_ros.recordings.segmenting import CLOUDS, OUTPUTS

    config, request = parse_up(text, SegmenterConfig())
    replay(ReplayRequest(bag, tmp_path / "out", config, up=request, outputs=(*OUTPUTS, *CLOUDS), workers=1))
    with Recording(tmp_path / "out") as recording:
        counts = {name.removeprefix("/rcseg/"): topic.count for name, topic in recording.topics.items()}
        assert counts["objects"] == counts["object_labels"] == counts["labelled_points"] == 3
        assert counts["polygons"] >= 3
        silent = [counts.get(name, 0) for name in ("class_mask", "ground_points", "obstacle_points")]
        assert silent == ([3, 3, 3] if there else [0, 0, 0])
        ups = [m.up for m in map(recording.decode, recording.messages(["/rcseg/regions"]))]
    for i, up in enumerate(ups):
        wanted = expected(i) if there else [np.nan] * 3
        np.testing.assert_allclose((up.x, up.y, up.z), wanted, atol=1e-9)
