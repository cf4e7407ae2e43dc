"""A recording on live topics gives what `rcseg replay` writes, which is what segment() says, bit for bit."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from rcseg_core import SegmenterConfig, segment
from rcseg_ros.frames.assembly import assemble_frame
from rcseg_ros.recordings.bag import Recording
from rcseg_ros.recordings.topics import find_topics

ROOT = Path(__file__).parents[2]
BAG = ROOT / "bags" / "tabletop"


@pytest.fixture(scope="module")
def replayed(tmp_path_factory):
    """The result bag of `rcseg replay`."""
    folder = tmp_path_factory.mktemp("replayed") / "out"
    command = [sys.executable, "-m", "rcseg_ros.cli", "replay", str(BAG), "--output", str(folder)]
    subprocess.run(command, check=True, capture_output=True, timeout=300)
    return folder


def test_live_replayed_and_direct_results_are_one(live, run, replayed):
    from rclpy.serialization import deserialize_message
    from sensor_msgs.msg import Image

    from rcseg_msgs.msg import RegionArray

    _, peer = run("of_bag", {"input.queue": 100}, ("labels", "surface_labels", "regions"))
    peer.connected("depth", "image", "camera_info")
    with Recording(BAG) as recording:
        topics = find_topics(recording, {})
        inputs = {topics.range: "depth", topics.color: "image", topics.camera_info: "camera_info"}
        raws = list(recording.messages(list(inputs)))
        decoded = {(inputs[raw.topic], raw.stamp_ns): recording.decode(raw) for raw in raws}
        for raw in raws:
            peer.publishers[inputs[raw.topic]].publish(raw.data)  # as recorded, byte for byte
            time.sleep(0.02)
    stamps = sorted(stamp for topic, stamp in decoded if topic == "depth")
    with Recording(replayed) as recording:
        written = {(raw.topic, raw.stamp_ns): raw.data for raw in recording.messages(recording.topics)}
    for stamp in stamps:
        labels = peer.wait_for("labels", stamp, 60)
        live.assert_same(labels, deserialize_message(written["/rcseg/labels", stamp], Image))
        array = peer.wait_for("regions", stamp)
        live.assert_same(array, deserialize_message(written["/rcseg/regions", stamp], RegionArray))
        surfaces = peer.wait_for("surface_labels", stamp)
        live.assert_same(surfaces, deserialize_message(written["/rcseg/surface_labels", stamp], Image))
    depth, image, info = (decoded[name, stamps[0]] for name in ("depth", "image", "camera_info"))
    result = segment(assemble_frame(depth, image, info), SegmenterConfig())
    np.testing.assert_array_equal(live.image_array(peer.wait_for("labels", stamps[0])), result.labels)


def test_simulated_time_that_jumps_back(live, run):
    from rclpy.qos import qos_profile_sensor_data
    from rosgraph_msgs.msg import Clock

    _, peer = run("simulated", {"use_sim_time": True}, ("labels",))
    peer.connected("points", "image", "camera_info")
    clock = peer.node.create_publisher(Clock, "/clock", qos_profile_sensor_data)
    live.wait_until(clock.get_subscription_count, 10)

    def tick(seconds):
        for tenth in range(5):
            message = Clock()
            message.clock.sec, message.clock.nanosec = seconds, tenth * 100_000_000
            clock.publish(message)
            time.sleep(0.05)

    frame = live.scene()
    for start in (100, 200, 50):  # the last: the bag has begun again
        tick(start)
        stamp = start * live.SECOND
        peer.send(frame, stamp)
        peer.wait_for("labels", stamp)
    live.wait_until(lambda: peer.count("time_jumps") >= 1, 5, peer.diagnostics)
    header = peer.received["diagnostics"][-1].header.stamp
    assert header.sec == 50, "diagnostics carry the simulated time"
