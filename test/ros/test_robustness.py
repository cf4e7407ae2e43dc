"""Nothing that arrives on a topic ends the node: it is counted by its reason, shown in diagnostics, and
work goes on."""

from __future__ import annotations

import itertools
import time

import numpy as np
import pytest

from rcseg_core import RangeColorFrame

SECOND = 1_000_000_000
stamps = itertools.count(1_730_000_000 * SECOND, SECOND)


@pytest.fixture(scope="module")
def frame(live):
    return live.scene()


@pytest.fixture
def still_works(live, peer, frame):
    """After the test, a good frame must come out right."""
    yield
    stamp = next(stamps)
    peer.send(frame, stamp)
    np.testing.assert_array_equal(
        live.image_array(peer.wait_for("labels", stamp)), live.expected_labels(frame)
    )


def _truncated(message):
    message.data = message.data[: len(message.data) // 2]
    return message


def _changed(message, **fields):
    for name, value in fields.items():
        setattr(message, name, value)
    return message


def _odd(message):
    """The bytes of a message and one more, so that its size leaves no reading."""
    return bytes(message.data) + b"\0"


def _halved(message):
    return _changed(message, height=message.height // 2, data=message.data[: len(message.data) // 2])


def _without_field(message, name):
    message.fields = [field for field in message.fields if field.name != name]
    return message


# What is wrong with the pair: cloud and image in and out; names with a space are no reasons.
BAD_PAIRS = {
    "truncated_data": lambda cloud, image: (_truncated(cloud), image),
    "truncated image": lambda cloud, image: (cloud, _truncated(image)),
    "no data": lambda cloud, image: (_changed(cloud, data=b""), image),
    "missing_field": lambda cloud, image: (_without_field(cloud, "z"), image),
    "unknown_encoding": lambda cloud, image: (cloud, _changed(image, encoding="nv99")),
    "bad_step": lambda cloud, image: (cloud, _changed(image, step=7, data=_odd(image))),
    "huge size": lambda cloud, image: (cloud, _changed(image, height=2**31, width=2**31)),
    "point_step 0": lambda cloud, image: (_changed(cloud, point_step=0, data=_odd(cloud)), image),
    "empty_cloud": lambda cloud, image: (_changed(cloud, height=0, width=0, data=b""), image),
    "NaN only": lambda cloud, image: (_nan_only(cloud), image),
    "other size": lambda cloud, image: (cloud, _halved(image)),
}


def _nan_only(message):
    message.data = np.full(len(message.data) // 4, np.nan, np.float32).tobytes()
    return message


@pytest.mark.parametrize("kind", BAD_PAIRS)
def test_bad_messages_are_rejected_by_reason(live, peer, frame, kind, still_works):
    def rejections():
        return sum(int(v.split()[0]) for k, v in peer.diagnostics().items() if k.startswith("rejected."))

    live.wait_until(peer.diagnostics, 5)
    before, stamp = rejections(), next(stamps)
    cloud, image = BAD_PAIRS[kind](live.cloud_of(frame, stamp), live.image_of(frame, stamp))
    peer.publish(camera_info=live.camera_info_of(frame, stamp))
    peer.publish(points=cloud, image=image)
    live.wait_until(lambda: rejections() > before, 10, peer.diagnostics)
    if " " not in kind:
        peer.diagnosed(lambda told: f"rejected.{kind}" in told)
    assert not any(key.startswith("rejected.internal") for key in peer.diagnostics()), peer.diagnostics()


def test_bad_camera_info(live, peer, frame, still_works):
    stamp = next(stamps)
    peer.publish(camera_info=_changed(live.camera_info_of(frame, stamp), k=np.zeros(9)))
    peer.publish(points=live.cloud_of(frame, stamp), image=live.image_of(frame, stamp))
    live.wait_until(lambda: "rejected.uncalibrated_camera" in peer.diagnostics(), 10, peer.diagnostics)


def test_warnings_are_throttled(live, peer, node, frame, still_works):
    for _ in range(20):
        stamp = next(stamps)
        peer.publish(camera_info=live.camera_info_of(frame, stamp))
        peer.publish(
            points=live.cloud_of(frame, stamp), image=_changed(live.image_of(frame, stamp), encoding="odd")
        )
        time.sleep(0.02)
    live.wait_until(lambda: peer.count("rejected.unknown_encoding") >= 2, 10, peer.diagnostics)
    assert node.output().count("rejected (unknown_encoding)") <= 3


def test_late_missing_duplicated_and_reordered_messages(live, peer, frame, still_works):
    labels = live.expected_labels(frame)
    good = [next(stamps) for _ in range(6)]
    info = live.camera_info_of(frame, good[0])
    cloud, image = (lambda t: live.cloud_of(frame, t)), (lambda t: live.image_of(frame, t))
    peer.publish(camera_info=info)
    script = [
        ("image", good[0]), ("points", good[0]),                          # image first
        ("points", good[1]),                                              # its image never comes
        ("points", good[2]), ("points", good[2]), ("image", good[2]), ("image", good[2]),  # duplicated
        ("points", good[4]), ("image", good[4]), ("points", good[3]),  # late within a second
        ("image", good[5] + 5_000_000), ("points", good[5]),  # 5 ms off
    ]  # fmt: skip
    for topic, stamp in script:
        peer.publish(**{topic: cloud(stamp) if topic == "points" else image(stamp)})
        time.sleep(0.15)
    for stamp in (good[0], good[2], good[4], good[5]):
        np.testing.assert_array_equal(live.image_array(peer.wait_for("labels", stamp)), labels)
    time.sleep(0.3)
    received = [live.stamp_of(m) for m in peer.received["labels"]]
    assert all(received.count(stamp) == 1 for stamp in (good[0], good[2], good[4], good[5]))
    assert good[1] not in received and good[3] not in received
    live.wait_until(lambda: peer.count("dropped.duplicate_range") >= 1, 5, peer.diagnostics)


def test_time_that_jumps_back_starts_anew(live, peer, frame, still_works):
    """A bag that loops: the second round has the stamps of the first."""
    start = next(stamps)
    for _ in range(2):
        before = len(peer.received["labels"])
        for number in range(3):
            peer.send(frame, start + number * SECOND)
            wanted = before + number + 1
            live.wait_until(
                lambda wanted=wanted: len(peer.received["labels"]) >= wanted, 10, peer.diagnostics
            )


def test_stamps_of_zero_are_paired_by_arrival(live, peer, frame):
    before = len(peer.received["labels"])
    for _ in range(3):
        peer.publish(camera_info=live.camera_info_of(frame, 0))
        peer.publish(image=live.image_of(frame, 0), points=live.cloud_of(frame, 0))
        time.sleep(0.3 * live.patience())
    live.wait_until(lambda: len(peer.received["labels"]) >= before + 2, 10, peer.diagnostics)
    assert live.stamp_of(peer.received["labels"][-1]) == 0


def test_a_stamp_of_zero_among_others_costs_no_frame(live, peer, frame):
    """One message without a stamp is refused; after some without, the first frame with stamps pairs."""
    labels = live.expected_labels(frame)

    def good():
        stamp = next(stamps)
        peer.publish(camera_info=live.camera_info_of(frame, stamp), points=live.cloud_of(frame, stamp))
        return stamp

    def heard(topic):
        before = peer.count(f"received.{topic}")
        return lambda: peer.count(f"received.{topic}") > before

    def without_stamp():
        return [live.stamp_of(message) for message in list(peer.received["labels"])].count(0)

    def follow(stamp):
        peer.publish(image=live.image_of(frame, stamp))
        np.testing.assert_array_equal(live.image_array(peer.wait_for("labels", stamp)), labels)

    follow(good())  # whatever came before, from here on there are stamps
    stamp, refused = good(), peer.count("dropped.unstamped_image")
    peer.publish(image=live.image_of(frame, 0))
    live.wait_until(lambda: peer.count("dropped.unstamped_image") > refused, 10, peer.diagnostics)
    follow(stamp)
    before = without_stamp()
    for _ in range(2):
        peer.publish(points=live.cloud_of(frame, 0), image=live.image_of(frame, 0))
    live.wait_until(lambda: without_stamp() > before, 20, peer.diagnostics)
    points_came = heard("points")
    stamp = good()
    live.wait_until(points_came, 10, peer.diagnostics)  # range first
    follow(stamp)


def test_best_effort_publishers_are_heard(live, run):
    process, peer = run("of_driver", {}, ("labels",), reliable=False)
    process.wait_for_output("offers best effort only", 20)
    peer.connected("points", "image", "camera_info")
    small = live.scene(height=48, width=64)

    def heard():
        peer.send(small, next(stamps))
        time.sleep(0.2)
        return peer.received["labels"]

    live.wait_until(heard, 20, peer.diagnostics)


def test_frames_wait_for_a_camera_that_is_announced(live, run, frame):
    _, peer = run("waiting", {"input.camera": "required"}, ("labels",))
    peer.connected("points", "image", "camera_info")
    stamp = next(stamps)
    peer.send(frame, stamp, camera=False)
    time.sleep(0.5)
    assert not peer.received["labels"]
    peer.publish(camera_info=live.camera_info_of(frame, stamp))
    labels = live.image_array(peer.wait_for("labels", stamp))
    expected = live.expected_labels(RangeColorFrame(frame.points, frame.color, live.CAMERA))
    np.testing.assert_array_equal(labels, expected)


def test_depth_in_another_unit_is_refused_until_the_unit_is_given(live, run, frame):
    """Millimetres in floats, of which a room of 1500 m was made; the unit may be given while active."""
    _, peer = run("unit", {"input.range_from": "depth"}, ("labels",))
    peer.connected("depth", "image", "camera_info")

    def send():
        stamp = next(stamps)
        far = RangeColorFrame(1000 * frame.points, frame.color, live.CAMERA)
        peer.publish(camera_info=live.camera_info_of(frame, stamp))
        peer.publish(depth=live.depth_of(far, stamp), image=live.image_of(frame, stamp))
        return stamp

    send()
    live.wait_until(lambda: "rejected.depth_unit" in peer.diagnostics(), 10, peer.diagnostics)
    assert all(result.successful for result in peer.set_parameters(input__depth_unit=0.001))
    labels = live.image_array(peer.wait_for("labels", send()))
    assert labels.max() > 1


def test_silence_is_reported(live, peer):
    assert peer.diagnosed("no input for")["level"] == str(b"\x01")


def test_bytes_that_are_no_message(live, peer, frame, still_works):
    """A message that ends early, or text that is not UTF-8: the middleware's own conversion has to cope."""
    from rclpy.serialization import serialize_message

    whole = serialize_message(live.image_of(frame, next(stamps)))
    bad_text = whole.replace(live.FRAME_ID.encode(), b"\xff\xfe" * (len(live.FRAME_ID) // 2))
    assert bad_text != whole
    for data in (bad_text, whole[:20], whole[:4], whole[: len(whole) // 2]):
        peer.publishers["image"].publish(data)
