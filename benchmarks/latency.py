"""What the node adds to segment(), and what the transport loses: measured over real topics, between two
processes.

A synthetic 640x480 room is published as cloud, image and camera_info. First slowly, so that every frame is
segmented: arrival of the last input to publication of the labels, against the segmentation alone (both as
the node's own diagnostics tell them), and the whole way from publish to receive as the peer sees it. Then
at 30 Hz, to count what of the inputs reaches the node. Run with the ROS wheels and rcseg_msgs installed:

    python benchmarks/latency.py [--frames 60] [--rate 30] [--default-transport]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "test" / "ros"))

import live  # noqa: E402  the peer and the node process of the tests

PERIOD_NS = 33_000_000


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--frames", type=int, default=60, help="frames of each part")
    options.add_argument("--rate", type=float, default=30.0, help="rate of the second part, Hz")
    options.add_argument(
        "--default-transport", action="store_true", help="without config/fastdds_large_messages.xml"
    )
    options.add_argument("--outputs", default="labels", help="outputs that are listened to, with commas")
    given = options.parse_args()
    if given.default_transport:
        del live.ISOLATED["FASTRTPS_DEFAULT_PROFILES_FILE"]
    with tempfile.TemporaryDirectory() as folder:
        node = live.NodeProcess(Path(folder) / "log.txt")
        node.wait_for_output("active")
        peer = live.Peer(outputs=tuple(given.outputs.split(",")))
        peer.connected("points", "image", "camera_info")
        frame = live.scene(height=480, width=640)
        added(peer, frame, given.frames)
        lost(peer, frame, given.frames, given.rate)
        peer.close()
        code, _ = node.stop()
        if code:
            sys.exit(node.output())


def added(peer, frame, count: int) -> None:
    """Frames one after another: each is published when the labels of the one before have come."""
    start_ns, whole_ms = time.time_ns(), []
    cloud, image = live.cloud_of(frame, 0), live.image_of(frame, 0)
    peer.publish(camera_info=live.camera_info_of(frame, start_ns))
    for i in range(count):
        header = live.header(start_ns + i * PERIOD_NS)
        cloud.header = image.header = header
        peer.publish(points=cloud)
        time.sleep(0.05)
        sent_s = time.monotonic()
        peer.publish(image=image)
        peer.wait_for("labels", start_ns + i * PERIOD_NS)
        whole_ms.append((peer.arrived_s["labels"][-1] - sent_s) * 1e3)
        peer.received["labels"].clear()
    time.sleep(1.2)  # one more report
    values = peer.diagnostics()
    latency, segment = float(values["latency_p50_ms"]), float(values["segment_p50_ms"])
    print(f"{count} frames 640x480, one by one (milliseconds)")
    print(f"  segment()                         p50 {segment:7.1f}   p95 {values['segment_p95_ms']:>7}")
    print(f"  last input in to labels out       p50 {latency:7.1f}   p95 {values['latency_p95_ms']:>7}")
    print(f"  the node adds                     p50 {latency - segment:7.1f}")
    p50, p95 = np.percentile(whole_ms, [50, 95])
    print(f"  image published to labels heard   p50 {p50:7.1f}   p95 {p95:7.1f}")


def lost(peer, frame, count: int, rate_hz: float) -> None:
    """Cloud and image at a camera's rate: the node may drop frames, the transport none."""
    before = {topic: peer.count(f"received.{topic}") for topic in ("points", "image")}
    cloud, image = live.cloud_of(frame, 0), live.image_of(frame, 0)
    start_s, start_ns = time.monotonic(), time.time_ns()
    for i in range(count):
        time.sleep(max(0.0, start_s + i / rate_hz - time.monotonic()))
        cloud.header = image.header = live.header(start_ns + round(i * 1e9 / rate_hz))
        peer.publish(points=cloud, image=image)
    real_hz = (count - 1) / (time.monotonic() - start_s)
    time.sleep(3.0)
    megabytes = [len(message.data) / 1e6 for message in (cloud, image)]
    print(f"{count} frames at {real_hz:.1f} Hz, {megabytes[0]:.1f} MB cloud and {megabytes[1]:.1f} MB image")
    for topic, number in before.items():
        print(f"  {topic:8} reached the node       {peer.count(f'received.{topic}') - number:4d} of {count}")
    for name, value in peer.diagnostics().items():
        if name.startswith(("dropped", "rejected", "segmented")):
            print(f"  {name}: {value}")


if __name__ == "__main__":
    main()
