"""Clouds of another sensor: moved by parameters or by tf2 into the camera's frame, then projected."""

from __future__ import annotations

import sys
import types
from types import SimpleNamespace

import numpy as np
import pytest

from rcseg_core.errors import ConfigError
from rcseg_ros.conversions import MessageError

ANGLE = 0.1
QUATERNION = [0.0, float(np.sin(ANGLE / 2)), 0.0, float(np.cos(ANGLE / 2))]
TRANSLATION = [0.05, -0.02, 0.01]


def _expected():
    c, s = np.cos(ANGLE), np.sin(ANGLE)
    return np.array([[c, 0, s, 0.05], [0, 1, 0, -0.02], [-s, 0, c, 0.01], [0, 0, 0, 1]])


def test_rigid():
    from rcseg_ros.extrinsic import rigid

    np.testing.assert_allclose(rigid(TRANSLATION, QUATERNION), _expected())
    np.testing.assert_allclose(rigid(TRANSLATION, [3 * q for q in QUATERNION]), _expected())
    assert rigid((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)) is None
    with pytest.raises(ConfigError, match="not zero"):
        rigid(TRANSLATION, (0.0, 0.0, 0.0, 0.0))


def test_without_tf2_the_parameter_is_refused(live, monkeypatch):
    from rcseg_ros.extrinsic import TransformListener

    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    with pytest.raises(ConfigError, match="tf2_ros is not installed"):
        TransformListener(node=None)


def test_transforms_of_tf2(live, monkeypatch):
    """A stand-in for tf2_ros, which is not among the ROS wheels; its interface is that of ROS 2 Jazzy."""
    from rcseg_ros.extrinsic import TransformListener

    class TransformError(Exception):
        pass

    class Buffer:
        def lookup_transform(self, target, source, time):
            if (target, source) != ("camera", "lidar"):
                raise TransformError("not connected")
            x, y, z = TRANSLATION
            qx, qy, qz, qw = QUATERNION
            transform = SimpleNamespace(
                translation=SimpleNamespace(x=x, y=y, z=z), rotation=SimpleNamespace(x=qx, y=qy, z=qz, w=qw)
            )
            return SimpleNamespace(transform=transform)

    ended = []
    module = types.ModuleType("tf2_ros")
    module.Buffer, module.TransformException = Buffer, TransformError
    module.TransformListener = lambda buffer, node: SimpleNamespace(unregister=lambda: ended.append(True))
    monkeypatch.setitem(sys.modules, "tf2_ros", module)
    listener = TransformListener(node=None)
    np.testing.assert_allclose(listener.lookup("camera", "lidar"), _expected())
    assert listener.lookup("camera", "camera") is None
    with pytest.raises(MessageError, match="no transform from radar to camera: not connected") as caught:
        listener.lookup("camera", "radar")
    assert caught.value.reason == "no_transform"
    listener.destroy()
    assert ended == [True]


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
