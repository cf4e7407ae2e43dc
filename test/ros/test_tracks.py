"""Tracks through recordings: with odometry, with tf and without; for every number of workers; inspect."""

from __future__ import annotations

import io

import numpy as np
import pytest
from recordings import DEPTH, FRAME_ID, Entry, depth_entries, head, info_message, write_folder
from rich.console import Console
from scipy.spatial.transform import Rotation

from rcseg_core import SegmenterConfig, segment
from rcseg_core.errors import InputError
from rcseg_core.synthetic import make_journey
from rcseg_core.tracking import Segmenter, Tracker
from rcseg_ros.commands.inspect_track import inspect_track
from rcseg_ros.commands.replay import ReplayRequest, replay
from rcseg_ros.frames.conversions import decode_labels
from rcseg_ros.frames.extrinsic import TransformTree, at_stamp
from rcseg_ros.frames.poses import PoseSource
from rcseg_ros.recordings.bag import Recording
from rcseg_ros.recordings.result_bag import make_message
from rcseg_ros.results.outputs import depth_message, picture_message

START_NS = 1_700_000_000_000_000_000
COLOR, INFO = "/camera/image", "/camera/camera_info"


def pose_fields(pose, point="Point"):
    turn = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    return (
        make_message(f"geometry_msgs/msg/{point}", **dict(zip("xyz", pose[:3, 3].tolist(), strict=True))),
        make_message("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", turn, strict=True))),
    )


def odometry(pose, stamp_ns, parent="odom", child=FRAME_ID):
    position, orientation = pose_fields(pose)
    zero = make_message("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    header = head(stamp_ns)
    header.frame_id = parent
    return make_message(
        "nav_msgs/msg/Odometry", header=header, child_frame_id=child,
        pose=make_message(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=make_message("geometry_msgs/msg/Pose", position=position, orientation=orientation),
            covariance=np.zeros(36),
        ),
        twist=make_message(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=make_message("geometry_msgs/msg/Twist", linear=zero, angular=zero), covariance=np.zeros(36),
        ),
    )  # fmt: skip


def tf(pose, stamp_ns, parent="map", child=FRAME_ID):
    translation, rotation = pose_fields(pose, "Vector3")
    header = head(stamp_ns)
    header.frame_id = parent
    transform = make_message("geometry_msgs/msg/Transform", translation=translation, rotation=rotation)
    stamped = make_message(
        "geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=transform
    )
    return make_message("tf2_msgs/msg/TFMessage", transforms=[stamped])


@pytest.fixture(scope="module")
def frames():
    return list(make_journey(40, 4, width=160, height=120))[:4]


@pytest.fixture(scope="module")
def recording(tmp_path_factory, frames):
    """Four frames with poses both ways."""
    entries = []
    for i, frame in enumerate(frames):
        stamp, seen = START_NS + i * 33_000_000, frame.scene.frame
        entries += [
            Entry("/odom", odometry(frame.scene.pose, stamp), stamp),
            Entry("/tf", tf(frame.scene.pose, stamp), stamp),
            Entry(INFO, info_message(stamp, seen.height, seen.width, seen.camera.matrix()), stamp),
            Entry(DEPTH, depth_message(seen.depth_m, head(stamp), make_message), stamp),
            Entry(COLOR, picture_message(seen.color, head(stamp), make_message), stamp),
        ]
    return write_folder(tmp_path_factory.mktemp("in") / "bag", entries)


def run(recording, out, **options):
    replay(ReplayRequest(recording, out, SegmenterConfig(), **options))
    with Recording(out) as bag:
        return {
            name: [bag.decode(raw) for raw in bag.messages([f"/rcseg/{name}"])]
            for name in ("tracks", "regions", "labels", "surface_labels")
        }


@pytest.fixture(scope="module")
def result(recording, tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "one"
    return out, run(recording, out, workers=1)


def test_a_replay_names_surfaces_and_regions_in_the_fixed_frame(result, frames):
    _, found = result
    assert len(found["tracks"]) == 4
    for array, regions in zip(found["tracks"], found["regions"], strict=True):
        assert array.fixed and array.header.frame_id == "odom" and array.sensor_frame == FRAME_ID
        assert array.header.stamp == regions.header.stamp
        by_id = {track.id: track for track in array.tracks}
        for surface in regions.surfaces:
            assert by_id[surface.track].label == surface.label and by_id[surface.track].kind == 1
        for region in regions.regions:
            assert by_id[region.track].label == region.label and by_id[region.track].kind == 2
    assert [array.motion for array in found["tracks"]] == ["start", "pose", "pose", "pose"]
    first, last = (array.regions.surfaces if hasattr(array.regions, "surfaces") else array.surfaces
                   for array in (found["regions"][0], found["regions"][-1]))  # fmt: skip
    assert first[0].track in {surface.track for surface in last}
    fused = next(t for t in found["tracks"][-1].tracks if len(t.plane) and t.seen == 4)
    assert np.all(np.linalg.eigvalsh(np.reshape(fused.plane[0].covariance, (3, 3))) > 0)
    np.testing.assert_allclose(found["tracks"][0].sensor.position.z, frames[0].scene.pose[2, 3], atol=1e-6)


def test_it_is_the_same_for_every_number_of_workers(recording, result, tmp_path):
    other = run(recording, tmp_path / "three", workers=3)
    for name in ("tracks", "regions"):
        for one, two in zip(result[1][name], other[name], strict=True):
            assert repr(one) == repr(two)


def test_poses_by_tf_have_their_own_frame(recording, result, tmp_path):
    found = run(recording, tmp_path / "tf", workers=2, fixed_frame="map", max_frames=2)
    assert {array.header.frame_id for array in found["tracks"]} == {"map"}
    ids = [[s.track for s in array.surfaces] for array in found["regions"]]
    assert ids == [[s.track for s in array.surfaces] for array in result[1]["regions"][:2]]


def test_a_recording_without_poses_tells_its_own_motion_and_label_images_can_show_tracks(tmp_path):
    bag = write_folder(tmp_path / "bag", depth_entries(3))
    found = run(bag, tmp_path / "out", track_labels=True)
    for array, regions, image in zip(found["tracks"], found["regions"], found["labels"], strict=True):
        assert not array.fixed and array.header.frame_id == FRAME_ID
        shown = set(np.unique(decode_labels(image)).tolist()) - {0}
        assert shown == {region.track for region in regions.regions}
    assert found["tracks"][1].motion in ("surfaces", "pixels")
    kept = [{s.track for s in array.surfaces} for array in found["regions"]]
    assert kept[0] & kept[1] & kept[2]


def test_tracks_are_left_out_with_their_output(recording, tmp_path):
    found = run(recording, tmp_path / "out", outputs=("regions",), max_frames=1)
    assert not found["tracks"] and {region.track for region in found["regions"][0].regions} == {0}


def test_inspect_shows_the_life_of_a_track(result):
    out, found = result
    track = found["regions"][0].surfaces[0].track
    text = io.StringIO()
    inspect_track(out, track, Console(file=text, width=200))
    assert f"track {track}, a surface" in text.getvalue()
    assert (
        "tentative" in text.getvalue()
        and "confirmed" in text.getvalue()
        and "4 frames show it" in text.getvalue()
    )
    with pytest.raises(InputError, match="no track 99999"):
        inspect_track(out, 99999, Console(file=text))


def test_a_moving_transform_is_told_between_its_samples():
    one, two = np.eye(4), np.eye(4)
    two[:3, :3] = Rotation.from_euler("z", 0.4).as_matrix()
    two[:3, 3] = 1.0, 2.0, 3.0
    middle = at_stamp([(0, one), (100, two)], 25)
    np.testing.assert_allclose(middle[:3, 3], [0.25, 0.5, 0.75])
    np.testing.assert_allclose(Rotation.from_matrix(middle[:3, :3]).as_euler("xyz"), [0, 0, 0.1], atol=1e-12)
    for stamp, expected in ((-50, one), (0, one), (100, two), (900, two)):
        np.testing.assert_array_equal(at_stamp([(0, one), (100, two)], stamp), expected)


def test_a_pose_that_is_too_old_is_none():
    source = PoseSource(TransformTree())
    assert source.pose(FRAME_ID, 0) is None
    source.add_odometry(odometry(np.eye(4), START_NS))
    assert source.fixed_frame == "odom"
    np.testing.assert_array_equal(source.pose(FRAME_ID, START_NS + 1_000_000), np.eye(4))
    assert source.pose(FRAME_ID, START_NS + 10**9) is None
    assert source.pose("other", START_NS) is None


@pytest.mark.parametrize("stability", [0.0, 4.0])
def test_real_frames_keep_the_names_of_floor_lid_and_box(shared_data, stability):
    """The three frames of a hand-held Kinect: what is large in all of them has one name."""
    data = shared_data / "bag_pcl_kinect_laptop_box"
    if not data.exists():
        pytest.skip("no recorded data")
    from rcseg_ros.recordings.recorded import read_recording

    config = SegmenterConfig().replace({"tracking.stability": stability})
    tracker, segmenter = Tracker(config), Segmenter(config)
    names = []
    for i, one in enumerate(read_recording(data, "laptop")):
        result = segmenter.segment(one.frame, i * 33_000_000)
        tracks = tracker.update(result, i * 33_000_000)
        sizes = np.bincount(tracks.labels("surface").ravel())
        sizes[0] = 0
        names.append(set(np.argsort(-sizes)[:3].tolist()))
    assert names[0] == names[1] == names[2]


def test_stable_decisions_persist_on_real_frames(shared_data):
    """Ids of 500 px and more that lie on the same pixels in the next frame, a quarter of a second later."""
    from rcseg_core.evaluation.tracks import evaluate_recording
    from rcseg_ros.recordings.recorded import read_recording

    data = shared_data / "bag_pcl_kinect_laptop_box"
    if not data.exists():
        pytest.skip("no recorded data")
    frames = [one.frame for one in read_recording(data, "laptop")]
    config = SegmenterConfig().replace({"tracking.stability": 4.0})
    report = evaluate_recording(((f, i * 250_000_000, None) for i, f in enumerate(frames)), config)
    assert report.persistent["surface"] >= 0.9 and report.persistent["region"] >= 0.7


def test_a_replay_with_stability_is_what_frames_one_after_the_other_are(recording, frames, tmp_path):
    """In the order of the frames, whatever number of workers is asked for; names go on as well."""
    config = SegmenterConfig().replace({"tracking.stability": 2.0})
    shown = []
    for workers in (1, 3):
        out = tmp_path / f"out{workers}"
        assert replay(ReplayRequest(recording, out, config, workers=workers)).workers == 1
        with Recording(out) as bag:
            shown.append([decode_labels(bag.decode(m)) for m in bag.messages(["/rcseg/surface_labels"])])
    assert all(np.array_equal(a, b) for a, b in zip(*shown, strict=True))
    alone = [segment(frame.scene.frame).surface_labels for frame in frames]
    assert np.array_equal(shown[0][0], alone[0])
    assert any(not np.array_equal(a, b) for a, b in zip(shown[0][1:], alone[1:], strict=True))


class Settings(dict):
    """Parameters of a node, as `Naming` reads them."""

    config = SegmenterConfig()


def test_the_node_names_frames_while_somebody_wants_names(frames):
    from rcseg_ros.frames.conversions import Header
    from rcseg_ros.live.naming import Naming
    from rcseg_ros.results.made import ResultMessages

    settings = Settings(
        {
            "tracks.pose_from": "none",
            "tracks.fixed_frame": "",
            "tracks.run": "auto",
            "tracks.label_images": False,
        }
    )
    naming = Naming(None, settings, TransformTree())
    frame, header = frames[0].scene.frame, Header(START_NS, FRAME_ID)
    result = segment(frame)
    messages = ResultMessages(header, frame, result, make_message)
    assert naming.name(messages, header, result, lambda: False) is None
    assert messages.tracks is None
    messages = ResultMessages(header, frame, result, make_message)
    messages.named = naming.name(messages, header, result, lambda: True)
    by_id = {track.id: track for track in messages.tracks.tracks}
    objects = messages.objects.objects
    assert all(by_id[one.track].kind == 3 and by_id[one.track].label == one.label for one in objects)
    assert {p.polygon.id for p in messages.polygons} <= {s.track for s in messages.regions.surfaces}
    assert messages.markers and 0 not in {region.track for region in messages.regions.regions}
    first = messages.named.tracks.surface_ids[1]
    settings.config = SegmenterConfig().replace({"tracking.cell_px": 8})
    again = naming.name(messages, header, result, lambda: True)
    assert again.tracks.surface_ids[1] > first  # other parameters begin anew, and ids go on
    naming.destroy()


def test_the_node_segments_and_names_with_poses_by_tf(frames):
    """What the node does with a frame, without topics: poses from transforms, and decisions that last."""
    from rcseg_ros.frames.conversions import Header
    from rcseg_ros.live.naming import Naming
    from rcseg_ros.results.made import ResultMessages

    settings = Settings(
        {
            "tracks.pose_from": "tf", "tracks.fixed_frame": "map", "tracks.run": "always",
            "tracks.label_images": False, "input.use_tf": True,
        }
    )  # fmt: skip
    settings.config = SegmenterConfig().replace({"tracking.stability": 2.0})
    tree = TransformTree()
    naming, segmenter, motions = Naming(None, settings, tree), Segmenter(settings.config), []
    for i, one in enumerate(frames[:2]):
        stamp, frame, pose = START_NS + i * 33_000_000, one.scene.frame, one.scene.pose
        tree.add(tf(pose, stamp), fixed=False)
        header = Header(stamp, FRAME_ID)
        result = naming.segment(frame, header, settings.config)
        assert np.array_equal(result.labels, segmenter.segment(frame, stamp, pose).labels)
        messages = ResultMessages(header, frame, result, make_message)
        named = naming.name(messages, header, result, lambda: False)
        assert named.fixed_frame == "map" and named.tracks.fixed
        np.testing.assert_allclose(named.tracks.pose, pose, atol=1e-9)
        motions.append(named.tracks.motion)
    assert motions == ["start", "pose"]
    naming.destroy()
