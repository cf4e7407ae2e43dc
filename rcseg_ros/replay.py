"""`rcseg replay`: a recording goes in, a result bag, metrics and pictures come out.

The same pairing and conversions as on live topics, and nothing dropped that can be paired. Several workers
segment a frame each while this thread reads ahead and writes, in the order of the frames: whole frames side
by side use the processors better than one frame shared among them. The output folder appears when it is
complete; after an interrupt or a damage it holds what was finished, readable.
"""

from __future__ import annotations

import json
import signal
import sys
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

import cv2

from rcseg_core import SegmenterConfig
from rcseg_core.drawing import write_png
from rcseg_core.errors import InputError
from rcseg_core.parallel import cores, set_threads, threads
from rcseg_ros.bag import RawMessage, Recording, Topic
from rcseg_ros.result_bag import NAMESPACE, BagWriter
from rcseg_ros.segmenting import OUTPUTS, FrameResult, FrameWork
from rcseg_ros.settings import config_yaml
from rcseg_ros.staging import StagedFolder
from rcseg_ros.sync import FrameSync, Pair
from rcseg_ros.topics import IMAGE, TF_TYPE, InputTopics, find_topics

METRICS = "metrics.json"
#: Frames that are read while all workers are busy.
READ_AHEAD = 2
TRUTH_TOPICS = {"labels": "/truth/labels", "surface_labels": "/truth/surface_labels"}


@dataclass(frozen=True)
class ReplayRequest:
    """What to replay, and how; the options of `rcseg replay`."""

    bag: Path
    output: Path
    config: SegmenterConfig
    topics: Mapping[str, str] = field(default_factory=dict)
    range_from: str = "auto"
    slop_ns: int = 20_000_000
    queue_size: int = 50
    outputs: tuple[str, ...] = OUTPUTS
    overlays: bool = False
    force: bool = False
    workers: int = 0  # 0: one for each processor
    max_frames: int | None = None


@dataclass
class ReplaySummary:
    """What a replay did; `document` is metrics.json."""

    inputs: InputTopics
    frames: list[dict[str, Any]] = field(default_factory=list)
    dropped: Counter[str] = field(default_factory=Counter)
    rejected: Counter[str] = field(default_factory=Counter)
    first_error: str = ""
    damage: list[str] = field(default_factory=list)
    interrupted: bool = False
    seconds: float = 0.0
    workers: int = 1

    @property
    def frames_per_second(self) -> float:
        """From the first message read to the last one written."""
        return len(self.frames) / self.seconds if self.seconds else 0.0

    @property
    def segment_only_per_second(self) -> float:
        """What the workers would reach if all that they had to do were segment(), from its time in this run.

        A worker that shares no frame is held back by others in wall time but not in processor time, so that
        counts; one that uses several processors for a frame is measured by wall time.
        """
        what = "segment_ms" if self.workers == 1 else "segment_cpu_ms"
        milliseconds = sum(row[what] for row in self.frames)
        return min(self.workers, cores()) * len(self.frames) * 1e3 / milliseconds if milliseconds else 0.0

    def document(self, request: ReplayRequest) -> dict[str, Any]:
        return {
            "recording": str(request.bag),
            "topics": vars(self.inputs),
            "interrupted": self.interrupted,
            "damage": self.damage,
            "totals": {
                "frames": len(self.frames),
                "rejected": dict(self.rejected),
                "dropped": {reason: count for reason, count in self.dropped.items() if count},
                "seconds": self.seconds,
                "workers": self.workers,
                "frames_per_second": self.frames_per_second,
                "segment_only_frames_per_second": self.segment_only_per_second,
            },
            "frames": self.frames,
        }


class Interrupt:
    """Turns the first Ctrl-C into a request to finish the frames in work; a second one stops at once."""

    def __init__(self) -> None:
        self.requested = False

    @contextmanager
    def armed(self) -> Iterator[None]:
        def note(signum: int, frame: Any) -> None:
            self.requested = True
            signal.signal(signal.SIGINT, signal.default_int_handler)

        if threading.current_thread() is not threading.main_thread():
            yield  # only the main thread is told of signals
            return
        before = signal.signal(signal.SIGINT, note)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)


def replay(
    request: ReplayRequest, on_frame: Callable[[int, int], None] = lambda done, total: None
) -> ReplaySummary:
    """Segment a recording and write the results.

    Parameters
    ----------
    on_frame : called with the number of frames done and expected, after each

    Raises
    ------
    InputError
        Unusable recording, topics or output folder, or not one usable frame. Nothing is written then.
    """
    with (
        StagedFolder(request.output, request.force, METRICS) as stage,
        Recording(request.bag) as recording,
    ):
        inputs = find_topics(recording, request.topics, request.range_from)
        summary = ReplaySummary(inputs, workers=request.workers or cores())
        writer = _Writer(stage.path, request.overlays)
        start = perf_counter()
        try:
            _segment_all(recording, request, summary, writer, on_frame)
        finally:  # whatever happened: what was finished is kept, and can be read
            summary.seconds = perf_counter() - start
            summary.damage = recording.damage
            writer.finish(summary.document(request), request.config)
            if summary.frames:
                stage.commit()
    if not summary.frames and not summary.interrupted:
        raise InputError(_why_nothing(request, summary))
    return summary


def _segment_all(
    recording: Recording,
    request: ReplayRequest,
    summary: ReplaySummary,
    writer: _Writer,
    on_frame: Callable[[int, int], None],
) -> None:
    total = min(recording.topics[summary.inputs.range].count, request.max_frames or 2**63)
    work = FrameWork(request.config, recording.decode, request.outputs, _truth(recording), request.overlays)
    interrupt = Interrupt()
    with interrupt.armed(), _threads_for(summary.workers):
        pairs = _pairs(recording, request, summary, writer)
        for result in _in_order(work, pairs, summary.workers, interrupt):
            _take(result, summary, writer)
            on_frame(len(summary.frames) + summary.rejected.total(), total)
    summary.interrupted = interrupt.requested


def _take(result: FrameResult, summary: ReplaySummary, writer: _Writer) -> None:
    if result.rejected:
        summary.rejected[result.rejected] += 1
        summary.first_error = summary.first_error or result.error
        return
    writer.add(result)
    summary.frames.append(result.row)


def _why_nothing(request: ReplayRequest, summary: ReplaySummary) -> str:
    if summary.first_error:
        return f"{request.bag}: no frame could be segmented: {summary.first_error}"
    if summary.damage:
        return f"{request.bag}: no frame before the damage: {summary.damage[-1]}"
    drops = ", ".join(f"{count} {reason}" for reason, count in summary.dropped.items() if count)
    return (
        f"{request.bag}: no range message of {summary.inputs.range} met a colour image of "
        f"{summary.inputs.color} within {request.slop_ns / 1e6:g} ms ({drops}); try a larger --slop"
    )


def _truth(recording: Recording) -> dict[str, dict[int, RawMessage]]:
    """Recorded truth label images by kind and stamp."""
    truth: dict[str, dict[int, RawMessage]] = {}
    for kind, topic in TRUTH_TOPICS.items():
        if topic in recording.topics and recording.topics[topic].type == IMAGE:
            truth[kind] = {raw.stamp_ns: raw for raw in recording.messages([topic])}
    return truth


def _pairs(
    recording: Recording, request: ReplayRequest, summary: ReplaySummary, writer: _Writer
) -> Iterator[Pair]:
    """Pairs of raw messages as they become complete; transforms go straight to the result."""
    inputs = summary.inputs
    sync = FrameSync(
        slop_ns=request.slop_ns,
        queue_size=request.queue_size,
        with_color=inputs.color is not None,
        needs_camera=inputs.camera_info is not None,
    )
    summary.dropped = sync.drops
    add = {inputs.range: sync.add_range, inputs.color: sync.add_color, inputs.camera_info: sync.add_camera}
    transforms = {topic.name for topic in recording.topics.values() if topic.type == TF_TYPE}
    left = request.max_frames or 2**63
    for raw in recording.messages({*inputs.names(), *transforms}):
        if raw.topic not in add:
            writer.transform(recording.topics[raw.topic], raw)
            continue
        for pair in add[raw.topic](raw.stamp_ns, raw):
            yield pair
            left -= 1
            if left == 0:
                return
    yield from sync.flush()[:left]


@contextmanager
def _threads_for(workers: int) -> Iterator[None]:
    """The processors shared out among the workers, so that their frames do not wait for each other."""
    before = threads(), cv2.getNumThreads(), sys.getswitchinterval()
    each = max(1, cores() // workers)
    set_threads(each)
    cv2.setNumThreads(each)
    sys.setswitchinterval(0.0005)  # a kernel that ends gets the interpreter back sooner than after 5 ms
    try:
        yield
    finally:
        set_threads(before[0])
        cv2.setNumThreads(before[1])
        sys.setswitchinterval(before[2])


def _in_order(
    work: Callable[[Pair], FrameResult], pairs: Iterator[Pair], workers: int, interrupt: Interrupt
) -> Iterator[FrameResult]:
    """Results in the order of the pairs; the kernels release the interpreter lock, so threads help."""
    ahead: deque[Future[FrameResult]] = deque()
    with ThreadPoolExecutor(workers) as pool:
        try:
            for pair in pairs:
                ahead.append(pool.submit(work, pair))
                if interrupt.requested:
                    break
                # Some more than the workers have in hand, for the time that writing a result takes.
                if len(ahead) > workers + READ_AHEAD:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()
        finally:
            for future in ahead:
                future.cancel()


class _Writer:
    """Bag, pictures and metrics of one replay; the folder is made with the first result."""

    def __init__(self, folder: Path, overlays: bool) -> None:
        self._folder = folder
        self._overlays = overlays
        self._bag: BagWriter | None = None
        self._pictures = 0

    def _open(self) -> BagWriter:
        if self._bag is None:
            self._bag = BagWriter(self._folder)
        return self._bag

    def transform(self, topic: Topic, raw: RawMessage) -> None:
        self._open().write(topic.name, topic.type, raw.data, raw.log_ns, topic.qos)

    def add(self, result: FrameResult) -> None:
        bag = self._open()
        for output in result.outputs:
            bag.write(f"{NAMESPACE}/{output.topic}", output.type, output.data, result.log_ns)
        if result.picture is not None:
            folder = self._folder / "overlays"
            folder.mkdir(exist_ok=True)
            write_png(folder / f"{self._pictures:06d}.png", result.picture)
            self._pictures += 1

    def finish(self, document: dict[str, Any], config: SegmenterConfig) -> None:
        """Make what was written so far a whole folder."""
        if self._bag is not None:
            self._bag.close()
            (self._folder / METRICS).write_text(json.dumps(document, indent=1) + "\n", "utf-8")
            (self._folder / "config.yaml").write_text(config_yaml(config), "utf-8")
