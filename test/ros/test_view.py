"""rcseg view: what the page and the WebSocket server are given is what the results hold."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

import cv2
import numpy as np
import pytest

from rcseg_core.drawing import labels_picture
from rcseg_core.errors import InputError
from rcseg_ros.conversions import decode_image, decode_labels
from rcseg_ros.result_bag import result_types
from rcseg_ros.view import ViewRequest, recorded_frames, view
from rcseg_ros.viewers import PageViewer

BAG = Path(__file__).parents[2] / "bags" / "tabletop"


@pytest.fixture(scope="module")
def frame():
    return next(recorded_frames(ViewRequest(BAG), print))


def _message(frame, topic):
    output = next(output for output in frame.outputs if output.topic == topic)
    return result_types().deserialize_cdr(output.data, output.type)


@pytest.fixture
def page(frame):
    viewer = PageViewer("127.0.0.1", 0)
    yield viewer
    viewer.close()


def _get(viewer, name):
    with urllib.request.urlopen(f"{viewer.address}/{name}", timeout=5) as answer:
        return answer.read()


def test_nothing_is_there_before_the_first_frame(page):
    assert b"rcseg view" in _get(page, "")
    with pytest.raises(urllib.error.HTTPError, match="404"):
        _get(page, "state")


def test_the_page_is_given_the_frame(page, frame):
    page.show(frame)
    state = json.loads(_get(page, "state"))
    assert state["frame"] == 1 and set(state["parts"]) == {"overlay", "labels", "cloud", "regions"}
    decoded = {
        name: cv2.imdecode(np.frombuffer(_get(page, f"{name}?1"), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        for name in ("overlay", "labels")
    }
    np.testing.assert_array_equal(decoded["overlay"], decode_image(_message(frame, "overlay")))
    labels = decode_labels(_message(frame, "labels"))
    np.testing.assert_array_equal(decoded["labels"], labels_picture(labels))
    rows = json.loads(_get(page, "regions"))
    assert [row["label"] for row in rows] == list(range(1, labels.max() + 1))
    assert rows[0]["pixels"] == (labels == 1).sum() and len(rows[0]["box"]) == 72
    cloud = _get(page, "cloud")
    (count,) = np.frombuffer(cloud, np.uint32, 1)
    assert len(cloud) == 4 + 15 * count and 0 < count <= labels.size
    points = np.frombuffer(cloud, np.float32, 3 * count, 4)
    assert np.isfinite(points).all()


def test_recordings_are_given_markers_too(frame):
    markers = _message(frame, "markers").markers
    assert {m.ns for m in markers} >= {"surfaces", "boxes", "normals", "labels"}
    assert all(m.pose.orientation.w == 1.0 for m in markers)


def test_a_result_bag_shows_what_it_holds(frame, tmp_path):
    command = [sys.executable, "-m", "rcseg_ros.cli", "replay", str(BAG), "-o", str(tmp_path / "out")]
    subprocess.run([*command, "--max-frames", "2"], check=True, capture_output=True, timeout=300)
    frames = list(recorded_frames(ViewRequest(tmp_path / "out", loop=False), print))
    assert len(frames) == 2 and frames[0].stamp_ns == frame.stamp_ns
    one, other = ({o.topic: o.data for o in f.outputs} for f in (frames[0], frame))
    assert one.keys() == other.keys()
    np.testing.assert_array_equal(
        decode_labels(_message(frames[0], "labels")), decode_labels(_message(frame, "labels"))
    )


def test_foxglove_is_given_every_topic_with_its_definition(frame):
    foxglove = pytest.importorskip("foxglove", reason="pip install foxglove-sdk to test its server")
    from rcseg_ros.viewers import FoxgloveViewer

    viewer = FoxgloveViewer("127.0.0.1", 0, "/rcseg")
    viewer.show(frame)
    channels = {c.topic(): c.schema() for c in viewer._channels.values()}
    assert channels.keys() == {f"/rcseg/{output.topic}" for output in frame.outputs}
    assert b"BezierPatch" in channels["/rcseg/regions"].data
    assert all(schema.encoding == "ros2msg" for schema in channels.values())
    viewer.close()
    assert foxglove


def test_a_taken_port_is_one_line(page):
    with pytest.raises(InputError, match="try --port"):
        PageViewer("127.0.0.1", int(page.address.rsplit(":", 1)[1]))


def test_an_empty_loop_ends(tmp_path, frame, monkeypatch):
    from rcseg_ros import view as module

    monkeypatch.setattr(module, "_segmented", lambda *_: iter(()))
    with pytest.raises(InputError, match="no frame that can be shown"):
        view(ViewRequest(BAG), [])


def test_the_command_serves_until_interrupted():
    process = subprocess.Popen(
        [sys.executable, "-m", "rcseg_ros.cli", "view", str(BAG), "--port", "0", "--rate", "50"],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )  # fmt: skip
    lines = iter(process.stdout.readline, "")
    address = next(m[1] for m in (re.search(r"Serving (http://\S+)", line) for line in lines) if m)
    state = None
    for _ in range(200):
        try:
            state = json.loads(urllib.request.urlopen(f"{address}/state", timeout=5).read())
            break
        except urllib.error.HTTPError:
            time.sleep(0.1)
    assert state and state["frame"] >= 1
    process.send_signal(signal.SIGINT)
    rest, _ = process.communicate(timeout=20)
    assert process.returncode == 0, rest
    assert "Traceback" not in rest


def test_live_topics_are_shown(live, run):
    from rcseg_ros.view import live_frames

    _, peer = run("watched", {}, ("labels",))
    peer.connected("points", "image", "camera_info")
    script = (
        "import sys, json; from rcseg_ros.view import live_frames\n"
        "seen = set()\n"
        "for frame in live_frames('/watched'):\n"
        "    seen |= {o.topic for o in frame.outputs}\n"
        "    if len(seen) == 7: print(json.dumps(sorted(seen))); break\n"
    )
    watcher = subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, text=True, env=live.environment()
    )
    scene, stamp = live.scene(), 1_750_000_000 * live.SECOND
    for i in range(60):
        peer.send(scene, stamp + i * live.SECOND)
        time.sleep(0.25)
        if watcher.poll() is not None:
            break
    output, _ = watcher.communicate(timeout=10)
    assert json.loads(output) == sorted(live.OUTPUTS)
    assert live_frames
