"""A node that hears its inputs and publishes nothing says why within three seconds, and mends what it can."""

from __future__ import annotations

import time

import cv2
import numpy as np
import pytest

from rcseg_ros.live.hearing import Hearing
from rcseg_ros.live.transport import SOCKET_BYTES, prepare_transport

MS = 1_000_000
T0 = 1_760_000_000_000_000_000
NAMES = {"points": "/points", "depth": "/depth", "image": "/image", "camera_info": "/camera_info"}


def _hearing(apart_ms, jitter_ms=0.0, rounds=8):
    """A depth image every 250 ms, and its colour, stamped so many milliseconds later, 5 ms after it."""
    hearing, noise = Hearing(), np.random.default_rng(0)
    for i in range(rounds):
        now, stamp = i * 250 * MS, T0 + i * 250 * MS
        hearing.heard("depth", stamp, now, 1000)
        hearing.heard(
            "image", stamp + round((apart_ms + jitter_ms * noise.normal()) * MS), now + 5 * MS, 1000
        )
    return hearing


@pytest.mark.parametrize("apart_ms", [45.0, -45.0])
def test_a_constant_offset_is_measured_and_named(apart_ms):
    complaint = _hearing(apart_ms).apart("depth", NAMES, 20 * MS)
    side = "after" if apart_ms > 0 else "before"
    assert f"/image lie 45.0 ms {side} those of /depth" in complaint.text
    assert f"sync.offset_ms to {apart_ms}" in complaint.text
    assert _hearing(apart_ms).apart("depth", NAMES, 50 * MS) is None
    assert _hearing(apart_ms).apart("depth", NAMES, 20 * MS, round(apart_ms * MS)) is None


def test_an_offset_that_varies_asks_for_a_slop():
    complaint = _hearing(100.0, jitter_ms=60.0, rounds=16).apart("depth", NAMES, 20 * MS)
    assert "sync.slop_ms to" in complaint.text and "offset_ms" not in complaint.text


def test_two_clocks_are_named():
    complaint = _hearing(-(T0 - 5e9) / MS).apart("depth", NAMES, 20 * MS)
    assert complaint.reason == "two_clocks" and "use_sim_time" in complaint.text


def test_nothing_is_said_too_early_or_of_pairs():
    hearing = _hearing(45.0)
    assert not hearing.silence("depth", 1_000 * MS) and hearing.silence("depth", 2_000 * MS)
    hearing.paired()
    assert not hearing.silence("depth", 9_000 * MS)


def test_what_is_missing_is_named_with_what_is_there_instead():
    hearing = _hearing(0.0)
    wanted, now = ["points|depth", "image", "camera_info"], 2_000 * MS
    assert "/camera_info: it has no publisher" in hearing.missing(NAMES, {}, wanted, now).text
    del hearing.streams["image"]
    text = hearing.missing(NAMES, {"image": "/image/compressed"}, wanted, now).text
    assert "/image/compressed is published; set input.transport to compressed" in text
    assert "none of its messages arrives" in hearing.missing(NAMES, {"image": "here"}, wanted, now).text
    assert Hearing().missing(NAMES, {}, wanted, now) is None, "silence all round is told elsewhere"


@pytest.mark.parametrize(
    ("kept", "lost"), [(range(12), 0), ((0, 1, 4, 5, 8, 10, 11), 5), (range(0, 24, 2), 0)]
)
def test_lost_messages_leave_gaps_of_whole_periods(kept, lost):
    hearing = Hearing()
    for i in kept:
        hearing.heard("points", T0 + i * 33 * MS, i * 33 * MS, 6_000_000)
    assert hearing.streams["points"].lost()[0] == lost
    assert bool(hearing.losses()) == bool(lost)


def test_the_transport_is_chosen_only_where_nobody_chose_and_the_system_grants_it():
    environment = {}
    assert prepare_transport(environment, SOCKET_BYTES)
    assert environment["FASTDDS_BUILTIN_TRANSPORTS"].startswith("UDPv4?")
    assert not prepare_transport({}, 212992)
    for name, value in {
        "FASTRTPS_DEFAULT_PROFILES_FILE": "x.xml", "FASTDDS_BUILTIN_TRANSPORTS": "SHM",
        "RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp", "ROS_AUTOMATIC_DISCOVERY_RANGE": "localhost",
    }.items():  # fmt: skip
        environment = {name: value}
        assert not prepare_transport(environment, SOCKET_BYTES) and environment == {name: value}


# Live.


def _compressed(live, message, form, pixels):
    from sensor_msgs.msg import CompressedImage

    done, data = cv2.imencode(".png", pixels)
    assert done
    return CompressedImage(header=message.header, format=form, data=data.tobytes())


def _feed(
    live, peer, rounds=16, range_offset_ns=0, color_offset_ns=0, zero=(), camera=True, hz=4.0, stop=None
):
    """Depth and colour at a rate, under stamps that lie apart; where `stop` is given, until it is true.

    `rounds` are those of an idle machine then.
    """
    frame = live.scene()
    for i in range(round(3 * rounds * live.patience()) if stop else rounds):
        stamp = T0 + round(i * 1e9 / hz)
        if camera:
            peer.publish(camera_info=live.camera_info_of(frame, stamp))
        depth = live.depth_of(frame, 0 if "depth" in zero else stamp + range_offset_ns)
        peer.publish(
            depth=depth, image=live.image_of(frame, 0 if "image" in zero else stamp + color_offset_ns)
        )
        time.sleep(1 / hz)
        if stop and stop():
            return


def _started(run, name, parameters=None):
    process, peer = run(name, {"input.range_from": "depth", **(parameters or {})}, ("labels",))
    peer.connected("depth", "image", "camera_info")
    return process, peer


def _warned(peer, words):
    """Whether diagnostics have warned so by now; the latest may warn of something else."""
    return peer.heard_that(lambda told: told["level"] == str(b"\x01") and words in told["message"])


@pytest.mark.alone  # it tells how long that may take
def test_color_that_is_late_is_told_and_taken_in_by_an_offset(live, run):
    process, peer = _started(run, "late")
    started_s = time.monotonic()
    _feed(live, peer, 12, color_offset_ns=45 * MS, stop=lambda: _warned(peer, "sync.offset_ms to 45"))
    assert _warned(peer, "45.0 ms after"), peer.diagnostics()
    assert time.monotonic() - started_s < 3.5 * live.patience(), "it was to be told within three seconds"
    assert not peer.received["labels"]
    assert process.output().count("sync.offset_ms to 45") == 1, process.output()
    for value in (45, "auto"):
        _, peer = _started(run, f"late_{value}", {"sync.offset_ms": value})
        _feed(
            live, peer, 24, color_offset_ns=45 * MS, stop=lambda peer=peer: len(peer.received["labels"]) > 2
        )
        assert peer.received["labels"], peer.diagnostics()


def test_lost_messages_are_told_with_the_profile_that_helps(live, run):
    """A driver of whose clouds some do not arrive: their stamps leave gaps of whole periods."""
    process, peer = run("lossy", {}, ("labels",))
    peer.connected("points", "image", "camera_info")
    frame = live.scene()
    for i in (0, 1, 4, 5, 8, 10, 11, 14, 15, 18, 20, 21, 24, 25):
        peer.send(frame, T0 + i * 100 * MS)
        time.sleep(0.2)
        if _warned(peer, "were lost on their way"):
            break
    told = live.wait_until(lambda: _warned(peer, "were lost on their way"), 5, peer.diagnostics)
    assert "config/fastdds_large_messages.xml" in told["message"]
    assert "config/fastdds_large_messages.xml" in told["lost.points"]
    assert process.output().count("were lost on their way") >= 1


def test_two_clocks_are_told_and_taken_in_by_auto(live, run):
    _, peer = _started(run, "clocks")
    _feed(live, peer, 12, range_offset_ns=5_000_000_000 - T0, stop=lambda: _warned(peer, "two clocks"))
    assert _warned(peer, "use_sim_time"), peer.diagnostics()
    _, peer = _started(run, "clocks_auto", {"sync.offset_ms": "auto"})
    _feed(live, peer, 24, range_offset_ns=5_000_000_000 - T0, stop=lambda: len(peer.received["labels"]) > 2)
    assert peer.received["labels"], peer.diagnostics()


@pytest.mark.parametrize("zero", [("image",), ("depth", "image")])
def test_zero_stamps_pair_by_arrival(live, run, zero):
    _, peer = _started(run, "zero")
    _feed(live, peer, 8, zero=zero)
    # on a busy machine frames may be dropped once they are paired
    live.wait_until(lambda: peer.count("paired") >= 7, 10, peer.diagnostics)
    assert peer.received["labels"]


def test_a_latched_camera_info_is_heard(live, run):
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from sensor_msgs.msg import CameraInfo

    _, peer = _started(run, "latched")
    peer.node.destroy_publisher(peer.publishers.pop("camera_info"))
    topic = live.input_topics("latched")["camera_info"]
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = peer.node.create_publisher(CameraInfo, topic, latched)
    publisher.publish(live.camera_info_of(live.scene(), T0))  # before the node can have found it
    _feed(live, peer, 24, camera=False, stop=lambda: peer.received["labels"])
    assert peer.received["labels"], peer.diagnostics()


def test_a_camera_that_is_waited_for_is_told(live, run):
    _, peer = _started(run, "blind")
    _feed(live, peer, 12, camera=False, stop=lambda: _warned(peer, "camera_info"))
    assert _warned(peer, "nothing heard on /blind/in/camera_info"), peer.diagnostics()


def test_compressed_images_are_pointed_out_and_read(live, run):
    from sensor_msgs.msg import CompressedImage

    frame = live.scene()

    def feed(peer, stop):
        base = live.input_topics(peer.name)
        depths = peer.node.create_publisher(CompressedImage, base["depth"] + "/compressedDepth", 5)
        images = peer.node.create_publisher(CompressedImage, base["image"] + "/compressed", 5)
        for i in range(20):
            stamp = T0 + i * 250 * MS
            image, depth = live.image_of(frame, stamp), live.depth_of(frame, stamp)
            peer.publish(camera_info=live.camera_info_of(frame, stamp), depth=depth)
            images.publish(_compressed(live, image, "rgb8; png compressed bgr8", frame.color[..., ::-1]))
            millimetres = np.nan_to_num(frame.depth_m * 1000).round().astype(np.uint16)
            packed = _compressed(live, depth, "16UC1; compressedDepth png", millimetres)
            packed.data = bytes(12) + bytes(packed.data)  # the transport's own header
            depths.publish(packed)
            time.sleep(0.25)
            if stop():
                return

    _, peer = _started(run, "packed")
    peer.name = "packed"
    peer.node.destroy_publisher(peer.publishers.pop("image"))
    feed(peer, lambda: _warned(peer, "input.transport"))
    assert _warned(peer, "/packed/in/image/compressed is published; set input.transport to compressed")

    _, peer = run("unpacked", {"input.transport": "compressed", "input.range_from": "depth"}, ("labels",))
    peer.name = "unpacked"
    feed(peer, lambda: peer.received["labels"])
    assert peer.received["labels"], peer.diagnostics()
    assert live.image_array(peer.received["labels"][0]).max() > 1


def test_reliability_goes_back_when_the_best_effort_publisher_has_gone(live, monkeypatch):
    import rclpy
    from rclpy.context import Context
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import Image

    from rcseg_ros.live.subscriptions import AdaptiveSubscription

    for name, value in live.ISOLATED.items():
        monkeypatch.setenv(name, value)
    context = Context()
    rclpy.init(context=context)
    reader, writer = (rclpy.create_node(name, context=context) for name in ("adaptive", "driver"))
    subscription = AdaptiveSubscription(reader, Image, "adaptive_image", lambda m: None, "auto", 5)

    def offered_is(reliability):
        subscription.review()
        ours = reader.get_subscriptions_info_by_topic("/adaptive_image")
        return [info.qos_profile.reliability for info in ours] == [reliability]

    for reliability in (ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE):
        publisher = writer.create_publisher(
            Image, "adaptive_image", QoSProfile(depth=5, reliability=reliability)
        )
        live.wait_until(lambda reliability=reliability: offered_is(reliability), 10)
        writer.destroy_publisher(publisher)
    context.try_shutdown()


def test_overrides_of_durability_are_taken(live, run):
    from rclpy.qos import DurabilityPolicy

    parameters = {f"qos_overrides.{topic}.publisher.durability": "transient_local"
                  for topic in ("/durable/labels", "/diagnostics")}  # fmt: skip
    process, peer = run("durable", parameters, ())
    for topic in ("/durable/labels", "/diagnostics"):
        (info,) = live.wait_until(
            lambda topic=topic: [
                i for i in peer.node.get_publishers_info_by_topic(topic) if i.node_name == "durable"
            ],
            10,
        )
        assert info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL, topic
    assert "unknown parameter" not in process.output()
