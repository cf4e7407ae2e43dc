"""Clouds of another sensor: moved by parameters or by tf2 into the camera's frame, then projected."""

from __future__ import annotations

import sys
import types
from types import SimpleNamespace

import numpy as np
import pytest

from rcseg_core.errors import ConfigError

ANGLE = 0.1
QUATERNION = [0.0, float(np.sin(ANGLE / 2)), 0.0, float(np.cos(ANGLE / 2))]
TRANSLATION = [0.05, -0.02, 0.01]


def _expected():
    c, s = np.cos(ANGLE), np.sin(ANGLE)
    return np.array([[c, 0, s, 0.05], [0, 1, 0, -0.02], [-s, 0, c, 0.01], [0, 0, 0, 1]])


def test_rigid():
    from rcseg_ros.frames.extrinsic import rigid

    np.testing.assert_allclose(rigid(TRANSLATION, QUATERNION), _expected())
    np.testing.assert_allclose(rigid(TRANSLATION, [3 * q for q in QUATERNION]), _expected())
    assert rigid((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)) is None
    with pytest.raises(ConfigError, match="not zero"):
        rigid(TRANSLATION, (0.0, 0.0, 0.0, 0.0))


def test_without_tf2_msgs_moving_transforms_are_refused_and_fixed_ones_left_out(monkeypatch):
    from rcseg_ros.live.transforms import TransformListener

    monkeypatch.setitem(sys.modules, "tf2_msgs", None)
    with pytest.raises(ConfigError, match="tf2_msgs is not installed"):
        TransformListener(None, moving=True)
    listener = TransformListener(None, moving=False)
    assert listener.tree.frames() == []
    listener.destroy()


def _message(parent, child, stamp_ns=0):
    x, y, z = TRANSLATION
    qx, qy, qz, qw = QUATERNION
    transform = SimpleNamespace(
        translation=SimpleNamespace(x=x, y=y, z=z), rotation=SimpleNamespace(x=qx, y=qy, z=qz, w=qw)
    )
    stamp = SimpleNamespace(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    head = SimpleNamespace(stamp=stamp, frame_id=parent)
    stamped = SimpleNamespace(header=head, child_frame_id=child, transform=transform)
    return SimpleNamespace(transforms=[stamped])


@pytest.mark.parametrize("moving", [False, True])
def test_the_node_listens_to_latched_transforms(live, monkeypatch, moving):
    """A stand-in for tf2_msgs, which is not among the ROS wheels, and for the node."""
    from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

    from rcseg_ros.live.transforms import TransformListener

    monkeypatch.setitem(sys.modules, "tf2_msgs", types.ModuleType("tf2_msgs"))
    monkeypatch.setitem(sys.modules, "tf2_msgs.msg", SimpleNamespace(TFMessage=object))
    heard, ended = {}, []
    node = SimpleNamespace(
        create_subscription=lambda kind, topic, callback, qos: heard.setdefault(topic, (callback, qos)),
        destroy_subscription=ended.append,
    )
    listener = TransformListener(node, moving=moving)
    assert set(heard) == ({"/tf_static", "/tf"} if moving else {"/tf_static"})
    callback, qos = heard["/tf_static"]
    assert qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert qos.reliability == ReliabilityPolicy.RELIABLE and qos.depth >= 100
    callback(_message("camera", "lidar"))
    np.testing.assert_allclose(listener.tree.lookup("camera", "lidar"), _expected())
    np.testing.assert_allclose(listener.tree.lookup("lidar", "camera"), np.linalg.inv(_expected()))
    np.testing.assert_array_equal(listener.tree.lookup("camera", "camera"), np.eye(4))
    assert listener.tree.lookup("camera", "radar") is None
    if moving:
        heard["/tf"][0](_message("lidar", "radar", 5))
        assert listener.tree.lookup("camera", "radar") is not None
    listener.destroy()
    assert len(ended) == len(heard)


def test_a_cloud_of_another_frame_over_topics(live, run):
    parameters = {
        "input.extrinsic_translation": f"[{', '.join(map(str, TRANSLATION))}]",
        "input.extrinsic_rotation": f"[{', '.join(map(str, QUATERNION))}]",
    }
    _, peer = run("beside_lidar", parameters, ("labels", "regions"))
    peer.connected("points", "image", "camera_info")
    frame, stamp = live.scene(), 1_760_000_000 * live.SECOND
    inverse = np.linalg.inv(_expected())
    cloud = live.cloud_of(frame, stamp, organized=False)
    cells = np.frombuffer(cloud.data, np.uint8).reshape(-1, cloud.point_step).copy()
    points = cells[:, :12].view(np.float32)
    cells[:, :12] = (points @ inverse[:3, :3].T + inverse[:3, 3]).astype(np.float32).view(np.uint8)
    cloud.data, cloud.header.frame_id = cells.tobytes(), "lidar"
    peer.publish(camera_info=live.camera_info_of(frame, stamp))
    peer.publish(points=cloud, image=live.image_of(frame, stamp))
    message = peer.wait_for("labels", stamp)
    assert message.header.frame_id == live.FRAME_ID, "the points were moved into the camera's frame"
    agreement = live.image_array(message) == live.expected_labels(frame)
    assert agreement.mean() > 0.98  # the points differ by rounding
    region = peer.wait_for("regions", stamp).regions[0]
    assert 0.5 < region.centroid.z < 2.5


def _depth_pair(live, stamp):
    """Depth of a wall from a sensor at _expected() in the colour camera's frame, and both camera_infos."""
    frame = live.scene()
    rays = live.CAMERA.rays(120, 160).astype(float)
    pose = _expected()
    normal = np.array([0.3, -0.1, 1.0])
    turned = rays @ pose[:3, :3].T
    depth = live.depth_of(frame, stamp)
    metres = ((1.5 - normal @ pose[:3, 3]) / (turned @ normal)).astype(np.float32)
    depth.data = metres.tobytes()
    depth.header.frame_id = "depth_optical"
    own = live.camera_info_of(frame, stamp)
    own.header.frame_id = "depth_optical"
    return {
        "camera_info": live.camera_info_of(frame, stamp),
        "depth_camera_info": own,
        "depth": depth,
        "image": live.image_of(frame, stamp),
    }, normal


def _seen(peer, live, stamp, normal):
    """The wall, in the colour camera's frame, and how the message says it came there."""
    message = peer.wait_for("regions", stamp)
    assert message.header.frame_id == live.FRAME_ID
    found = max(message.regions, key=lambda region: region.pixel_count)
    direction = np.array([found.normal.x, found.normal.y, found.normal.z])
    assert abs(direction @ normal) / np.linalg.norm(normal) > 0.9999
    center = np.array([found.centroid.x, found.centroid.y, found.centroid.z])
    assert abs(center @ normal - 1.5) < 2e-3
    return message.geometry


def test_depth_of_another_camera_over_topics(live, run):
    parameters = {
        "input.extrinsic_translation": f"[{', '.join(map(str, TRANSLATION))}]",
        "input.extrinsic_rotation": f"[{', '.join(map(str, QUATERNION))}]",
    }
    _, peer = run("two_cameras", parameters, ("regions",))
    peer.connected("depth", "image", "camera_info", "depth_camera_info")
    stamp = 1_761_000_000 * live.SECOND
    messages, normal = _depth_pair(live, stamp)
    peer.publish(**messages)
    geometry = _seen(peer, live, stamp, normal)
    assert geometry == "K (raw images without distortion); moved by input.extrinsic"
    told = peer.diagnosed(lambda told: told.get("camera.matrix") == "K")
    assert told["camera.registration"] == "moved by input.extrinsic"


def test_two_frames_without_a_transform_are_refused_in_diagnostics(live, run):
    process, peer = run("two_frames", {}, ("regions",))
    peer.connected("depth", "image", "camera_info", "depth_camera_info")
    stamp = 1_762_000_000 * live.SECOND
    messages, _ = _depth_pair(live, stamp)
    peer.publish(**messages)
    words = peer.diagnosed(lambda told: "rejected.no_transform" in told)["rejected.no_transform"]
    assert "depth_optical" in words and live.FRAME_ID in words and "input.assume_registered" in words
    assert "no_transform" in process.output()


def test_rectified_topics_and_an_assumption_over_topics(live, run, tmp_path):
    """By the remapped topics' names the images are rectified; K is of another lens."""
    topics = {"depth": "/cam/depth/image_rect", "image": "/cam/rgb/image_rect_color"}
    process = live.NodeProcess(
        tmp_path / "rect.txt",
        {"input.assume_registered": True},
        {"__node": "rect", **live.input_topics("rect"), **topics},
    )
    process.wait_for_output("active")
    peer = live.Peer("rect", ("regions",), topics=topics)
    peer.connected("depth", "image", "camera_info")
    stamp = 1_763_000_000 * live.SECOND
    frame = live.scene()
    messages = {
        "camera_info": live.camera_info_of(frame, stamp, (-0.2, 0.05, 0.0, 0.0, 0.0)),
        "depth": live.depth_of(frame, stamp),
        "image": live.image_of(frame, stamp),
    }
    k = live.CAMERA.matrix()
    messages["camera_info"].p = np.c_[k, np.zeros(3)].ravel()
    messages["camera_info"].k = (k * [[1.2], [1.2], [1.0]]).ravel()
    messages["depth"].header.frame_id = "depth_optical"
    peer.publish(**messages)
    try:
        message = peer.wait_for("regions", stamp)
    finally:
        peer.close()
        code, _ = process.stop()
    assert code == 0
    np.testing.assert_allclose(message.k.reshape(3, 3), k)
    assert message.geometry.startswith("P (rectified depth and colour)")
    assert "assumed to be registered" in message.geometry
