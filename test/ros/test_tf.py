"""Transforms over real topics: latched ones, and those of a camera that moves, by which the node tells tracks
in a fixed frame, and up. The ROS wheels have no tf2_msgs, so the one message is built here, as it stands in
geometry2; publisher and node run in the environment that sees it."""

from __future__ import annotations

import importlib.util
import itertools
import json
import os
import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_extrinsic import QUATERNION, TRANSLATION, _depth_pair, _seen
from workspaces import build, need_colcon

from rcseg_core import RangeColorFrame, SegmenterConfig, segment
from rcseg_core.synthetic import make_journey
from rcseg_core.tracking import KINDS, Tracker

CMAKE = """cmake_minimum_required(VERSION 3.19)
project(tf2_msgs)
find_package(ament_cmake REQUIRED)
find_package(geometry_msgs REQUIRED)
find_package(rosidl_default_generators REQUIRED)
rosidl_generate_interfaces(${PROJECT_NAME} "msg/TFMessage.msg" DEPENDENCIES geometry_msgs)
ament_package()
"""
PACKAGE = """<package format="3"><name>tf2_msgs</name><version>0.36.0</version><description>d</description>
<maintainer email="rcseg@example.org">a</maintainer><license>BSD</license>
<buildtool_depend>ament_cmake</buildtool_depend>
<buildtool_depend>rosidl_default_generators</buildtool_depend><depend>geometry_msgs</depend>
<exec_depend>rosidl_default_runtime</exec_depend><member_of_group>rosidl_interface_packages</member_of_group>
<export><build_type>ament_cmake</build_type></export></package>
"""
PUBLISHER = """
import json
import sys
import rclpy
from geometry_msgs.msg import TransformStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage

rclpy.init()
node = rclpy.create_node("broadcasters")
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def stamped(stamp_ns, parent, child, numbers):
    made = TransformStamped(child_frame_id=child)
    made.header.frame_id = parent
    made.header.stamp.sec, made.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
    t, q = made.transform.translation, made.transform.rotation
    t.x, t.y, t.z, q.x, q.y, q.z, q.w = numbers
    return made


fixed, moving = ([stamped(*hop) for hop in hops] for hops in json.loads(sys.argv[1]))
publishers = []  # one for each fixed hop, as each static_transform_publisher is a process of its own
for hop in fixed:
    publishers.append(node.create_publisher(TFMessage, "/tf_static", latched))
    publishers[-1].publish(TFMessage(transforms=[hop]))
if moving:  # over and over, for whoever begins to listen
    publisher = node.create_publisher(TFMessage, "/tf", 10)
    timer = node.create_timer(0.2, lambda: publisher.publish(TFMessage(transforms=moving)))
print("published", flush=True)
try:
    rclpy.spin(node)
except BaseException:
    pass
"""
BODY, FIXED_FRAME = "base_link", "map"
STEP_NS = 33_333_333


@pytest.fixture(scope="module")
def with_tf2_msgs(tmp_path_factory):
    """Environment variables under which tf2_msgs is installed."""
    if importlib.util.find_spec("tf2_msgs"):
        return dict(os.environ)
    need_colcon()
    folder = tmp_path_factory.mktemp("tf2_msgs")
    source = folder / "tf2_msgs"
    (source / "msg").mkdir(parents=True)
    (source / "CMakeLists.txt").write_text(CMAKE)
    (source / "package.xml").write_text(PACKAGE)
    (source / "msg" / "TFMessage.msg").write_text("geometry_msgs/TransformStamped[] transforms\n")
    return build(folder, "tf2_msgs", 400)


@pytest.fixture
def broadcast(live, with_tf2_msgs):
    """Start publishers of fixed and of moving hops (stamp, parent, child, translation and quaternion) in a
    process of their own; the fixed ones are published before a node starts."""
    processes = []

    def start(fixed, moving=()):
        process = subprocess.Popen(
            [sys.executable, "-c", PUBLISHER, json.dumps([list(fixed), list(moving)])],
            env=with_tf2_msgs | live.ISOLATED, text=True, stdout=subprocess.PIPE, start_new_session=True,
        )  # fmt: skip
        processes.append(process)
        assert process.stdout.readline().strip() == "published"

    yield start
    for process in processes:
        process.terminate()
        process.wait(10 * live.patience())


@pytest.fixture
def hearing(with_tf2_msgs, monkeypatch):
    """Nodes that are started hear transforms."""
    for name in ("PYTHONPATH", "LD_LIBRARY_PATH", "AMENT_PREFIX_PATH"):
        monkeypatch.setenv(name, with_tf2_msgs.get(name, ""))


def numbers_of(pose):
    """Translation and quaternion of a pose (4, 4)."""
    return [*pose[:3, 3].tolist(), *Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()]


def test_depth_is_registered_by_latched_transforms(live, broadcast, hearing, tmp_path):
    broadcast(
        [
            (0, "camera_link", live.FRAME_ID, [0.0] * 6 + [1.0]),
            (0, "camera_link", "depth_optical", [*map(float, TRANSLATION), *map(float, QUATERNION)]),
        ]
    )
    process = live.NodeProcess(
        tmp_path / "static.txt", {}, {"__node": "static_tf", **live.input_topics("static_tf")}
    )
    process.wait_for_output("active")
    peer = live.Peer("static_tf", ("regions",))
    peer.connected("depth", "image", "camera_info", "depth_camera_info")
    stamps = itertools.count(1_764_000_000 * live.SECOND, live.SECOND)

    def heard():  # a frame that overtakes the transforms is refused
        messages, _ = _depth_pair(live, next(stamps))
        peer.publish(**messages)
        live.time.sleep(0.3)
        return peer.received["regions"]

    try:
        stamp = live.stamp_of(live.wait_until(heard, 20, peer.diagnostics)[0])
        geometry = _seen(peer, live, stamp, _depth_pair(live, stamp)[1])
    finally:
        peer.close()
        code, _ = process.stop()
    assert code == 0
    assert "moved by tf from depth_optical to camera_color_optical_frame" in geometry


@pytest.fixture(scope="module")
def journey():
    """Frames of a camera that moves round a table, as a robot sends them, and its poses."""
    scenes = [one.scene for one in make_journey(4, 40, width=160, height=120)]
    frames = [
        RangeColorFrame(s.frame.points.astype(np.float32), s.frame.color, s.frame.camera) for s in scenes
    ]
    return frames, [scene.pose for scene in scenes]


def send(live, peer, frame, stamp):
    info = live.camera_info_of(frame, stamp)
    info.k = frame.camera.matrix().ravel()
    peer.publish(camera_info=info, points=live.cloud_of(frame, stamp), image=live.image_of(frame, stamp))


def test_tracks_stay_and_up_is_known_where_transforms_tell_how_the_camera_moves(
    live, run, broadcast, hearing, journey
):
    """As the library has it with the same poses; and floor and table lie still in the fixed frame."""
    frames, poses = journey
    start = 1_764_000_000 * live.SECOND
    stamps = [start + i * STEP_NS for i in range(len(frames))]
    later = start + 60 * live.SECOND  # until the transforms are heard; time then goes back, tracks begin anew
    mount = np.eye(4)  # the camera on the robot: looks along its x axis
    mount[:3, :3], mount[:3, 3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], (0.1, 0.02, 0.4)
    broadcast(
        [(0, BODY, live.FRAME_ID, numbers_of(mount))],
        [
            (stamp, FIXED_FRAME, BODY, numbers_of(pose @ np.linalg.inv(mount)))
            for stamp, pose in zip([*stamps, later], [*poses, poses[0]], strict=True)
        ],
    )
    parameters = {
        "input.use_tf": True, "tracks.pose_from": "tf", "tracks.fixed_frame": FIXED_FRAME,
        "world.up_from": "tf", "up.frame": FIXED_FRAME,
    }  # fmt: skip
    _, peer = run("moving_tf", parameters, ("tracks", "regions", "ground_points"))
    peer.connected("points", "image", "camera_info")
    before = itertools.count(later)

    def placed():
        stamp = next(before)
        send(live, peer, frames[0], stamp)
        return peer.wait_for("tracks", stamp).fixed

    live.wait_until(placed, 20, peer.diagnostics)
    tracker, shift, normals = Tracker(), None, []
    for frame, pose, stamp in zip(frames, poses, stamps, strict=True):
        send(live, peer, frame, stamp)
        tracks, regions, ground = (peer.wait_for(n, stamp) for n in ("tracks", "regions", "ground_points"))
        up = pose[2, :3]  # the fixed frame's z axis
        result = segment(frame, SegmenterConfig())
        world = result.world(up)
        told = tracker.update(result, stamp, pose, world)
        if shift is None:
            assert "time went back" in tracks.restarted
            shift = min(track.id for track in tracks.tracks) - 1
        assert tracks.fixed and tracks.header.frame_id == FIXED_FRAME and tracks.motion == told.motion
        for kind, numbered in zip(KINDS, (1, 2, 3), strict=True):
            mine = {track.label: track.id - shift for track in tracks.tracks if track.kind == numbered}
            assert [mine[label] for label in range(1, len(told.ids(kind)))] == told.ids(kind)[1:].tolist()
        for track in tracks.tracks:
            for plane in track.plane:
                place, fused = plane.pose.position, told[track.id - shift].fused
                np.testing.assert_allclose((place.x, place.y, place.z), fused.pose[:3, 3], atol=1e-6)
                np.testing.assert_allclose(np.reshape(plane.covariance, (3, 3)), fused.covariance, rtol=1e-5)
        np.testing.assert_allclose((regions.up.x, regions.up.y, regions.up.z), up, atol=1e-6)
        assert ground.width == np.count_nonzero(world.ground == 1) > 500
        floor = next(s for s in regions.surfaces if s.category == s.FLOOR)
        lies = next(track.plane[0].pose for track in tracks.tracks if track.id == floor.track)
        normals.append((floor.track, lies.position.z, up))
    assert len({name for name, _, _ in normals}) == 1
    assert max(abs(height) for _, height, _ in normals) < 0.02
    assert normals[0][2] @ normals[2][2] < np.cos(np.deg2rad(3.0))  # while the camera turned
    assert peer.diagnosed(lambda values: values.get("world.up_from") == "tf")
