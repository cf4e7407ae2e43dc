"""Decisions near the limit keep what the last frame decided: of pairs, of pixels, of whole sequences."""

from itertools import pairwise

import numpy as np
import pytest
from crafted import crafted_signals

from rcseg_core import RangeColorFrame, SegmenterConfig, segment
from rcseg_core.errors import InputError
from rcseg_core.graph.adjacency import find_pairs
from rcseg_core.graph.grouping import Held, group
from rcseg_core.models.moments import accumulate, region_boxes
from rcseg_core.partition.partition import Partition
from rcseg_core.partition.previous import Previous
from rcseg_core.pixels.absorption import Before, absorb, refine
from rcseg_core.stages.measures import make_rule
from rcseg_core.stages.passes import group_pass
from rcseg_core.synthetic import make_journey, make_scene
from rcseg_core.tracking import Segmenter

STABLE = SegmenterConfig().replace({"tracking.stability": 2.0})
FRAME_NS = 33_000_000


def same(a, b):
    return np.array_equal(a.labels, b.labels) and np.array_equal(a.surface_labels, b.surface_labels)


# Pairs.


def halves(step):
    """Two halves whose colours differ by a step, in sigma; the limit allows 1."""
    labels = np.repeat([[1, 2]], 20, axis=0).repeat(12, axis=1).astype(np.int32)
    image = np.zeros((20, 24, 4))
    image[..., 1:] = step * (labels[..., None] == 2)
    image += np.random.default_rng(0).normal(size=image.shape)
    return crafted_signals(image, 1, eps=0.5, color_eps=1.0), labels


def merged(step, names, favour):
    signals, labels = halves(step)
    moments = accumulate(signals.image, signals.flags, labels, 2, 1)
    rule = make_rule(signals, np.ones((3, 2), np.int64), SegmenterConfig(), planes=True)
    pairs = find_pairs(labels, 2, np.zeros(labels.shape, np.uint8), 3)
    held = Held(np.array([0, *names]), favour)
    return group(moments, region_boxes(labels, 2), pairs, rule, False, held=held)


def limit(names, favour):
    """The step, in 1/8 sigma, up to which the halves are one."""
    return next(k for k in range(400) if not len(merged(k / 8, names, favour).merges))


def test_pairs_that_were_one_may_differ_by_more_and_those_that_were_two_by_less():
    plain = limit((0, 0), 3.0)
    assert limit((1, 2), 3.0) < limit((1, 2), 1.5) < plain < limit((5, 5), 1.5) < limit((5, 5), 3.0)
    assert limit((1, 0), 3.0) == limit((0, 7), 3.0) == limit((4, 4), 1.0) == limit((1, 2), 1.0) == plain
    # the criterion is a ratio of squares
    assert limit((5, 5), 3.0) < 1.1 * np.sqrt(3.0) * plain
    assert limit((1, 2), 3.0) > plain / np.sqrt(3.0) / 1.1 - 1


def test_a_merge_by_favour_alone_is_one_of_the_result_in_the_merge_tree():
    plain = limit((0, 0), 1.0)
    one = merged((plain + 1) / 8, (5, 5), 3.0)
    assert len(one.merges) == 1 and one.heights[0] <= 1.0


def test_a_region_was_part_of_what_holds_more_than_half_of_it():
    seeds = np.repeat([[1, 2, 3]], 4, axis=0).repeat(4, axis=1).astype(np.int32)
    before = np.zeros_like(seeds)
    before[:3, :4], before[:2, 4:8], before[:, 8:] = 7, 7, 2
    assert Partition(seeds, 3, None, before, 3.0).held().names.tolist() == [0, 7, 0, 2]
    assert Partition(seeds, 3, None, before, 1.0).held() is None
    assert Partition(seeds, 3).held() is None


# Pixels: regions of one.


def strip():
    """Two regions of 0 and 4 sigma, and between them a column of 2: as far from one as from the other."""
    image = np.zeros((9, 9, 4))
    image[:, 4, 1:], image[:, 5:, 1:] = 2.0, 4.0
    signals = crafted_signals(image, 1, eps=0.5, color_eps=1.0)
    labels = np.ones((9, 9), np.int32)
    labels[:, 5:] = 2
    partition = Partition(labels, 2)
    models = group_pass(partition, signals, np.full((9, 9), 7, np.uint8), 1, SegmenterConfig())
    return signals, models


@pytest.mark.parametrize("was", [1, 2])
def test_a_pixel_as_near_to_one_as_to_the_other_stays_what_it_was(was):
    signals, models = strip()
    models = models._replace(coef=models.coef.copy())
    for k, value in ((1, 0.0), (2, 4.0)):
        models.coef[k], models.coef[k, 1:, 0, 0] = 0.0, value
    before = Before(np.full((9, 9), was * 10, np.int32), np.array([0, 10, 20]), 2.0)
    labels = np.ones((9, 9), np.int32)
    labels[:, 5:] = 2
    labels[:, 4] = 0
    leaves = labels.copy()
    absorb(signals, labels, leaves, models, 100.0, None, before)
    assert (labels[:, 4] == was).all()
    labels[:, 4] = 3 - was
    refine(signals, labels, leaves, models, 3, before)
    assert (labels[:, 4] == was).all()
    assert (labels[:, :4] == 1).all() and (labels[:, 5:] == 2).all()


# Frames.


@pytest.fixture(scope="module")
def journey():
    return list(make_journey(4, 5, width=120, height=90))


def test_a_frame_that_stands_alone_is_what_it_was(journey):
    frame = journey[0].scene.frame
    alone = segment(frame)
    assert same(segment(frame, STABLE), alone)
    assert same(Segmenter(STABLE).segment(frame, 0), alone)
    nothing = np.zeros(alone.labels.shape, np.int32)
    assert same(segment(frame, STABLE, previous=Previous(nothing, nothing)), alone)
    assert same(segment(frame, previous=Previous(alone.surface_labels, alone.labels)), alone)


def test_without_stability_every_frame_stands_alone(journey):
    segmenter = Segmenter()
    for i, one in enumerate(journey[:3]):
        assert same(segmenter.segment(one.scene.frame, i * FRAME_NS), segment(one.scene.frame))


@pytest.mark.parametrize("posed", [True, False])
def test_the_same_frames_give_the_same_results(journey, posed):
    def results():
        segmenter = Segmenter(STABLE)
        return [
            segmenter.segment(one.scene.frame, i * FRAME_NS, one.scene.pose if posed else None)
            for i, one in enumerate(journey[:3])
        ]

    assert all(same(a, b) for a, b in zip(results(), results(), strict=True))


@pytest.mark.parametrize("posed", [True, False])
def test_what_the_last_frame_decided_is_looked_up_where_it_lies(journey, monkeypatch, posed):
    """Against the truth of a rendered scene: a pixel gets the label that its own place had."""
    seen = []

    def look(frame, config, previous=None):
        seen.append(previous)
        return segment(frame, config)

    monkeypatch.setattr("rcseg_core.tracking.segmenter.segment", look)
    segmenter, (first, second) = Segmenter(STABLE), journey[:2]
    results = [
        segmenter.segment(one.scene.frame, i * FRAME_NS, one.scene.pose if posed else None)
        for i, one in enumerate((first, second))
    ]
    assert seen[0] is None
    # truth of the first frame by its labels, truth of the second by what was looked up
    owner = np.zeros(results[0].surface_labels.max() + 1, np.int64)
    for label in range(1, len(owner)):
        own = first.surface_tracks[first.scene.surface_labels][results[0].surface_labels == label]
        owner[label] = np.bincount(own).argmax()
    told = owner[seen[1].surface_labels]
    truth = second.surface_tracks[second.scene.surface_labels]
    known = (told > 0) & (truth > 0)
    assert known.mean() > 0.5
    assert (told == truth)[known].mean() > (0.97 if posed else 0.93)


def test_sequences_under_noise_are_steadier_and_no_worse():
    """The same scene with its noise drawn anew."""
    frames = [one.scene for one in make_journey(5, 2, width=160, height=120, still=True)]

    def cuts(labels):
        return labels[:, 1:] != labels[:, :-1]

    def both(labels):
        return (labels[:, 1:] > 0) & (labels[:, :-1] > 0)

    def flicker(results):
        """Pairs of neighbouring pixels that are of one region in one frame and of two in the next."""
        return sum(
            int((cuts(a.labels) != cuts(b.labels))[both(a.labels) & both(b.labels)].sum())
            for a, b in pairwise(results)
        )

    def wrong(results):
        """Share of the cuts between surfaces that are no true ones, and the reverse, of all pixels."""
        return sum(
            int((cuts(s.surface_labels) != cuts(r.surface_labels))[both(r.surface_labels)].sum())
            for s, r in zip(frames, results, strict=True)
        )

    segmenter = Segmenter(STABLE)
    alone = [segment(s.frame) for s in frames]
    steady = [segmenter.segment(s.frame, i * FRAME_NS, s.pose) for i, s in enumerate(frames)]
    assert flicker(steady) < 0.5 * flicker(alone)
    assert wrong(steady) < wrong(alone)


def test_where_tracks_begin_anew_so_does_what_was_decided(journey):
    one, two = journey[0].scene, journey[2].scene
    alone = segment(two.frame)

    def second(stamp_ns, pose=None, first=one.frame):
        segmenter = Segmenter(STABLE)
        segmenter.segment(first, 10**10)
        return segmenter.segment(two.frame, stamp_ns, pose)

    assert same(second(10**10 - 1), alone), "time went back"
    assert same(second(10**10 + 2 * 10**9), alone), "a gap"
    assert same(second(10**10 + FRAME_NS, two.pose), alone), "poses came"
    with pytest.raises(InputError, match="pose"):
        second(10**10, np.zeros((4, 4)))
    with pytest.raises(InputError, match="stamp_ns"):
        second(0.5)


@pytest.mark.parametrize("kind", ["grid", "reduction", "joint", "range_only"])
def test_other_images_of_a_scene_keep_decisions_too(kind):
    changes = {"reduction": {"signal.reduction": 2}, "grid": {}}.get(kind, {"grouping.order": kind})
    scene = make_scene("room", 3, width=96, height=72)
    frame = scene.frame
    if kind == "grid":
        frame = RangeColorFrame(frame.points, frame.color, None)
    segmenter = Segmenter(STABLE.replace(changes))
    first, second = (segmenter.segment(frame, i * FRAME_NS) for i in range(2))
    cuts = [r.surface_labels[:, 1:] != r.surface_labels[:, :-1] for r in (first, second)]
    assert (cuts[0] == cuts[1]).mean() > 0.98


@pytest.mark.parametrize(
    "images",
    [(np.zeros((3, 4), np.int32),) * 2, (None, np.zeros((72, 96))), (-np.ones((72, 96), np.int32), None)],
)
def test_label_images_that_do_not_fit_are_refused(images):
    frame = make_scene("room", 3, width=96, height=72).frame
    with pytest.raises(InputError, match="previous"):
        segment(frame, STABLE, previous=Previous(*images))
