"""Tracks over topics: with the poses of an odometry, and without any."""

from __future__ import annotations

import numpy as np
import pytest
from live import FRAME_ID, SECOND, NodeProcess, Peer, header, image_array, scene, stamp_of, wait_until
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile

START_NS = 1_700_000_000 * SECOND
STEP_NS = 100_000_000


def run_node(log, parameters):
    process = NodeProcess(log, parameters)
    process.wait_for_output("active: waiting for", 300.0)
    return process


def odometry_at(stamp_ns, x):
    """A camera that is moved along z of its own frame, 0.1 mm a frame."""
    message = Odometry(header=header(stamp_ns, "odom"), child_frame_id=FRAME_ID)
    message.pose.pose.position.z = x
    message.pose.pose.orientation.w = 1.0
    return message


def follow(peer, frame, count):
    """Send a frame several times; the tracks and regions of each."""
    arrays = []
    for i in range(count):
        stamp = START_NS + i * STEP_NS
        peer.send(frame, stamp)
        arrays.append((peer.wait_for("tracks", stamp, 60.0), peer.wait_for("regions", stamp, 60.0)))
    return arrays


@pytest.fixture
def peer():
    made = Peer(outputs=("labels", "surface_labels", "regions", "markers", "tracks"))
    yield made
    made.close()


def check_names(arrays):
    first = [surface.track for surface in arrays[0][1].surfaces]
    assert len(set(first)) == len(first) > 1 and 0 not in first
    for tracks, regions in arrays:
        assert [surface.track for surface in regions.surfaces] == first
        told = {track.id: track for track in tracks.tracks}
        assert all(told[s.track].label == s.label for s in regions.surfaces)
        assert all(told[r.track].kind == 2 for r in regions.regions)
    assert {t.state for t in arrays[-1][0].tracks} == {2}  # confirmed


def test_names_without_poses_and_label_images_of_them(peer, tmp_path):
    process = run_node(tmp_path / "log", {"tracks.label_images": True})
    try:
        peer.connected("points", "image")
        arrays = follow(peer, scene(), 3)
        check_names(arrays)
        assert arrays[0][0].motion == "start"
        assert all(not a.fixed and a.header.frame_id == FRAME_ID for a, _ in arrays)
        regions = arrays[-1][1]
        shown = image_array(peer.wait_for("labels", stamp_of(regions)))
        assert set(np.unique(shown).tolist()) - {0} == {region.track for region in regions.regions}
        markers = peer.wait_for("markers", stamp_of(regions)).markers
        assert {m.id for m in markers if m.ns == "boxes"} <= {region.track for region in regions.regions}
        # a bag that loops: time goes back, all tracks end, and no id is used again
        last = max(track.id for track in arrays[-1][0].tracks)
        peer.send(scene(), START_NS - SECOND)
        again = peer.wait_for("tracks", START_NS - SECOND, 60.0)
        assert "time went back" in again.restarted and min(t.id for t in again.tracks) > last
        assert len(again.ended) == len(arrays[-1][0].tracks)
    finally:
        process.stop()


def test_names_with_the_poses_of_an_odometry(peer, tmp_path):
    publisher = peer.node.create_publisher(Odometry, "odom", QoSProfile(depth=10))
    process = run_node(tmp_path / "log", {"tracks.pose_from": "odometry"})
    try:
        peer.connected("points", "image")
        wait_until(publisher.get_subscription_count, 20)
        for i in range(4):
            publisher.publish(odometry_at(START_NS + i * STEP_NS, 1e-4 * i))
        arrays = follow(peer, scene(), 3)
        check_names(arrays)
        assert all(a.fixed and a.header.frame_id == "odom" for a, _ in arrays)
        assert [a.motion for a, _ in arrays] == ["start", "pose", "pose"]
        assert arrays[2][0].sensor.position.z == pytest.approx(2e-4)
        planes = [t for t in arrays[-1][0].tracks if t.plane]
        assert planes and all(np.diag(np.reshape(t.plane[0].covariance, (3, 3))).min() > 0 for t in planes)
    finally:
        process.stop()


def test_poses_by_tf_need_a_frame(tmp_path):
    process = NodeProcess(tmp_path / "log", {"tracks.pose_from": "tf"})
    try:
        process.wait_for_output("give tracks.fixed_frame", 300.0)
    finally:
        process.stop()
