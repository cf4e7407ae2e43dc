"""Names over time: rigid scenes, things that go and come back, clocks, and what is refused."""

import numpy as np
import pytest

from rcseg_core import SegmenterConfig, segment
from rcseg_core.config import TrackingConfig
from rcseg_core.errors import ConfigError, InputError
from rcseg_core.synthetic import make_journey
from rcseg_core.tracking import KINDS, Tracker

FRAME_NS = 33_000_000


@pytest.fixture(scope="module")
def journey():
    """(frames, results) of a short, small sequence."""
    frames = list(make_journey(7, 5, width=200, height=150))
    return frames, [segment(frame.scene.frame) for frame in frames]


def follow(results, poses, config=None, step_ns=FRAME_NS):
    tracker = Tracker(config)
    return [
        tracker.update(result, i * step_ns, pose)
        for i, (result, pose) in enumerate(zip(results, poses, strict=True))
    ]


def test_the_first_frame_names_every_label_once(journey):
    frames, results = journey
    (tracks,) = follow(results[:1], [frames[0].scene.pose])
    ids = np.concatenate([tracks.ids(kind)[1:] for kind in KINDS])
    result = results[0]
    wanted = len(result.surfaces) + len(result.regions) + len(result.objects)
    assert len(ids) == wanted == len(set(ids.tolist()))
    assert tracks.surface_ids[0] == tracks.region_ids[0] == 0
    assert [track.id for track in tracks.tracks] == sorted(ids.tolist())
    assert {track.state for track in tracks.tracks} == {"tentative"}
    labels = tracks.labels("surface")
    assert labels.shape == results[0].labels.shape and labels.dtype == np.int32
    assert np.array_equal(labels, tracks.surface_ids[results[0].surface_labels])
    assert np.array_equal(tracks.labels("object"), tracks.object_ids[result.object_labels])


@pytest.mark.parametrize("with_poses", [True, False])
def test_a_frame_that_is_repeated_keeps_every_name(journey, with_poses):
    frames, results = journey
    pose = frames[0].scene.pose if with_poses else None
    first, second, third = follow([results[0]] * 3, [pose] * 3)
    for kind in KINDS:
        assert np.array_equal(first.ids(kind), third.ids(kind))
    assert second.motion == ("pose" if with_poses else "surfaces")
    assert {track.state for track in third.tracks} == {"confirmed"}
    assert all(track.age == track.seen == 3 for track in third.tracks)


def test_large_surfaces_keep_their_names_while_the_camera_moves(journey):
    """Seven frames of a whole journey are far apart: half a radian of view between some of them."""
    frames, results = journey
    told = follow(results, [frame.scene.pose for frame in frames])
    owners: dict[int, set[int]] = {}
    for frame, tracks in zip(frames, told, strict=True):
        truth = frame.surface_tracks[frame.scene.surface_labels]
        ids = tracks.labels("surface")
        for name in np.flatnonzero(np.bincount(truth.ravel()) > 0.04 * truth.size):
            if name:
                values, counts = np.unique(ids[truth == name], return_counts=True)
                owners.setdefault(int(name), set()).add(int(values[counts.argmax()]))
    assert len(owners) >= 3
    assert all(len(ids) == 1 for ids in owners.values()), owners


def test_no_id_is_used_again(journey):
    frames, results = journey
    told = follow(results, [frame.scene.pose for frame in frames])
    born = {}
    for tracks in told:
        for track in tracks.tracks:
            assert born.setdefault(track.id, (track.kind, track.first_seen_ns)) == (
                track.kind,
                track.first_seen_ns,
            )
        assert len({track.id for track in tracks.tracks}) == len(tracks.tracks)


def test_the_same_frames_give_the_same_tracks(journey):
    frames, results = journey
    poses = [frame.scene.pose for frame in frames]
    for one, other in zip(follow(results, poses), follow(results, poses), strict=True):
        for kind in KINDS:
            assert np.array_equal(one.ids(kind), other.ids(kind))
        assert [vars(t) | {"fused": None} for t in one.tracks] == [
            vars(t) | {"fused": None} for t in other.tracks
        ]


def test_something_that_is_hidden_for_a_while_comes_back_under_its_name(journey):
    """A frame in which a part of the view was not measured at all lies between two that show it."""
    frames, results = journey
    scene = frames[0].scene
    points = scene.frame.points.copy()
    points[:, : points.shape[1] // 2] = np.nan
    half = segment(type(scene.frame)(points, scene.frame.color, scene.frame.camera))
    told = follow([results[0]] * 3 + [half] + [results[0]], [scene.pose] * 5)
    before, meanwhile, after = told[2], told[3], told[4]
    gone = set(before.surface_ids.tolist()) - set(meanwhile.surface_ids.tolist())
    assert gone
    assert {meanwhile[i].state for i in gone} == {"lost"} and all(meanwhile[i].label == 0 for i in gone)
    assert np.array_equal(before.surface_ids, after.surface_ids)
    assert all(after[i].state == "confirmed" for i in gone)


def test_parts_have_a_parent_and_wholes_take_in_their_parts(journey):
    """The same partition at a coarser limit, in which surfaces are united, and back."""
    from dataclasses import replace

    frames, results = journey
    result = results[0]
    # of two regions on surfaces of their own, one surface is made, as a coarser segmentation would
    first, second = result.surfaces[0], result.surfaces[1]
    united = result.surface_labels.copy()
    united[united == second.label] = first.label
    united[united > second.label] -= 1
    regions = [
        replace(
            r, surface=first.label if r.surface == second.label else r.surface - (r.surface > second.label)
        )
        for r in result.regions
    ]
    coarse = replace(result, surface_labels=united, describe=lambda: regions)
    pose = frames[0].scene.pose
    whole_first = follow([coarse] * 3 + [result], [pose] * 4)
    parent, child = whole_first[3].surface_ids[1], whole_first[3].surface_ids[2]
    assert parent == whole_first[2].surface_ids[1]
    assert whole_first[3][child].parent == parent
    parts_first = follow([result] * 3 + [coarse, result], [pose] * 5)
    keeper, gone = parts_first[2].surface_ids[1], parts_first[2].surface_ids[2]
    assert parts_first[3].surface_ids[1] == keeper
    assert parts_first[3][gone].merged_into == keeper and parts_first[3][gone].state == "lost"
    assert parts_first[4].surface_ids[2] == gone and parts_first[4][gone].merged_into == 0


def test_time_that_goes_back_begins_anew_and_ids_go_on(journey):
    frames, results = journey
    tracker, pose = Tracker(), frames[0].scene.pose
    first = tracker.update(results[0], 10 * FRAME_NS, pose)
    same = tracker.update(results[0], 10 * FRAME_NS, pose)
    assert np.array_equal(first.surface_ids, same.surface_ids)
    back = tracker.update(results[0], 0, pose)
    assert "time went back" in back.restarted and back.motion == "start"
    assert back.surface_ids[1:].min() > max(track.id for track in same.tracks)
    assert set(back.ended) == {track.id for track in same.tracks}


def test_a_gap_ends_tracks_unless_a_pose_bridges_it(journey):
    frames, results = journey
    pose = frames[0].scene.pose
    bridged = follow([results[0]] * 2, [pose] * 2, step_ns=5_000_000_000)
    assert np.array_equal(bridged[0].surface_ids, bridged[1].surface_ids)
    ended = follow([results[0]] * 2, [None] * 2, step_ns=5_000_000_000)
    assert "without a frame" in ended[1].restarted
    assert not set(ended[0].surface_ids[1:]) & set(ended[1].surface_ids[1:])


def test_lost_tracks_are_bounded(journey):
    _, results = journey
    config = TrackingConfig(max_lost=2, confirm_frames=1)
    far = np.eye(4)
    tracker = Tracker(config)
    for i in range(12):  # every other frame is elsewhere, so that everything is lost each time
        far[:3, 3] = 100.0 * i
        tracks = tracker.update(results[i % 2], i * FRAME_NS, far.copy())
        for kind in KINDS:
            assert sum(t.kind == kind and t.state == "lost" for t in tracks.tracks) <= 2


def test_a_fused_plane_is_never_less_certain_than_its_best_frame(journey):
    frames, results = journey
    told = follow(results, [frame.scene.pose for frame in frames])
    best: dict[int, float] = {}
    checked = 0
    for result, tracks in zip(results, told, strict=True):
        for surface in result.surfaces:
            track = tracks[int(tracks.surface_ids[surface.label])]
            if surface.plane is None or track.fused is None or track.seen != track.age:
                continue
            alone = np.linalg.slogdet(surface.plane.covariance_of())[1]
            best[track.id] = min(best.get(track.id, np.inf), alone)
            together = np.linalg.slogdet(track.fused.covariance + track.fused.systematic)[1]
            checked += 1
            assert together <= best[track.id] + 1e-6
    assert checked > 10


def test_without_poses_what_is_remembered_becomes_less_certain(journey):
    """The surfaces tell the motion with an error, and each step adds it to what was seen before."""
    _, results = journey
    with_poses, without = (follow([results[0]] * 12, [pose] * 12) for pose in (np.eye(4), None))
    checked = 0
    for one, other in zip(with_poses[-1].tracks, without[-1].tracks, strict=True):
        if one.fused is None:
            continue
        exact, drifting = (np.linalg.eigvalsh(track.fused.covariance) for track in (one, other))
        assert (drifting > exact * (1 - 1e-9)).all()
        checked += drifting.sum() > 1.1 * exact.sum()
    assert checked > 3


@pytest.mark.parametrize(
    ("pose", "words"),
    [
        (np.eye(3), "shape"),
        (np.full((4, 4), np.nan), "finite"),
        (np.diag([2.0, 1, 1, 1]), "rotation"),
        (np.diag([-1.0, 1, 1, 1]), "rotation"),
        (1e300 * np.eye(4), "rotation"),
        (np.array([["a"] * 4] * 4), "numbers"),
    ],
)
def test_poses_that_are_none_are_refused(journey, pose, words):
    with pytest.raises(InputError, match=words):
        Tracker().update(journey[1][0], 0, pose)


def test_stamps_and_configurations_are_checked(journey):
    with pytest.raises(InputError, match="nanoseconds"):
        Tracker().update(journey[1][0], 0.5)
    with pytest.raises(ConfigError):
        Tracker({"gate": 1})
    assert Tracker(SegmenterConfig())._config == TrackingConfig()
    with pytest.raises(ConfigError, match=r"tracking\.gate"):
        SegmenterConfig().replace({"tracking.gate": 2.0})
    with pytest.raises(InputError, match="kind"):
        Tracker().update(journey[1][0], 0).labels("thing")
    with pytest.raises(KeyError):
        Tracker().update(journey[1][0], 0)[10**6]
