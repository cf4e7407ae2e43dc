"""Recordings of rectified streams and of two cameras: the right matrix, registered depth, words for it."""

from __future__ import annotations

import json

import numpy as np
import pytest
from recordings import START_NS, Entry, stamps, write_folder, write_mcap
from scipy.spatial.transform import Rotation
from test_cameras import BENT, HEIGHT, OWN, OWN_SIZE, POSE, WIDTH, K, P, rays_of, scene

from rcseg_core import SegmenterConfig
from rcseg_core.errors import InputError
from rcseg_ros.cli import main
from rcseg_ros.commands.replay import ReplayRequest, replay
from rcseg_ros.frames.conversions import Header
from rcseg_ros.frames.registration import Surroundings
from rcseg_ros.recordings.bag import Recording
from rcseg_ros.recordings.recorded import read_recording
from rcseg_ros.recordings.result_bag import make_message
from rcseg_ros.recordings.topics import InputTopics, find_topics
from rcseg_ros.results.outputs import depth_message, header_message, picture_message

OPTICAL = {"depth": "camera_depth_optical_frame", "color": "camera_color_optical_frame"}


def head(stamp_ns, frame_id):
    return header_message(Header(stamp_ns, frame_id), make_message)


def info(stamp_ns, frame_id, k, size, p=None, d=(0.0,) * 5):
    roi = make_message(
        "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    return make_message(
        "sensor_msgs/msg/CameraInfo", header=head(stamp_ns, frame_id), height=size[0], width=size[1],
        distortion_model="plumb_bob", d=np.array(d), k=k.matrix().reshape(9), r=np.eye(3).reshape(9),
        p=np.c_[(p or k).matrix(), np.zeros(3)].reshape(12), binning_x=0, binning_y=0, roi=roi,
    )  # fmt: skip


def transform(parent, child, pose, stamp_ns=START_NS):
    x, y, z = pose[:3, 3].tolist()
    turn = dict(zip("xyzw", Rotation.from_matrix(pose[:3, :3]).as_quat().tolist(), strict=True))
    return make_message(
        "geometry_msgs/msg/TransformStamped",
        header=head(stamp_ns, parent),
        child_frame_id=child,
        transform=make_message(
            "geometry_msgs/msg/Transform",
            translation=make_message("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            rotation=make_message("geometry_msgs/msg/Quaternion", **turn),
        ),
    )


def tf(*transforms):
    return make_message("tf2_msgs/msg/TFMessage", transforms=list(transforms))


def chain():
    """depth_optical - depth - link - color - color_optical, as drivers publish it: POSE in several hops."""
    optical = np.eye(4)
    optical[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]  # optical axes in those of a robot
    color_in_link = np.eye(4)
    color_in_link[:3, 3] = [0.0, 0.015, 0.0]
    depth_in_link = color_in_link @ optical @ POSE @ np.linalg.inv(optical)
    return [
        transform("camera_link", "camera_depth_frame", depth_in_link),
        transform("camera_depth_frame", OPTICAL["depth"], optical),
        transform("/camera_link", "/camera_color_frame", color_in_link),
        transform("camera_color_frame", OPTICAL["color"], optical),
    ]


def two_cameras(count=2, with_tf="/tf_static", size=OWN_SIZE, own=OWN, late=False):
    """Raw depth and colour of two sensors, as a RealSense publishes them."""
    rays = rays_of(own, height=size[0], width=size[1]) @ POSE[:3, :3].T
    depth, _ = scene(rays, POSE[:3, 3])
    _, color = scene(rays_of(K))
    entries = []
    for stamp in stamps(count):
        entries += [
            Entry("/camera/depth/camera_info", info(stamp, OPTICAL["depth"], own, size), stamp),
            Entry("/camera/color/camera_info", info(stamp, OPTICAL["color"], K, (HEIGHT, WIDTH)), stamp),
            Entry("/camera/depth/image_rect_raw",
                  depth_message(depth, head(stamp, OPTICAL["depth"]), make_message), stamp),
            Entry("/camera/color/image_raw",
                  picture_message(color, head(stamp, OPTICAL["color"]), make_message), stamp),
        ]  # fmt: skip
    if with_tf:
        at = stamps(count)[-1] + 1 if late else START_NS
        hops = chain()
        found = [Entry(with_tf, tf(*hops[:2]), at), Entry(with_tf, tf(*hops[2:]), at)]
        entries = entries + found if late else found + entries
    return entries


def run(path, tmp_path, **changes):
    wanted = {"outputs": ("labels", "regions"), "workers": 1, **changes}
    request = ReplayRequest(path, tmp_path / "out", SegmenterConfig(), **wanted)
    summary = replay(request)
    metrics = json.loads((request.output / "metrics.json").read_text())
    with Recording(request.output) as result:
        regions = result.first("/rcseg/regions")
    return summary, metrics, regions


def test_the_topics_of_two_cameras(tmp_path):
    with Recording(write_folder(tmp_path / "bag", two_cameras())) as recording:
        expected = InputTopics(
            "/camera/depth/image_rect_raw", "/camera/color/image_raw", "/camera/color/camera_info",
            "/camera/depth/camera_info",
        )  # fmt: skip
        assert find_topics(recording, {}) == expected
        lines = []
        find_topics(recording, {}, explain=lines.append)
        (line,) = [line for line in lines if line.startswith("/camera/depth/camera_info")]
        assert "taken as range_camera_info" in line
        named = {"range_camera_info": "/camera/color/camera_info"}
        assert find_topics(recording, named).range_camera_info == "/camera/color/camera_info"


CASES = ({}, {"late": True}, {"with_tf": "/robot/tf_static"}, {"with_tf": "/tf"}, {"size": (HEIGHT, WIDTH)})


@pytest.mark.parametrize("case", CASES)
def test_depth_of_another_camera_is_registered_by_the_tf_of_the_recording(tmp_path, case):
    summary, metrics, regions = run(write_mcap(tmp_path / "a.mcap", two_cameras(**case)), tmp_path)
    assert len(summary.frames) == 2 and not summary.rejected
    row = metrics["frames"][0]
    assert row["camera"]["matrix"] == "K" and "moved by tf" in row["camera"]["registration"]
    assert row["frame_id"] == regions.header.frame_id == OPTICAL["color"]
    assert (row["height"], row["width"]) == (HEIGHT, WIDTH)
    np.testing.assert_allclose(regions.k.reshape(3, 3), K.matrix())
    assert "moved by tf" in regions.geometry and summary.geometries == [regions.geometry]
    normal = regions.regions[0].normal
    plane = -np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
    assert abs(np.dot([normal.x, normal.y, normal.z], plane)) > 0.9999


def test_the_same_frames_are_evaluated_as_replayed(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", two_cameras())
    frames = [labelled.frame for labelled in read_recording(path, "a")]
    assert len(frames) == 2
    points = frames[0].points[frames[0].valid].astype(float)
    np.testing.assert_allclose(points @ (0.2, -0.1, 1.0), 1.5, atol=4e-3)


def test_without_tf_the_recording_is_refused_and_says_what_to_do(tmp_path):
    path = write_mcap(tmp_path / "a.mcap", two_cameras(with_tf="", size=(HEIGHT, WIDTH), own=K))
    words = "range is in frame camera_depth_optical_frame, colour in frame camera_color_optical_frame"
    with pytest.raises(InputError, match=words):
        run(path, tmp_path)
    summary, metrics, _ = run(path, tmp_path, around=Surroundings(assume_registered=True))
    assert "assumed to be registered" in metrics["frames"][0]["camera"]["registration"]
    assert len(summary.frames) == 2


def test_the_command_takes_an_extrinsic_and_names_the_camera(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_mcap(tmp_path / "a.mcap", two_cameras(1, with_tf=""))
    numbers = [*POSE[:3, 3], *Rotation.from_matrix(POSE[:3, :3]).as_quat()]
    assert main(["replay", "a.mcap", "--extrinsic", ",".join(map(str, numbers))]) == 0
    assert "camera: K (raw images without distortion); moved by input.extrinsic" in capsys.readouterr().out
    for option, words in (
        (["--extrinsic", "1,2,3"], "expected X,Y,Z,QX,QY,QZ,QW"),
        (["--extrinsic", "0,0,0,0,0,0,0"], "not zero"),
        (["--extrinsic", "nan,0,0,0,0,0,1"], "expected X,Y,Z,QX,QY,QZ,QW"),
        (["--images", "cooked"], "--images"),
        ([], "no transform between them is known"),
    ):
        assert main(["replay", "a.mcap", "-o", "other", *option]) == 2
        error = capsys.readouterr().err
        assert words in error and len(error.strip().splitlines()) == 1


def test_the_command_takes_the_identity_for_two_sensors_in_one_place(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_mcap(tmp_path / "a.mcap", two_cameras(1, with_tf="", size=(HEIGHT, WIDTH), own=K))
    assert main(["replay", "a.mcap", "--extrinsic", "0,0,0,0,0,0,1"]) == 0
    assert "moved by input.extrinsic" in capsys.readouterr().out
    (row,) = json.loads((tmp_path / "a_rcseg" / "metrics.json").read_text())["frames"]
    assert row["frame_id"] == OPTICAL["color"]


def test_rectified_streams_are_seen_through_p(tmp_path):
    depth, color = scene(rays_of(P))
    header = head(START_NS, "cam")
    entries = [
        Entry("/camera/rgb/camera_info", info(START_NS, "cam", K, (HEIGHT, WIDTH), P, BENT), START_NS),
        Entry("/camera/depth/image_rect", depth_message(depth, header, make_message), START_NS),
        Entry("/camera/rgb/image_rect_color", picture_message(color, header, make_message), START_NS),
    ]
    _, metrics, regions = run(write_mcap(tmp_path / "a.mcap", entries), tmp_path)
    assert metrics["frames"][0]["camera"]["matrix"] == "P"
    assert "rectified" in metrics["frames"][0]["camera"]["why"]
    np.testing.assert_allclose(regions.k.reshape(3, 3), P.matrix())
    assert regions.geometry.startswith("P (")
