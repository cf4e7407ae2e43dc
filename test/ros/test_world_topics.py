"""Every output for robots over real topics, as the library says; up from a floor and an IMU."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from rcseg_core import RangeColorFrame, SegmenterConfig, segment
from rcseg_core.synthetic import make_scene

stamps = itertools.count(1_760_000_000_000_000_000, 1_000_000_000)


@pytest.fixture(scope="module")
def frame(live):
    """A floor with blocks on it, through the camera of these tests."""
    scene = make_scene("blocks", 3, width=160, height=120)
    return RangeColorFrame(scene.frame.points.astype(np.float32), scene.frame.color, scene.frame.camera)


def send(live, peer, frame, stamp, **more):
    info = live.camera_info_of(frame, stamp)
    info.k = frame.camera.matrix().ravel()
    peer.publish(camera_info=info, **more)
    peer.publish(points=live.cloud_of(frame, stamp), image=live.image_of(frame, stamp))


@pytest.fixture(scope="module")
def watcher(live, node):
    node.wait_for_output("active")
    peer = live.Peer(outputs=("regions", "markers", *live.WORLD_OUTPUTS))
    peer.connected("points", "image", "camera_info")
    yield peer
    peer.close()


@pytest.fixture(scope="module")
def outputs(live, watcher, frame):
    """Of one frame, all outputs and what the library says of it."""
    stamp = next(stamps)
    send(live, watcher, frame, stamp)
    names = ("regions", "markers", *live.WORLD_OUTPUTS)
    made = {name: watcher.wait_for(name, stamp) for name in names}
    result = segment(frame, SegmenterConfig())
    planes = [s for s in result.surfaces if s.polygon is not None]
    live.wait_until(lambda: len(_of(live, watcher.received["polygons"], stamp)) == len(planes), 5)
    made["polygons"] = _of(live, watcher.received["polygons"], stamp)
    return made, result


def _of(live, messages, stamp):
    return [m for m in messages if live.stamp_of(m) == stamp]


def _points(message):
    cells = np.frombuffer(message.data, np.uint8).reshape(-1, message.point_step)
    return cells[:, :12].copy().view("<f4")


def test_all_carry_the_inputs_stamp_and_frame(live, outputs):
    made, _ = outputs
    for name, message in made.items():
        for one in message if isinstance(message, list) else [message]:
            header = one.markers[0].header if name == "markers" else one.header
            assert header.frame_id == live.FRAME_ID, name


def test_masks_and_labels_are_the_librarys(live, outputs):
    made, result = outputs
    world = result.world()
    assert made["class_mask"].encoding == "mono8"
    np.testing.assert_array_equal(live.image_array(made["class_mask"]), world.class_mask)
    np.testing.assert_array_equal(live.image_array(made["object_labels"]), world.object_labels)
    assert [o.label for o in made["objects"].objects] == [o.label for o in world.objects] != []
    kinds = [s.category for s in made["regions"].surfaces]
    assert made["regions"].surfaces[0].FLOOR in kinds
    assert set(np.unique(world.class_mask)) - {0} == set(kinds)


def test_clouds_are_the_inputs_points(outputs, frame):
    made, result = outputs
    ground = result.world().ground
    np.testing.assert_array_equal(_points(made["ground_points"]), frame.points[ground == 1])
    np.testing.assert_array_equal(_points(made["obstacle_points"]), frame.points[ground == 2])
    cloud = made["labelled_points"]
    assert (cloud.height, cloud.width) == frame.valid.shape
    np.testing.assert_array_equal(
        _points(cloud).reshape(*frame.valid.shape, 3)[frame.valid], frame.points[frame.valid]
    )
    assert [f.name for f in cloud.fields] == ["x", "y", "z", "rgb", "label", "surface", "object", "class"]


def test_polygons_and_their_markers(outputs):
    made, result = outputs
    told = {p.polygon.id for p in made["polygons"]}
    assert told == {s.label for s in result.surfaces if s.polygon is not None} != set()
    drawn = {m.ns for m in made["markers"].markers}
    assert drawn >= {"surfaces", "labels", "polygons", "outlines", "objects", "object_labels"}


def test_diagnostics_tell_up(live, outputs, watcher):
    _, result = outputs
    values = watcher.diagnosed(lambda told: "world.up" in told)
    assert values["world.up_from"] == "floor"
    np.testing.assert_allclose(
        np.array(values["world.up"].split(), float), result.world().up.vector, atol=1e-4
    )


def test_without_a_floor_they_are_silent_and_say_so_once(live, node, watcher):
    scene, known = live.scene(), watcher.count("received.camera_info")
    watcher.publish(camera_info=live.camera_info_of(scene, next(stamps)))
    # another camera than before: it may not be overtaken by the first frame it took
    live.wait_until(lambda: watcher.count("received.camera_info") > known, 20, watcher.diagnostics)
    for _ in range(2):
        stamp = next(stamps)
        watcher.send(scene, stamp, camera=False)
        watcher.wait_for("labelled_points", stamp)
        watcher.wait_for("object_labels", stamp)
    words = (
        "up is unknown, so that class_mask, ground_points and obstacle_points are silent: no floor is seen"
    )
    live.wait_until(lambda: words in node.output(), 5, node.output)
    told = watcher.diagnosed(words)
    assert told["message"] == words and "1" in told["level"]
    assert node.output().count(words) == 1
    for name in ("class_mask", "ground_points", "obstacle_points"):
        assert not _of(live, watcher.received[name], stamp)


def test_up_from_an_imu_and_the_tilt_of_a_wrong_one(live, run, frame):
    process, peer = run("level", {"world.up_from": "imu"}, ("ground_points", "class_mask"))
    peer.connected("points", "image", "camera_info", "imu")
    true = segment(frame, SegmenterConfig()).world().up.vector
    stamp = next(stamps)
    peer.publish(imu=_imu(live, stamp, true))
    live.time.sleep(0.3 * live.patience())  # the frame may not overtake it
    send(live, peer, frame, stamp)
    ground = peer.wait_for("ground_points", stamp)
    assert ground.width > 1000
    values = peer.diagnosed(lambda told: "world.tilt_deg" in told)
    assert values["world.up_from"] == "imu" and float(values["world.tilt_deg"].split()[0]) < 0.5
    turn = np.deg2rad(4.0)
    wrong = np.array(
        [
            true[0] * np.cos(turn) - true[1] * np.sin(turn),
            true[0] * np.sin(turn) + true[1] * np.cos(turn),
            true[2],
        ]
    )
    stamp += 30_000_000_000
    peer.publish(imu=_imu(live, stamp, wrong))
    live.time.sleep(0.3 * live.patience())
    send(live, peer, frame, stamp)
    peer.wait_for("class_mask", stamp)
    words = "degrees against up: the IMU's mounting or its transform is wrong, or it is no floor"
    peer.diagnosed(words)
    assert process.output().count(words) == 1


def _imu(live, stamp, up):
    message = live.Imu(header=live.header(stamp))
    message.orientation_covariance[0] = -1.0
    a = message.linear_acceleration
    a.x, a.y, a.z = (float(v) for v in 9.81 * np.asarray(up))
    return message
