"""`rcseg replay`: a recording goes in, a result bag, metrics and pictures come out.

The same pairing and conversions as on live topics, and nothing dropped that can be paired. Several workers
segment a frame each while this thread reads ahead and writes, in the order of the frames: whole frames side
by side use the processors better than one frame shared among them. The output folder appears when it is
complete; after an interrupt or a damage it holds what was finished, readable.
"""

from __future__ import annotations

import signal
import sys
import threading
from array import array
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import chain, islice
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, Protocol

import cv2

from rcseg_core import SegmenterConfig
from rcseg_core.compute.parallel import cores, set_threads, threads
from rcseg_core.errors import InputError
from rcseg_core.result.drawing import write_png
from rcseg_ros.frames.extrinsic import recorded_transforms
from rcseg_ros.frames.reading import DEFAULT_READING, Reading
from rcseg_ros.frames.registration import Geometry, Surroundings
from rcseg_ros.frames.sync import FrameSync, Pair, explain_gap, explain_lag
from rcseg_ros.recordings.bag import RawMessage, Recording, Topic
from rcseg_ros.recordings.layout import stem
from rcseg_ros.recordings.naming import Namer, in_turn
from rcseg_ros.recordings.result_bag import NAMESPACE, BagWriter
from rcseg_ros.recordings.rows import Rows, write_document
from rcseg_ros.recordings.segmenting import OUTPUTS, TRACKS, FrameResult, FrameWork, Segmented
from rcseg_ros.recordings.staging import StagedFolder
from rcseg_ros.recordings.storage import ALWAYS, Span
from rcseg_ros.recordings.topics import IMAGE, TF_TYPE, TRUTH_TOPICS, InputTopics, find_topics
from rcseg_ros.recordings.up import UpRequest, recorded_up
from rcseg_ros.settings import config_yaml
from rcseg_ros.tables.extras import need_pyarrow

if TYPE_CHECKING:
    from rcseg_ros.tables.sink import TableSink

METRICS = "metrics.json"
#: Frames that are read while all workers are busy.
READ_AHEAD = 2
#: Of a part of a recording so much before and after it is read too, so that it pairs as in the whole.
MARGIN_NS = 3_000_000_000


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
    reading: Reading = DEFAULT_READING
    around: Surroundings = field(default_factory=Surroundings)
    up: UpRequest = field(default_factory=UpRequest)
    track_labels: bool = False  # label images show track ids
    fixed_frame: str = ""  # of poses by tf; empty: poses by odometry, or none
    tables: bool = False
    tracks: bool = False  # follow them even if no output shows it: the tables do
    span: Span = ALWAYS  # only range messages recorded then
    threads: int = 0  # of each worker; 0: the processors are shared out among the workers


class Sink(Protocol):
    """What takes the results of a replay, in the order of the frames."""

    def expect(self, raw: RawMessage) -> None:
        """A range message was read; in the end it is added or lost."""

    def transform(self, topic: Topic, raw: RawMessage) -> None:
        """A transform was read, which goes to the result as it is."""

    def add(self, result: FrameResult) -> None: ...

    def lose(self, raw: RawMessage, reason: str, error: str) -> None: ...


@dataclass
class ReplaySummary:
    """What a replay did; `document` is metrics.json but for its frames, which are `frames`."""

    inputs: InputTopics
    frames: Rows = field(default_factory=Rows)
    dropped: Counter[str] = field(default_factory=Counter)
    rejected: Counter[str] = field(default_factory=Counter)
    first_error: str = ""
    damage: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    gap: str = ""  # by how much stamps differ, where frames found no colour
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

    @property
    def geometries(self) -> list[str]:
        """How the frames came about, each way once."""
        return list(dict.fromkeys(str(Geometry(**row["camera"])) for row in self.frames))

    def document(self, request: ReplayRequest) -> dict[str, Any]:
        return {
            "recording": str(request.bag),
            "topics": vars(self.inputs),
            "interrupted": self.interrupted,
            "damage": self.damage,
            "warnings": self.warnings,
            "totals": {
                "frames": len(self.frames),
                "rejected": dict(self.rejected),
                "dropped": {reason: count for reason, count in self.dropped.items() if count},
                "stamps": self.gap,
                "seconds": self.seconds,
                "workers": self.workers,
                "frames_per_second": self.frames_per_second,
                "segment_only_frames_per_second": self.segment_only_per_second,
            },
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
    request: ReplayRequest,
    on_frame: Callable[[int, int], None] = lambda done, total: None,
    explain: Callable[[str], None] = lambda line: None,
    prepare: Callable[[SegmenterConfig], object] = lambda config: None,
) -> ReplaySummary:
    """Segment a recording and write the results.

    Parameters
    ----------
    on_frame : called with the number of frames done and expected, after each
    explain : called with a line for every topic: what it is taken for and why, or why not
    prepare : called once the recording has a frame to segment, and before it is: kernels may have to be
        compiled, which nobody should wait for to hear that the input or the output is of no use

    Raises
    ------
    InputError
        Unusable recording, topics or output folder, or not one usable frame. Nothing is written then.
    """
    with (
        StagedFolder(request.output, request.force, METRICS) as stage,
        Recording(request.bag) as recording,
    ):
        inputs = find_topics(recording, request.topics, request.range_from, explain)
        summary = ReplaySummary(inputs, workers=request.workers or cores(), warnings=recording.warnings)
        writer = _Writer(stage.path, request.overlays, _table_sink(stage.path, recording, request, inputs))
        try:
            segment_recording(recording, request, summary, writer, on_frame, prepare)
        finally:  # whatever happened: what was finished is kept, and can be read
            summary.damage = recording.damage
            writer.finish(summary.document(request), summary.frames, request.config)
            if summary.frames:
                stage.commit()
    if not summary.frames and not summary.interrupted:
        raise InputError(why_nothing(request, summary))
    return summary


def segment_recording(
    recording: Recording,
    request: ReplayRequest,
    summary: ReplaySummary,
    sink: Sink,
    on_frame: Callable[[int, int], None],
    prepare: Callable[[SegmenterConfig], object] = lambda config: None,
) -> None:
    """Segment the frames of an open recording and hand them to a sink; `summary` is filled in."""
    total = min(recording.topics[summary.inputs.range].count, request.max_frames or 2**63)
    inputs, up_from = summary.inputs, request.config.world.up_from
    transforms = recorded_transforms(recording, inputs.range, inputs.color)
    work = FrameWork(
        request.config,
        recording.decode,
        request.outputs,
        _truth(recording),
        request.overlays,
        request.reading,
        replace(
            request.around,
            range_topic=inputs.range,
            color_topic=inputs.color or "",
            transforms=transforms,
            up=recorded_up(recording, inputs.range, up_from, request.up, transforms),
        ),
        _tables(request),
        in_turn(recording, request.config, request.fixed_frame),
    )
    name = None
    if request.tracks or TRACKS in request.outputs:
        name = Namer(recording, request.config, request.fixed_frame, request.track_labels)
    interrupt = Interrupt()
    if work.segmenter is not None:  # a frame waits for the one before it, and has all processors meanwhile
        summary.workers = 1
    pairs = _pairs(recording, request, summary, sink)
    start = perf_counter()
    if first := list(islice(pairs, 1)):
        read_s = perf_counter() - start
        prepare(request.config)
        start = perf_counter() - read_s
    try:
        with interrupt.armed(), _threads_for(summary.workers, request.threads):
            for result in _in_order(work, name, chain(first, pairs), summary.workers, interrupt):
                _take(result, summary, sink)
                on_frame(len(summary.frames) + summary.rejected.total(), total)
    finally:
        summary.seconds = perf_counter() - start
        summary.interrupted = interrupt.requested


def _tables(request: ReplayRequest) -> Callable[..., Any] | None:
    if not request.tables:
        return None
    need_pyarrow()
    from rcseg_ros.tables.rows import frame_tables

    return frame_tables


def _table_sink(
    folder: Path, recording: Recording, request: ReplayRequest, inputs: InputTopics
) -> TableSink | None:
    if not request.tables:
        return None
    need_pyarrow()
    from rcseg_ros.tables.parquet import FOLDER, Episode, part_folder
    from rcseg_ros.tables.sink import TableSink

    name = stem(request.bag.absolute().name)
    return TableSink(
        folder / FOLDER / part_folder(name),
        Episode(name, origin_ns=first_stamp(recording, inputs.range)),
    )


def first_stamp(recording: Recording, topic: str) -> int:
    """Stamp of the first message of a topic; 0 without any."""
    raw = recording.first_raw(topic)
    return 0 if raw is None else raw.stamp_ns


def _take(result: FrameResult, summary: ReplaySummary, sink: Sink) -> None:
    if result.rejected:
        summary.rejected[result.rejected] += 1
        summary.first_error = summary.first_error or result.error
        sink.lose(result.raw, result.rejected, result.error)
        return
    sink.add(result)
    summary.frames.append(result.row)


def why_nothing(request: ReplayRequest, summary: ReplaySummary) -> str:
    """In a line, why a replay gave not one frame."""
    if summary.first_error:
        return f"{request.bag}: no frame could be segmented: {summary.first_error}"
    if summary.damage:
        return f"{request.bag}: no frame before the damage: {summary.damage[-1]}"
    drops = ", ".join(f"{count} {reason}" for reason, count in summary.dropped.items() if count)
    why = "; ".join(filter(None, [summary.gap, *summary.warnings]))
    return (
        f"{request.bag}: no range message of {summary.inputs.range} met a colour image of "
        f"{summary.inputs.color} within {request.slop_ns / 1e6:g} ms ({drops}); {why}"
    )


def _truth(recording: Recording) -> dict[str, dict[int, RawMessage]]:
    """Recorded truth label images by kind and stamp."""
    truth: dict[str, dict[int, RawMessage]] = {}
    for kind, topic in TRUTH_TOPICS.items():
        if topic in recording.topics and recording.topics[topic].type == IMAGE:
            truth[kind] = {raw.stamp_ns: raw for raw in recording.messages([topic])}
    return truth


def _pairs(
    recording: Recording, request: ReplayRequest, summary: ReplaySummary, sink: Sink
) -> Iterator[Pair]:
    """Pairs of raw messages as they become complete; transforms go straight to the result."""
    inputs = summary.inputs
    first_ns, end_ns = request.span
    before_ns, after_ns = max(first_ns - MARGIN_NS, ALWAYS[0]), min(end_ns + MARGIN_NS, ALWAYS[1])

    def wanted(raw: RawMessage) -> bool:
        return first_ns <= raw.log_ns < end_ns

    def lost(reason: str, raw: RawMessage) -> None:
        if wanted(raw):
            sink.lose(raw, reason, "")

    sync = FrameSync(
        slop_ns=request.slop_ns,
        queue_size=request.queue_size,
        with_color=inputs.color is not None,
        needs_camera=inputs.camera_info is not None,
        needs_range_camera=lambda pair: inputs.range_camera_info is not None,
        on_lost=lost,
    )
    summary.dropped = sync.drops
    add = sync.by_topic(inputs.range, inputs.color, inputs.camera_info, inputs.range_camera_info)
    transforms = {topic.name for topic in recording.topics.values() if topic.type == TF_TYPE}
    left = request.max_frames or 2**63
    stamps = {name: array("q") for name in (inputs.range, inputs.color or "")}
    lags = {name: array("q") for name in stamps}
    for info in (inputs.camera_info, inputs.range_camera_info):
        if info in recording.topics and (raw := recording.first_raw(info)) is not None:
            add[info](raw.stamp_ns, raw)  # one that was sent once holds for the frames before it too
    for raw in recording.messages({*inputs.names(), *transforms}, (before_ns, after_ns)):
        if raw.topic not in add:
            if wanted(raw):
                sink.transform(recording.topics[raw.topic], raw)
            continue
        if raw.topic == inputs.range and wanted(raw):
            sink.expect(raw)
        if raw.topic in stamps:
            stamps[raw.topic].append(raw.stamp_ns)
            lags[raw.topic].append(raw.log_ns - raw.stamp_ns)
        for pair in filter(lambda pair: wanted(pair.range), add[raw.topic](raw.stamp_ns, raw)):
            yield pair
            left -= 1
            if left == 0:
                return
    yield from [pair for pair in sync.flush() if wanted(pair.range)][:left]
    if inputs.color is None:
        return
    if sync.drops["unpaired_range"]:
        summary.gap = explain_gap(stamps[inputs.range], stamps[inputs.color], request.slop_ns)
    if warning := explain_lag(inputs.range, lags[inputs.range], inputs.color, lags[inputs.color]):
        summary.warnings.append(warning)


@contextmanager
def _threads_for(workers: int, threads_each: int = 0) -> Iterator[None]:
    """The processors shared out among the workers, so that their frames do not wait for each other."""
    before = threads(), cv2.getNumThreads(), sys.getswitchinterval()
    each = threads_each or max(1, cores() // workers)
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
    work: FrameWork, name: Namer | None, pairs: Iterator[Pair], workers: int, interrupt: Interrupt
) -> Iterator[FrameResult]:
    """Results in the order of the pairs; the kernels release the interpreter lock, so threads help.

    A frame is segmented by one worker and encoded by another; between, it is named here, in order.
    """
    ahead: deque[Future[Segmented | FrameResult]] = deque()
    encoded: deque[Future[FrameResult]] = deque()

    def encode(made: Segmented | FrameResult) -> FrameResult:
        return made if isinstance(made, FrameResult) else work.encode(made)

    with ThreadPoolExecutor(workers) as pool:

        def name_next() -> None:
            made = ahead.popleft().result()
            if name is not None and isinstance(made, Segmented):
                name(made)
            encoded.append(pool.submit(encode, made))

        try:
            for pair in pairs:
                ahead.append(pool.submit(work.segment, pair, name is not None))
                if interrupt.requested:
                    break
                # Some more than the workers have in hand, for the time that writing a result takes.
                if len(ahead) > workers + READ_AHEAD:
                    name_next()
                if len(encoded) > workers:
                    yield encoded.popleft().result()
            while ahead or encoded:
                if ahead:
                    name_next()
                if encoded:
                    yield encoded.popleft().result()
        finally:
            for future in (*ahead, *encoded):
                future.cancel()


class _Writer:
    """Bag, pictures and metrics of one replay; the folder is made with the first result."""

    def __init__(self, folder: Path, overlays: bool, tables: TableSink | None = None) -> None:
        self._folder = folder
        self._overlays = overlays
        self._tables = tables
        self._bag: BagWriter | None = None
        self._pictures = 0

    def _open(self) -> BagWriter:
        if self._bag is None:
            self._bag = BagWriter(self._folder)
        return self._bag

    def expect(self, raw: RawMessage) -> None:
        if self._tables is not None:
            self._tables.expect(raw)

    def lose(self, raw: RawMessage, reason: str, error: str) -> None:
        if self._tables is not None:
            self._open()  # makes the folder that the tables lie in
            self._tables.lose(raw, reason, error)

    def transform(self, topic: Topic, raw: RawMessage) -> None:
        self._open().write(topic.name, topic.type, raw.data, raw.log_ns, topic.qos)

    def add(self, result: FrameResult) -> None:
        bag = self._open()
        for output in result.outputs:
            bag.write(f"{NAMESPACE}/{output.topic}", output.type, output.data, result.raw.log_ns)
        if self._tables is not None:
            self._tables.add(result)
        if result.picture is not None:
            folder = self._folder / "overlays"
            folder.mkdir(exist_ok=True)
            write_png(folder / f"{self._pictures:06d}.png", result.picture)
            self._pictures += 1

    def finish(self, document: dict[str, Any], frames: Rows, config: SegmenterConfig) -> None:
        """Make what was written so far a whole folder."""
        if self._bag is not None:
            self._bag.close()
            if self._tables is not None:
                self._tables.close()
            with (self._folder / METRICS).open("w", encoding="utf-8") as stream:
                write_document(stream, document, "frames", frames)
            (self._folder / "config.yaml").write_text(config_yaml(config), "utf-8")
