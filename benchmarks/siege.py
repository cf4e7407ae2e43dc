"""The node under siege: one message in three is hostile, and every one of them must be accounted for.

    python benchmarks/siege.py [--messages 100000] [--round 3000] [--seed 0]

In rounds, each from configure to cleanup: good pairs of cloud and image between hostile ones, pairs that are
late, doubled, without partner or from before, time that jumps back, a year ahead, or to zero, parameters set
and refused, subscribers killed with -9, publishers that come and go. At the end of a round the counters of
/diagnostics must add up to the message (received = 2 paired + dropped; paired = segmented + dropped +
rejected), once when all is done and again after the node was deactivated in the middle of work; the labels of
all good frames must be those of segment(), and the log must hold no traceback. Over the rounds memory,
threads and open files must stay flat.
Needs the ROS wheels and rcseg_msgs (`make test` installs them).
"""

from __future__ import annotations

import argparse
import itertools
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "ros"))

import live

START_NS = 1_770_000_000 * live.SECOND
PERIOD_NS = 100_000_000
YEAR_NS = 365 * 86_400 * live.SECOND
#: Dropped after they were paired; all else that is dropped are single messages.
OF_PAIRS = ("dropped.queue", "dropped.deactivated", "dropped.no_camera_info")
DAMAGED = (0, 1, 7, 255, 65_535, 2**31, 2**32 - 1)
SUBSCRIBER = """
import rclpy
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image
rclpy.init()
node = rclpy.create_node("doomed_subscriber")
node.create_subscription(Image, "/rcseg/labels", lambda message: None, QoSProfile(depth=1))
print("listening", flush=True)
rclpy.spin(node)
"""


def spoil(rng: random.Random, cloud: Any, image: Any) -> None:
    """Change one thing of a pair so that no frame can be made of it."""
    what = rng.choice(
        ["cut cloud", "cut image", "no data", "encoding", "fields", "nan", "size", "step", "types"]
    )
    if what == "cut cloud":
        cloud.data = cloud.data[: rng.randrange(len(cloud.data) - 4000)]
    elif what == "cut image":
        image.data = image.data[: rng.randrange(len(image.data) - 4000)]
    elif what == "no data":
        cloud.data = image.data = b""
    elif what == "encoding":
        image.encoding = rng.choice(["", "nv99", "rgb9", "\u00e9\n", "x" * 3000])
    elif what == "fields":
        cloud.fields = [field for field in cloud.fields if field.name != rng.choice("xyz")][:2]
    elif what == "nan":
        cloud.data = np.full(len(cloud.data) // 4, np.nan, np.float32).tobytes()
    elif what == "size":
        cloud.height, cloud.width = rng.choice(DAMAGED[4:]), rng.choice(DAMAGED[4:])
    elif what == "step":
        cloud.data = bytes(cloud.data) + b"\0"
        cloud.point_step = rng.choice([0, 2**31])
    elif what == "types":
        for field in cloud.fields:
            field.offset, field.datatype = rng.choice(DAMAGED[3:]), rng.randrange(256)


class Siege:
    """One node, one peer, and what was sent to it in the round."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.rng = random.Random(seed)
        self.node = live.NodeProcess(folder / "log.txt", {"autostart": False})

        self.peer = live.Peer(outputs=("labels",))
        self.frames = [live.scene(seed) for seed in range(4)]
        self.wanted = [live.expected_labels(frame) for frame in self.frames]
        self.stamps = itertools.count(START_NS, PERIOD_NS)
        self.faults: list[str] = []
        self.total = Counter[str]()

    def round(self, pairs: int) -> None:
        """Configure, attack, compare, clean up."""
        peer = self.peer
        self.sent, self.good = Counter[str](), {}
        if not (peer.change_state("configure") and peer.change_state("activate")):
            raise SystemExit(f"the node could not be started: {self.node.output()[-2000:]}")
        peer.connected("points", "image", "camera_info")
        peer.received.clear()
        peer.publish(camera_info=live.camera_info_of(self.frames[0], next(self.stamps)))
        listener = subprocess.Popen(
            [sys.executable, "-c", SUBSCRIBER], env=live.environment(), start_new_session=True,
            stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        listener.stdout.readline()
        for number in range(pairs):
            self.attack(number)
            if number == pairs // 2:
                listener.kill()
                listener.communicate()
        self.compare()
        self.break_off()
        if not peer.change_state("cleanup"):
            self.faults.append("it could not be cleaned up")

    def attack(self, number: int) -> None:
        """One pair, good or not, and now and then something beside it."""
        rng, peer = self.rng, self.peer
        which, stamp = rng.randrange(len(self.frames)), next(self.stamps)
        frame = self.frames[which]
        cloud, image = live.cloud_of(frame, stamp), live.image_of(frame, stamp)
        hostile = number % 3 == 2
        if hostile:
            if rng.random() < 0.7:
                spoil(rng, cloud, image)
                self.send(points=cloud, image=image)
            else:
                self.misplace(cloud, image, stamp)
            time.sleep(0.02)
            return
        self.send(points=cloud, image=image)
        peer.wait_for("labels", stamp, 60)
        self.good[stamp] = which
        if number % 50 == 1:
            peer.set_parameters(grouping__range_tolerance=rng.choice([-1.0, 7.0, float("nan")]))
            peer.set_parameters(no__such=1, input__queue=rng.choice([-1, 2**40]))
            peer.set_parameters(diagnostics__warn_period_s=rng.choice([1.0, 5.0]))
        if number % 200 == 101:  # a publisher that comes and goes
            live.Peer("rcseg", ()).close()

    def misplace(self, cloud: Any, image: Any, stamp: int) -> None:
        """Twice the same, no partner, too late, in a wrong order."""
        what = self.rng.choice(
            ["twice", "alone", "late", "reversed", "before", "ahead", "ahead alone", "zero"]
        )
        if what == "alone":
            self.send(points=cloud)
        elif what in ("before", "ahead"):  # a bag that loops, a clock that is set; back with the next pair
            other = stamp + (YEAR_NS if what == "ahead" else -10 * live.SECOND)
            cloud.header = image.header = live.header(other)
            self.send(points=cloud, image=image)
            self.peer.wait_for("labels", other, 60)
        elif what == "ahead alone":
            cloud.header = live.header(stamp + YEAR_NS)
            self.send(points=cloud)
            time.sleep(0.3)
        elif what == "zero":  # paired by arrival; with the first that has stamps again a frame may be lost
            for at in (0, stamp):
                cloud.header = image.header = live.header(at)
                self.send(points=cloud, image=image)
                time.sleep(0.3)
        elif what == "reversed":
            self.send(image=image, points=cloud)
        else:
            self.send(points=cloud, image=image)
            self.send(points=cloud)
            if what == "late":
                image.header = live.header(stamp - 300_000_000)
                self.send(image=image)

    def send(self, **messages: Any) -> None:
        for name, message in messages.items():
            self.peer.publish(**{name: message})
            self.sent[name] += 1

    def break_off(self) -> None:
        """Deactivate in the middle of work: what was taken in by then must add up all the same."""
        for _ in range(5):
            frame, stamp = self.frames[0], next(self.stamps)
            self.peer.publish(points=live.cloud_of(frame, stamp), image=live.image_of(frame, stamp))
        if not self.peer.change_state("deactivate"):
            self.faults.append("it could not be deactivated")
        time.sleep(1.2)
        self.total["broken off"] += self.settle(0)["dropped.deactivated"]

    def settle(self, least: int) -> Counter[str]:
        """Wait until the counters add up, with `least` messages received at least; a fault if they do not."""
        values = Counter[str]()

        def adds_up() -> bool:
            told = self.peer.diagnostics().items()
            values.clear()
            values.update({k: int(v.split()[0]) for k, v in told if v.split()[:1] and v.split()[0].isdigit()})
            received = values["received.points"] + values["received.image"]
            rejected = sum(v for k, v in values.items() if k.startswith("rejected."))
            of_pairs = sum(values[k] for k in OF_PAIRS)
            single = sum(v for k, v in values.items() if k.startswith("dropped.")) - of_pairs
            single -= values["dropped.time_jump"]  # counts restarts
            self.account = {name: values[name] for name in ("paired", "segmented")}
            self.account |= {"received": received, "rejected": rejected, "dropped": of_pairs + single}
            whole = values["paired"] == values["segmented"] + rejected + of_pairs
            return received >= least and whole and received == 2 * values["paired"] + single

        try:
            live.wait_until(adds_up, 20)
        except AssertionError:
            self.faults.append(f"sent {dict(self.sent)}, but the counters do not add up: {dict(values)}")
        return values

    def compare(self) -> None:
        """Do the counters add up, and are the labels right?"""
        peer, stamp = self.peer, next(self.stamps)
        self.send(points=live.cloud_of(self.frames[0], stamp), image=live.image_of(self.frames[0], stamp))
        peer.wait_for("labels", stamp, 60)  # with it what is older and waits for a partner is let go
        time.sleep(1.2)  # so that the next diagnostics are of after it
        values = self.settle(self.sent.total())
        told = self.account
        if any(key.startswith("rejected.internal") for key in values):
            self.faults.append(f"rejected.internal: {dict(values)}")
        for message in peer.received["labels"]:
            which = self.good.get(live.stamp_of(message))
            if which is not None and not np.array_equal(live.image_array(message), self.wanted[which]):
                self.faults.append(f"wrong labels at {live.stamp_of(message)}")
        if "Traceback" in self.node.output():
            self.faults.append("a traceback stands in the log")
        if told["received"] != self.sent.total():
            self.faults.append(f"{self.sent.total()} sent, {told['received']} received")
        self.total.update({"messages": self.sent.total(), "good": len(self.good)} | told)

    def resources(self) -> tuple[float, int, int]:
        """Resident megabytes, threads and open files of the node."""
        folder = Path(f"/proc/{self.node.process.pid}")
        status = dict(line.split(":", 1) for line in (folder / "status").read_text().splitlines())
        return (
            int(status["VmRSS"].split()[0]) / 1024,
            int(status["Threads"]),
            len(list((folder / "fd").iterdir())),
        )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--messages", type=int, default=100_000)
    parser.add_argument("--round", type=int, default=3000, help="messages of a round")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    started, seen = time.monotonic(), []
    with tempfile.TemporaryDirectory() as folder:
        siege = Siege(Path(folder), options.seed)
        while siege.total["messages"] < options.messages:
            siege.round(options.round // 2)
            seen.append(siege.resources())
            memory, threads, files = seen[-1]
            print(
                f"{siege.total['messages']:7} messages: {memory:.0f} MB, {threads} threads, {files} files",
                flush=True,
            )
        siege.peer.close()
        code, seconds = siege.node.stop()
    if code or seconds > 5:
        siege.faults.append(f"it ended with {code} after {seconds:.1f} s")
    if len(seen) > 3:
        growth = [last - first for first, last in zip(seen[2], seen[-1], strict=True)]
        print(f"from the third round on: {growth[0]:+.1f} MB, {growth[1]:+d} threads, {growth[2]:+d} files")
        if growth[1] > 2 or growth[2] > 5 or growth[0] > 10 + 0.001 * siege.total["messages"]:
            siege.faults.append(f"it grew: {growth}")
    print(dict(siege.total), f"{time.monotonic() - started:.0f} s")
    print("\n".join(siege.faults) or "no fault")
    return 1 if siege.faults else 0


if __name__ == "__main__":
    sys.exit(main())
