"""Pairing by stamp: exact before near, nothing lost in a replay, the newest wins live, all losses counted."""

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rcseg_ros.frames.sync import FrameSync, explain_gap, explain_lag

MS = 1_000_000


def feed(sync, events):
    """Feed ('r' | 'c' | 'k', stamp in ms) in the given order; return the pairs' (range, color) stamps."""
    add = {"r": sync.add_range, "c": sync.add_color, "k": sync.add_camera}
    pairs = [pair for kind, stamp in events for pair in add[kind](stamp * MS, (kind, stamp))]
    pairs += sync.flush()
    for pair in pairs:
        assert pair.stamp_ns == pair.range[1] * MS
        assert pair.offset_ns == (pair.color[1] - pair.range[1]) * MS
    return [(pair.range[1], pair.color[1]) for pair in pairs]


def dropped(sync):
    return {reason: count for reason, count in sync.drops.items() if count}


def test_exact_stamps_pair_at_once_in_any_order():
    sync = FrameSync()
    assert sync.add_range(5, "range") == []
    (pair,) = sync.add_color(5, "color")
    assert (pair.range, pair.color, pair.offset_ns) == ("range", "color", 0)
    assert sync.add_color(9, "color") == []
    assert len(sync.add_range(9, "range")) == 1
    assert dropped(sync) == {}


def test_exact_match_is_preferred_to_a_nearer_arrival():
    sync = FrameSync(slop_ns=20 * MS)
    assert feed(sync, [("r", 95), ("c", 100), ("r", 100), ("c", 110)]) == [(100, 100), (95, 110)]


def test_nearest_within_slop_and_nothing_beyond():
    sync = FrameSync(slop_ns=10 * MS)
    assert feed(sync, [("c", 97), ("r", 100), ("c", 104), ("r", 200), ("c", 211)]) == [(100, 97)]
    assert dropped(sync) == {"unpaired_range": 1, "unpaired_color": 2}


def test_equally_near_takes_the_earlier_color():
    assert feed(FrameSync(), [("c", 95), ("c", 105), ("r", 100)]) == [(100, 95)]


def test_each_color_is_used_once():
    sync = FrameSync(slop_ns=20 * MS)
    assert feed(sync, [("r", 100), ("r", 110), ("c", 108)]) == [(110, 108)]
    assert dropped(sync) == {"unpaired_range": 1}


def test_duplicates_are_dropped_and_counted_before_and_after_pairing():
    sync = FrameSync()
    assert feed(sync, [("r", 1), ("r", 1), ("c", 1), ("c", 1), ("r", 1)]) == [(1, 1)]
    assert dropped(sync) == {"duplicate_range": 2, "duplicate_color": 1}


def test_late_and_reordered_messages_still_pair_in_a_replay():
    events = [("r", 100), ("r", 133), ("c", 166), ("c", 133), ("r", 166), ("c", 100)]
    sync = FrameSync()
    assert sorted(feed(sync, events)) == [(100, 100), (133, 133), (166, 166)]
    assert dropped(sync) == {}


def test_live_the_newest_wins_and_older_messages_are_let_go():
    sync = FrameSync(live=True)
    assert feed(sync, [("r", 100), ("r", 133), ("c", 133), ("c", 100)]) == [(133, 133)]
    assert dropped(sync) == {"unpaired_range": 1, "late_color": 1}


def test_live_does_not_wait_for_a_next_image_that_cannot_be_nearer():
    sync = FrameSync(live=True)
    for stamp in (0, 33):
        sync.add_color(stamp * MS, stamp)
    (pair,) = sync.add_range(38 * MS, 38)
    assert pair.color == 33


def test_a_full_queue_drops_the_oldest():
    sync = FrameSync(queue_size=3)
    assert feed(sync, [("r", stamp) for stamp in range(0, 500, 100)] + [("c", 0), ("c", 400)]) == [(400, 400)]
    assert dropped(sync) == {"queue_full_range": 2, "unpaired_range": 2, "unpaired_color": 1}


def test_a_jump_back_in_time_starts_a_new_run():
    loop = [("r", 5000), ("c", 5000), ("r", 8000), ("c", 8000)]
    for live in (False, True):
        sync = FrameSync(live=live)
        assert feed(sync, loop + loop) == [(5000, 5000), (8000, 8000)] * 2
        assert dropped(sync) == {"time_jump": 1}


def test_frames_wait_for_the_first_camera_and_take_the_nearest():
    sync = FrameSync(needs_camera=True)
    assert sync.add_range(1, "r1") == []
    assert sync.add_color(1, "c1") == []
    (pair,) = sync.add_camera(2, "k2")
    assert (pair.range, pair.color, pair.camera) == ("r1", "c1", "k2")
    sync.add_camera(50, "k50")
    sync.add_range(45, "r45")
    (pair,) = sync.add_color(45, "c45")
    assert pair.camera == "k50"


def test_frames_without_any_camera_are_counted():
    sync = FrameSync(needs_camera=True, queue_size=2)
    assert feed(sync, [(kind, stamp) for stamp in range(5) for kind in "rc"]) == []
    assert dropped(sync) == {"no_camera_info": 5}


def test_clouds_with_their_own_color_need_no_partner():
    sync = FrameSync(with_color=False)
    pairs = [pair for stamp in (1, 2, 2, 3) for pair in sync.add_range(stamp, stamp)]
    assert [pair.range for pair in pairs] == [1, 2, 3]
    assert dropped(sync) == {"duplicate_range": 1}


def greedy(ranges, colors, slop):
    """Oracle: all candidate pairs by (difference, range, colour), each stamp used once."""
    pairs, candidates = (
        [],
        sorted((abs(r - c), r, c) for r, c in itertools.product(ranges, colors) if abs(r - c) <= slop),
    )
    for _, r, c in candidates:
        if all(r != pair[0] and c != pair[1] for pair in pairs):
            pairs.append((r, c))
    return sorted(pairs)


stamps = st.sets(st.integers(0, 120), max_size=8)


@settings(max_examples=300, deadline=None)
@given(stamps, stamps, st.integers(0, 15))
def test_messages_in_order_pair_as_the_oracle_does(ranges, colors, slop):
    events = sorted([(s, "r") for s in ranges] + [(s, "c") for s in colors])
    sync = FrameSync(slop_ns=slop * MS)
    pairs = feed(sync, [(kind, stamp) for stamp, kind in events])
    assert sorted(pairs) == greedy(ranges, colors, slop)
    assert sum(dropped(sync).values()) == len(ranges) + len(colors) - 2 * len(pairs)


@settings(max_examples=200, deadline=None)
@given(stamps, st.randoms(use_true_random=False))
def test_exact_stamps_pair_whole_in_any_order_of_arrival(stamps, random):
    events = [(kind, stamp) for stamp in stamps for kind in "rc"]
    random.shuffle(events)
    sync = FrameSync(slop_ns=0)
    assert sorted(feed(sync, events)) == [(stamp, stamp) for stamp in sorted(stamps)]
    assert dropped(sync) == {}


@pytest.mark.parametrize("live", [False, True])
def test_memory_is_bounded(live):
    sync = FrameSync(queue_size=4, live=live)
    for stamp in range(1000):
        sync.add_range(stamp * 100 * MS, stamp)
        sync.add_color((stamp * 100 + 50) * MS, stamp)
        assert len(sync._range.messages) <= 4 and len(sync._color.messages) <= 4
    sync.flush()
    assert dropped(sync) == {
        "queue_full_range": 996, "queue_full_color": 996, "unpaired_range": 4, "unpaired_color": 4
    }  # fmt: skip


@pytest.mark.parametrize(
    ("ranges", "colors", "words"),
    [
        ([0, 100, 200], [45, 145, 245], ["3 of 3", "45 ms after", "steadily", "--slop 46"]),
        ([50, 150, 250], [5, 105, 205], ["45 ms before", "steadily", "--slop 46"]),
        ([0, 100, 200, 300], [0, 100, 245, 300], ["1 of 4", "45 ms after"]),
        ([0, 100, 200], [30, 190, 260], ["3 of 3 have none within 5 ms", "not synchronised"]),
        ([0, 33, 66, 100, 133, 166], [0, 100], ["4 of 6", "colour images are missing"]),
        ([0, 100], [10_000_000, 10_000_100], ["two clocks", "0.000 to 0.100 s", "10000.000 to 10000.100 s"]),
        ([10_000_000, 10_000_100], [0, 100], ["two clocks"]),
        ([0, 4, 8], [4], ["every frame has a colour image within the slop"]),
        ([], [1], [""]),
        ([1], [], [""]),
    ],
)
def test_words_for_stamps_that_do_not_meet(ranges, colors, words):
    text = explain_gap([t * MS for t in ranges], [t * MS for t in colors], 5 * MS)
    assert all(word in text for word in words) and bool(text) == bool(words[0])


def test_clocks_that_differ_show_in_the_time_to_the_recording():
    near, far = [20 * MS, 25 * MS, 22 * MS], [2300 * MS, 2302 * MS, 2305 * MS]
    assert explain_lag("/depth", near, "/image", [400 * MS] * 3) == ""
    text = explain_lag("/depth", near, "/image", far)
    assert "/depth lie 0.02 s" in text and "/image 2.30 s" in text
    assert explain_lag("/depth", far, "/image", near) and not explain_lag("/depth", [], "/image", near)


def test_a_range_of_another_camera_waits_for_its_own_camera_info():
    sync = FrameSync(needs_camera=True, needs_range_camera=lambda pair: pair.color == "other")
    assert sync.add_camera(0, "colour's") == []
    sync.add_range(5, "depth")
    (pair,) = sync.add_color(5, "same")
    assert (pair.camera, pair.range_camera) == ("colour's", None)
    sync.add_range(9, "depth")
    assert sync.add_color(9, "other") == []
    (pair,) = sync.add_range_camera(0, "depth's")
    assert (pair.stamp_ns, pair.camera, pair.range_camera) == (9, "colour's", "depth's")


@pytest.mark.parametrize("waiting", [(), (5,), (5, 9), (0, 4, 8), (2, 3, 10, 11)])
def test_the_nearest_stamp_is_that_of_all_that_wait(waiting):
    from rcseg_ros.frames.sync import _Stream

    stream = _Stream("range", 30)
    for stamp in waiting:
        stream.add(stamp, None)
    for wanted in range(-3, 16):
        nearest = min(waiting, key=lambda stamp: (abs(stamp - wanted), stamp), default=None)
        assert stream.nearest(wanted) == nearest


def test_what_waits_when_time_begins_anew_is_counted():
    sync = FrameSync(live=True, needs_camera=True)
    feed_in = {"r": sync.add_range, "c": sync.add_color}
    for kind, stamp in [("r", 1), ("c", 1), ("r", 50), ("c", 100), ("c", 150)]:
        feed_in[kind](stamp * MS, stamp)
    sync.start_anew()
    assert dropped(sync) == {"unpaired_range": 1, "unpaired_color": 2}
    assert len(sync.add_camera(0, "camera")) == 1  # what is paired waits on for its camera

    sync.add_range(1 * MS, 1)
    sync.let_go()
    sync.let_go()
    assert dropped(sync) == {"unpaired_range": 2, "unpaired_color": 2}


def test_pairs_that_wait_for_a_camera_are_let_go_with_the_rest():
    sync = FrameSync(live=True, needs_camera=True)
    sync.add_range(1 * MS, 1)
    sync.add_color(1 * MS, 1)
    sync.let_go()
    assert dropped(sync) == {"no_camera_info": 1} and sync.add_camera(0, "camera") == []


def test_what_waits_is_taken_in_again_under_other_stamps():
    """As when drivers begin to stamp: those without a stamp are let go, the others pair by theirs."""
    sync = FrameSync(slop_ns=20 * MS, offset_ns=3 * MS)
    for arrived, message in ((100, 7), (400, 9)):
        assert sync.add_range(arrived * MS, message) == []
    for arrived, message in ((200, 10), (700, None)):
        assert sync.add_color(arrived * MS, message) == []
    (pair,) = sync.start_anew(lambda stamp: stamp and stamp * MS)
    assert (pair.stamp_ns, pair.range, pair.color) == (7 * MS, 7, 10)
    assert dropped(sync) == {"unpaired_color": 1}
    (pair,) = sync.add_color(12 * MS, 12)
    assert pair.range == 9


def test_a_next_image_that_would_be_as_near_is_not_waited_for():
    sync = FrameSync(slop_ns=20 * MS)
    assert sync.add_color(97 * MS, "color") == [] == sync.add_range(100 * MS, "range")
    (pair,) = sync.add_color(103 * MS, "next")  # of two equally near the earlier
    assert pair.color == "color"
