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

from rcseg_core.errors import InputError
from rcseg_core.result.drawing import labels_picture
from rcseg_ros.commands.view import ViewRequest, recorded_frames, view
from rcseg_ros.commands.viewers import PageViewer
from rcseg_ros.frames.conversions import decode_image, decode_labels
from rcseg_ros.recordings.result_bag import result_types

PARTS = {"overlay", "labels", "cloud", "regions", "surfaces", "objects"}
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
    with urllib.request.urlopen(f"{viewer.address}/{name}", timeout=60) as answer:
        return answer.read()


def test_nothing_is_there_before_the_first_frame(page):
    assert b"rcseg view" in _get(page, "")
    with pytest.raises(urllib.error.HTTPError, match="404"):
        _get(page, "state")


def test_the_page_is_given_the_frame(page, frame):
    page.show(frame)
    state = json.loads(_get(page, "state"))
    assert state["frame"] == 1 and set(state["parts"]) == PARTS
    decoded = {
        name: cv2.imdecode(np.frombuffer(_get(page, f"{name}?1"), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        for name in ("overlay", "labels")
    }
    np.testing.assert_array_equal(decoded["overlay"], decode_image(_message(frame, "overlay")))
    labels = decode_labels(_message(frame, "labels"))
    tracks = np.array([0, *(region.track for region in _message(frame, "regions").regions)])
    np.testing.assert_array_equal(decoded["labels"], labels_picture(tracks[labels]))
    rows = json.loads(_get(page, "regions"))
    assert [row["label"] for row in rows] == list(range(1, labels.max() + 1))
    assert rows[0]["pixels"] == (labels == 1).sum() and len(rows[0]["box"]) == 72
    cloud = _get(page, "cloud")
    (count,) = np.frombuffer(cloud, np.uint32, 1)
    assert len(cloud) == 4 + 19 * count and 0 < count <= labels.size
    points = np.frombuffer(cloud, np.float32, 3 * count, 4)
    assert np.isfinite(points).all()
    of_points = np.frombuffer(cloud, np.uint32, count, 4 + 12 * count)
    np.testing.assert_array_equal(np.bincount(of_points)[1:], np.bincount(labels.ravel())[1:])


def test_what_stays_keeps_its_colour(frame):
    """A surface's largest region in two frames of a recording, in the picture and in the table."""
    frames = recorded_frames(ViewRequest(BAG), print)
    page = PageViewer("127.0.0.1", 0)
    try:
        by_track, same = {}, 0
        for one in (next(frames), next(frames)):
            page.show(one)
            rows = json.loads(_get(page, "regions"))
            shown = cv2.imdecode(np.frombuffer(_get(page, "labels"), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
            labels = decode_labels(_message(one, "labels"))
            for region, row in zip(_message(one, "regions").regions, rows, strict=True):
                assert region.track > 0
                assert (shown[labels == region.label] == row["color"]).all()
                same += region.track in by_track
                assert by_track.setdefault(region.track, row["color"]) == row["color"]
        assert same > 5
    finally:
        page.close()


def test_the_page_is_given_classes_polygons_and_objects(page, frame):
    page.show(frame)
    surfaces, objects = json.loads(_get(page, "surfaces")), json.loads(_get(page, "objects"))
    array = _message(frame, "regions")
    assert [s["label"] for s in surfaces] == [s.label for s in array.surfaces]
    kinds = {s["category"] for s in surfaces}
    assert {"floor", "horizontal", "vertical"} <= kinds
    table = max((s for s in surfaces if s["category"] == "horizontal"), key=lambda s: s["area"])
    assert table["shape"] == "plane" and len(table["errors"]) == 3 and table["probability"] > 0.5
    ends = np.array(table["outlines"]).reshape(-1, 3)
    np.testing.assert_allclose(ends @ table["parameters"][:3], table["parameters"][3], atol=2e-3)
    assert len(objects) == len(_message(frame, "objects").objects) > 2
    assert all(len(o["box"]) == 72 and o["surfaces"] for o in objects)


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
    from rcseg_ros.commands.viewers import FoxgloveViewer

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
    from rcseg_ros.commands import view as module

    monkeypatch.setattr(module, "_segmented", lambda *_: iter(()))
    with pytest.raises(InputError, match="no frame that can be shown"):
        view(ViewRequest(BAG), [])


@pytest.fixture
def serving():
    """The command, as `nohup` or a job in the background starts it: with SIGINT ignored."""
    process = subprocess.Popen(
        [sys.executable, "-m", "rcseg_ros.cli", "view", str(BAG), "--port", "0", "--rate", "50"],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
    )  # fmt: skip
    yield process
    process.kill()
    process.wait()


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_the_command_serves_until_interrupted(serving, how):
    process = serving
    lines = iter(process.stdout.readline, "")
    address = next(m[1] for m in (re.search(r"Serving (http://\S+)", line) for line in lines) if m)
    state = None
    for _ in range(1000):
        try:
            state = json.loads(urllib.request.urlopen(f"{address}/state", timeout=60).read())
            break
        except urllib.error.HTTPError:
            time.sleep(0.1)
    assert state and state["frame"] >= 1
    process.send_signal(how)
    rest, _ = process.communicate(timeout=60)
    assert process.returncode == 0, rest
    assert "Traceback" not in rest


def test_live_topics_are_shown(live, run):
    from rcseg_ros.commands.view import live_frames

    _, peer = run("watched", {}, ("labels",))
    peer.connected("points", "image", "camera_info")
    script = (
        "import sys, json; from rcseg_ros.commands.view import live_frames\n"
        "seen = set()\n"
        "for frame in live_frames('/watched'):\n"
        "    seen |= {o.topic for o in frame.outputs}\n"
        "    if len(seen) == 11: print(json.dumps(sorted(seen))); break\n"
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
    output, _ = watcher.communicate(timeout=60)
    assert json.loads(output) == sorted({*live.OUTPUTS, "object_labels", "objects", "polygons", "tracks"})
    assert live_frames
