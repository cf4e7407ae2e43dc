"""Latched transforms over real topics. The ROS wheels have no tf2_msgs, so the one message is built here, as
it stands in geometry2; publisher and node run in the environment that sees it."""

from __future__ import annotations

import importlib.util
import itertools
import os
import subprocess
import sys

import pytest
from test_extrinsic import QUATERNION, TRANSLATION, _depth_pair, _seen
from workspaces import build, need_colcon

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
import sys
import rclpy
from geometry_msgs.msg import TransformStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage

rclpy.init()
node = rclpy.create_node("static_broadcasters")
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
numbers = [float(number) for number in sys.argv[1].split(",")]
hops = [
    ("camera_link", "camera_color_optical_frame", [0.0] * 6 + [1.0]),
    ("camera_link", "depth_optical", numbers),
]
publishers = []  # one for each hop, as each static_transform_publisher is a process of its own
for parent, child, (x, y, z, qx, qy, qz, qw) in hops:
    stamped = TransformStamped(child_frame_id=child)
    stamped.header.frame_id = parent
    t, q = stamped.transform.translation, stamped.transform.rotation
    t.x, t.y, t.z, q.x, q.y, q.z, q.w = x, y, z, qx, qy, qz, qw
    publishers.append(node.create_publisher(TFMessage, "/tf_static", latched))
    publishers[-1].publish(TFMessage(transforms=[stamped]))
print("published", flush=True)
try:
    rclpy.spin(node)
except BaseException:
    pass
"""


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
def broadcaster(live, with_tf2_msgs):
    """Latched publishers of a chain, in a process of their own; they have published before a node starts."""
    numbers = ",".join(map(str, [*TRANSLATION, *QUATERNION]))
    process = subprocess.Popen(
        [sys.executable, "-c", PUBLISHER, numbers], env=with_tf2_msgs | live.ISOLATED, text=True,
        stdout=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip
    assert process.stdout.readline().strip() == "published"
    yield process
    process.terminate()
    process.wait(10)


def test_depth_is_registered_by_latched_transforms(live, broadcaster, with_tf2_msgs, monkeypatch, tmp_path):
    for name in ("PYTHONPATH", "LD_LIBRARY_PATH", "AMENT_PREFIX_PATH"):
        monkeypatch.setenv(name, with_tf2_msgs.get(name, ""))
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
