"""Very many small frames, one after another: does anything grow, and does anything become slow?

    python benchmarks/soak.py [python] [replay] [view] [node] [--frames 20000] [--plot docs/pictures/soak.png]

Each part runs in a process of its own: `python` is segment() with regions, surfaces, world and tracker,
`replay` a long recording, `view` a recording that is shown over and over while a client asks for all that
is shown, `node` the node over live topics (needs the ROS wheels and rcseg_msgs). A camera goes back and
forth above a table, with new noise in each frame. Resident memory is fitted by a straight line from the
first fifth of the frames on; the interval (95 %) takes into account that neighbouring samples are alike.
Latencies are wall time: of `replay` those between one frame written and the next, of `node` from publish to
receive. A part fails if its memory certainly grows by more than 1 MB per 10,000 frames (fewer than 5,000
frames show mostly how caches and the allocator fill, so that memory is told but not judged), or if threads
or open files become more.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from http.client import HTTPConnection
from pathlib import Path

import numpy as np
from scipy import stats

from rcseg_core import PinholeCamera, RangeColorFrame, SegmenterConfig, segment
from rcseg_core.synthetic.sequence import make_tabletop_sequence
from rcseg_core.tracking import Tracker

ROOT = Path(__file__).resolve().parents[1]
SHOTS, PERIOD_NS, START_NS = 24, 33_333_333, 1_770_000_000_000_000_000
MOST_SAMPLES, MOST_MB, PER_FRAMES, LEAST_FRAMES = 1000, 1.0, 10_000, 5_000
WARM = 0.2  # of the frames: caches and the allocator's pools fill


@dataclass
class Soak:
    """What was seen of a process, the array of latencies made beforehand so that it does not grow itself."""

    total: int
    pid: int = field(default_factory=os.getpid)

    def __post_init__(self) -> None:
        self.milliseconds = np.full(self.total, np.nan)
        self.samples = np.full((min(self.total, MOST_SAMPLES), 4), np.nan)
        self.started_s = time.monotonic()
        self.seconds = 0.0

    def add(self, number: int, milliseconds: float) -> None:
        """Frame `number` is done; now and then look at the process."""
        self.milliseconds[number] = milliseconds
        row = number * len(self.samples) // self.total
        if row != (number - 1) * len(self.samples) // self.total:
            self.samples[row] = number, *resources(self.pid)
        self.seconds = time.monotonic() - self.started_s

    @property
    def warm(self) -> np.ndarray:
        """Samples (n, 4) after the first fifth: frame, MB, threads, open files."""
        found = self.samples[~np.isnan(self.samples[:, 0])]
        return found[found[:, 0] >= WARM * self.total]


def resources(pid: int) -> tuple[float, int, int]:
    """Resident megabytes, threads and open files of a process."""
    folder = Path(f"/proc/{pid}")
    status = dict(line.split(":", 1) for line in (folder / "status").read_text().splitlines())
    files = len(os.listdir(folder / "fd"))
    return int(status["VmRSS"].split()[0]) / 1024, int(status["Threads"]), files


@dataclass(frozen=True)
class Line:
    """MB = start + slope * frame; `error`: half of the slope's interval (95 %)."""

    start: float
    slope: float
    error: float


def straight_line(frames: np.ndarray, megabytes: np.ndarray) -> Line:
    """Least squares; residuals that follow each other count as fewer samples (first-order correlation)."""
    fit = stats.linregress(frames, megabytes)
    rest = megabytes - fit.intercept - fit.slope * frames
    power = float(rest @ rest)
    alike = min(max(float(rest[1:] @ rest[:-1]) / power, 0.0), 0.99) if power else 0.0
    count = max(len(frames) * (1 - alike) / (1 + alike), 3.0)
    error = fit.stderr * np.sqrt((len(frames) - 2) / (count - 2)) * stats.t.ppf(0.975, count - 2)
    return Line(float(fit.intercept), float(fit.slope), float(error))


def shots(width: int, height: int) -> Iterator[RangeColorFrame]:
    """A camera that goes back and forth, for ever; noise is new in each frame."""
    scenes = make_tabletop_sequence(SHOTS, 0, width=width, height=height)
    rng = np.random.default_rng(0)
    for shot in itertools.cycle([*range(SHOTS), *range(SHOTS - 2, 0, -1)]):
        frame = scenes[shot].frame
        depth = frame.depth_m * (1 + rng.normal(0, 1e-3, frame.valid.shape)).astype(np.float32)
        yield RangeColorFrame.from_depth(depth, frame.color.copy(), frame.camera)


def soak_python(total: int, width: int, height: int) -> Soak:
    """segment(), regions, surfaces, world and tracker."""
    source, tracker, config = shots(width, height), Tracker(), SegmenterConfig()
    seen = Soak(total)
    for number in range(total):
        frame = next(source)
        start = time.perf_counter()
        result = segment(frame, config)
        _ = result.regions, result.surfaces, result.objects, result.world().ground
        tracker.update(result, START_NS + number * PERIOD_NS)
        seen.add(number, 1e3 * (time.perf_counter() - start))
    return seen


def record(folder: Path, total: int, width: int, height: int) -> Path:
    """A recording of depth (16 bit), colour and camera_info, as robots make them."""
    from replay_rate import write_frame

    from rcseg_ros.recordings.result_bag import BagWriter

    with BagWriter(folder / "in") as bag:
        for number, frame in enumerate(itertools.islice(shots(width, height), total)):
            write_frame(bag, frame, START_NS + number * PERIOD_NS)
    return folder / "in"


def soak_replay(total: int, width: int, height: int) -> Soak:
    """`rcseg replay` with all outputs."""
    from rcseg_ros.commands.replay import ReplayRequest, replay

    with tempfile.TemporaryDirectory() as folder:
        bag = record(Path(folder), total, width, height)
        seen, before = Soak(total), time.perf_counter()

        def note(done: int, _: int) -> None:
            nonlocal before
            now = time.perf_counter()
            seen.add(done - 1, 1e3 * (now - before))
            before = now

        summary = replay(ReplayRequest(bag, Path(folder) / "out", SegmenterConfig()), note)
        if len(summary.frames) != total:
            raise SystemExit(f"replay: {len(summary.frames)} of {total} frames came out")
    return seen


def soak_view(total: int, width: int, height: int) -> Soak:
    """`rcseg view` of a recording, and a browser that asks for all that is shown."""
    from rcseg_ros.commands.view import ViewRequest, recorded_frames
    from rcseg_ros.commands.viewers import PageViewer

    with tempfile.TemporaryDirectory() as folder:
        bag = record(Path(folder), 2 * SHOTS - 2, width, height)
        viewer, seen = PageViewer("127.0.0.1", 0), Soak(total)
        source = recorded_frames(ViewRequest(bag), lambda text: sys.exit(text))
        for number in range(total):
            start = time.perf_counter()
            viewer.show(next(source))
            for name in ["", *viewer._parts]:
                client = HTTPConnection("127.0.0.1", int(viewer.address.rsplit(":", 1)[1]), timeout=20)
                client.request("GET", f"/{name}")
                client.getresponse().read()
                client.close()
            seen.add(number, 1e3 * (time.perf_counter() - start))
        viewer.close()
    return seen


def soak_node(total: int, width: int, height: int) -> Soak:
    """The node, each pair published when the labels of the one before have come."""
    sys.path.insert(0, str(ROOT / "test" / "ros"))
    import live

    with tempfile.TemporaryDirectory() as folder:
        node = live.NodeProcess(Path(folder) / "log.txt")
        node.wait_for_output("active")
        peer, source = live.Peer(outputs=("labels", "regions")), shots(width, height)
        peer.connected("points", "image", "camera_info")
        live.CAMERA, seen = first_camera(width, height), Soak(total, node.process.pid)
        for number in range(total):
            stamp, frame = START_NS + number * PERIOD_NS, next(source)
            start = time.monotonic()
            peer.send(frame, stamp)
            peer.wait_for("labels", stamp, 60)
            seen.add(number, 1e3 * (peer.arrived_s["labels"][-1] - start))
            for name in ("labels", "regions"):
                peer.received[name].clear()
                peer.arrived_s[name].clear()
        peer.close()
        code, _ = node.stop()
        if code or "Traceback" in node.output():
            raise SystemExit(f"the node ended with {code}: {node.output()[-2000:]}")
    return seen


def first_camera(width: int, height: int) -> PinholeCamera:
    camera = next(shots(width, height)).camera
    assert camera is not None
    return camera


PARTS: dict[str, Callable[[int, int, int], Soak]] = {
    "python": soak_python, "replay": soak_replay, "view": soak_view, "node": soak_node,
}  # fmt: skip


def judge(name: str, seen: Soak) -> tuple[str, list[str]]:
    """A line of the table, and what is wrong."""
    frames, megabytes, threads, files = seen.warm.T
    line = straight_line(frames, megabytes)
    slope, error = PER_FRAMES * line.slope, PER_FRAMES * line.error
    p50, p99 = np.percentile(seen.milliseconds, [50, 99])
    text = (
        f"{name:7} {seen.total:7} {seen.seconds / 60:8.1f} {slope:+9.2f} +- {error:5.2f} "
        f"{megabytes[0]:6.0f} -> {megabytes[-1]:4.0f} {threads[0]:4.0f} -> {threads[-1]:2.0f} "
        f"{files[0]:4.0f} -> {files[-1]:2.0f} {p50:8.1f} {p99:7.1f} {seen.milliseconds.max():7.1f}"
    )
    faults = []
    if seen.total >= LEAST_FRAMES and slope - error > MOST_MB:
        faults.append(f"{name}: memory grows by {slope:.1f} MB per {PER_FRAMES} frames")
    for what, values in {"threads": threads, "open files": files}.items():
        half = len(values) // 2
        if np.median(values[half:]) > np.median(values[:half]) + 1:
            faults.append(f"{name}: {what} become more")
    return text, faults


HEADER = (
    "part     frames  minutes  MB per 10^4 frames     memory, MB  threads    files   p50, ms     p99     max"
)


def draw(found: dict[str, Soak], path: Path) -> None:
    """Memory with its line, and latency in fifty parts of the run."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, len(found), figsize=(4.5 * len(found) + 1.5, 5.5), squeeze=False)
    for (name, seen), (memory, latency) in zip(found.items(), axes.T, strict=True):
        line, frames = straight_line(*seen.warm[:, :2].T), seen.warm[:, 0]
        memory.plot(seen.samples[:, 0], seen.samples[:, 1], lw=0.8)
        memory.plot(frames, line.start + line.slope * frames, "k--", lw=1)
        memory.set(
            title=f"{name}: {PER_FRAMES * line.slope:+.2f} MB per 10,000 frames", ylabel="resident, MB"
        )
        low, high = np.nanmin(seen.samples[:, 1]), np.nanmax(seen.samples[:, 1])
        memory.set_ylim(low - 5, high + 5)
        parts = np.array_split(seen.milliseconds, min(50, seen.total))
        at = np.cumsum([len(part) for part in parts])
        for share, label in {50: "p50", 99: "p99", 100: "max"}.items():
            latency.plot(at, [np.percentile(part, share) for part in parts], lw=1, label=label)
        latency.set(yscale="log", xlabel="frame", ylabel="latency, ms")
        latency.legend(loc="upper right", fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=90)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; all by default")
    parser.add_argument("--frames", type=int, default=20_000, help="of each part, at least 100")
    parser.add_argument("--size", default="80x60", help="WIDTHxHEIGHT, pixels")
    parser.add_argument("--plot", type=Path, help="picture of memory and latency over the run")
    options = parser.parse_args()
    names = options.parts or list(PARTS)
    if unknown := [name for name in names if name not in PARTS]:
        parser.error(f"no such part: {unknown[0]}; there are {', '.join(PARTS)}")
    if options.frames < 100:
        parser.error("--frames: at least 100")
    width, height = map(int, options.size.split("x"))
    found, faults = {}, []
    print(HEADER, flush=True)
    for name in names:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            found[name] = pool.submit(PARTS[name], options.frames, width, height).result()
        text, wrong = judge(name, found[name])
        faults += wrong
        print(text, flush=True)
    if options.plot:
        draw(found, options.plot)
    print("\n".join(faults) or "no fault")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
