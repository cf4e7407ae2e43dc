"""One recorded frame from messages to results: decode, segment, encode; what replay spreads over workers."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, is_dataclass
from time import perf_counter, thread_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_core import RangeColorFrame, Segmentation, SegmenterConfig, segment
from rcseg_core.errors import InputError
from rcseg_core.evaluation.frames import evaluate_labels
from rcseg_ros.frames.assembly import assemble
from rcseg_ros.frames.conversions import Header, MessageError, decode_labels, header_of
from rcseg_ros.frames.reading import DEFAULT_READING, Reading
from rcseg_ros.frames.registration import Surroundings
from rcseg_ros.frames.sync import Pair
from rcseg_ros.recordings.bag import RawMessage
from rcseg_ros.recordings.result_bag import make_message, serialize
from rcseg_ros.results.cdr import Serialized
from rcseg_ros.results.made import ResultMessages

TRACKS = "tracks"
#: What a result bag holds by default; the clouds of CLOUDS are as large as the input, and wanted by few.
OUTPUTS = (
    "labels", "surface_labels", "regions", "edges", "overlay", "reconstruction", "class_mask",
    "object_labels", "objects", "polygons", TRACKS,
)  # fmt: skip
CLOUDS = ("ground_points", "obstacle_points", "labelled_points")


@dataclass(frozen=True)
class Output:
    """A serialised result: name of the topic below the node's, type, CDR bytes."""

    topic: str
    type: str
    data: bytes | memoryview


@dataclass(frozen=True)
class FrameResult:
    """What became of one pair: outputs and a row of metrics, or the reason why it was rejected.

    raw : the range message
    tables : its rows, where the work has somebody who makes them
    """

    raw: RawMessage
    row: dict[str, Any]
    outputs: tuple[Output, ...] = ()
    picture: NDArray[np.uint8] | None = None
    rejected: str = ""
    error: str = ""
    tables: Any = None


@dataclass(frozen=True)
class Segmented:
    """A frame that is segmented, and not yet named and encoded.

    raw : the range message
    header : stamp and frame of the results
    messages : of the results, in whose `named` the names are put
    """

    raw: RawMessage
    header: Header
    frame: RangeColorFrame
    result: Segmentation
    row: dict[str, Any]
    messages: ResultMessages


@dataclass(frozen=True)
class FrameWork:
    """Turns pairs of recorded messages into results; holds nothing that changes, so any thread may call it.

    decode : deserialises a recorded message
    reading : units and bits that the messages do not tell
    truth : recorded truth label images by kind ("labels", "surface_labels") and stamp
    around : what is known beside the messages
    tables : makes rows of tables of a frame
    segmenter : segments a frame at a stamp (ns), seen from a sensor frame; must be called in the order of the
        frames where results depend on the last one
    """

    config: SegmenterConfig
    decode: Callable[[RawMessage], Any]
    outputs: tuple[str, ...] = OUTPUTS
    truth: Mapping[str, Mapping[int, RawMessage]] | None = None
    picture: bool = False
    reading: Reading = DEFAULT_READING
    around: Surroundings = field(default_factory=Surroundings)
    tables: Callable[[Segmented], Any] | None = None
    segmenter: Callable[[RangeColorFrame, Header], Segmentation] | None = None

    def __call__(self, pair: Pair) -> FrameResult:
        """All of it, without tracks."""
        made = self.segment(pair)
        return made if isinstance(made, FrameResult) else self.encode(made)

    def segment(self, pair: Pair, described: bool = False) -> Segmented | FrameResult:
        """The first half: decode and segment; `described`: find what tracking will ask for here already."""
        raw: RawMessage = pair.range
        try:
            raws = (raw, pair.color, pair.camera, pair.range_camera)
            messages = [None if one is None else self.decode(one) for one in raws]
            made = assemble(*messages, self.around, self.reading)
        except InputError as error:
            reason = error.reason if isinstance(error, MessageError) else "unusable_frame"
            return FrameResult(raw, {}, rejected=reason, error=str(error))
        frame = made.frame
        header = Header(header_of(messages[0]).stamp_ns, made.frame_id)
        start, start_cpu = perf_counter(), thread_time()
        chosen = self.segmenter
        result = segment(frame, self.config) if chosen is None else chosen(frame, header)
        seconds, cpu = perf_counter() - start, thread_time() - start_cpu
        row = frame_row(header, pair.offset_ns, frame, result, seconds) | {"segment_cpu_ms": cpu * 1e3}
        row |= {"camera": asdict(made.geometry)}
        row |= self._compare(pair.stamp_ns, result)
        told = self.around.up.at(self.config.world.up_from, header.frame_id, header.stamp_ns)
        results = ResultMessages(header, frame, result, make_message, str(made.geometry), told)
        if described:
            len(results.world.objects)
        return Segmented(raw, header, frame, result, row, results)

    def encode(self, made: Segmented) -> FrameResult:
        """The second half: messages and tables, under the names that the frame was given."""
        messages = made.messages
        outputs = tuple(o for name in self.outputs for o in serialized(name, getattr(messages, name)))
        tables = None if self.tables is None else self.tables(made)
        return FrameResult(
            made.raw, made.row, outputs, messages.picture if self.picture else None, tables=tables
        )

    def _compare(self, stamp_ns: int, result: Segmentation) -> dict[str, Any]:
        """Metrics against recorded truth of the same stamp, where there is any."""
        found = {}
        for kind, by_stamp in (self.truth or {}).items():
            if stamp_ns in by_stamp:
                message = self.decode(by_stamp[stamp_ns])
                truth = decode_labels(message)
                metrics = evaluate_labels(truth, getattr(result, kind))
                at = metrics.at()
                found[kind] = {
                    "truth_regions": at.truth_regions,
                    "correct": at.correct,
                    "voi_bits": metrics.voi_bits,
                    "covering": metrics.covering,
                }
        return {"truth": found} if found else {}


def serialized(name: str, made: Any) -> list[Output]:
    """One message, several, or none: what needs to know where up is, is silent where that is unknown."""
    messages = made if isinstance(made, list) else [made]
    if isinstance(made, Serialized):
        return [Output(name, made.type, made.data)]
    return [Output(name, one.__msgtype__, serialize(one)) for one in messages if one is not None]


def frame_row(
    header: Header, offset_ns: int, frame: RangeColorFrame, result: Segmentation, seconds: float
) -> dict[str, Any]:
    """Metrics of one frame as plain values; times in milliseconds, shares of all pixels."""
    return {
        "stamp_ns": header.stamp_ns,
        "frame_id": header.frame_id,
        "color_offset_ns": offset_ns,
        "height": frame.height,
        "width": frame.width,
        "valid_share": np.count_nonzero(frame.valid) / frame.valid.size,
        "labelled_share": np.count_nonzero(result.labels) / result.labels.size,
        "regions": int(result.labels.max(initial=0)),  # to count them is not to describe them
        "surfaces": int(result.surface_labels.max(initial=0)),
        "segment_ms": seconds * 1e3,
        "stages_ms": {stage: value * 1e3 for stage, value in result.timings.items()},
        "noise": noise_document(result),
    }


def noise_document(result: Segmentation) -> dict[str, Any]:
    """The noise of a frame as plain values: its law, and what that is at the median depth.

    ``range_law``: sigma = a + b s + c s^2 of the signal s for each range channel, in ``range_unit``;
    ``color``: standard deviations in grey levels; correlations in pixels; ``median_depth_m``: null for
    grids of parallel rays; ``sigma_m``, ``tolerance_m``: standard deviation of range and approximation limit
    there.
    """
    scale = result.scale
    return plain(result.noise) | {
        "range_unit": "1/m" if result.signals.inverse_depth else "m",
        "median_depth_m": plain(scale.depth_m),
        "sigma_m": plain(scale.sigma_m),
        "tolerance_m": plain(scale.tolerance_m),
    }


def plain(value: Any) -> Any:
    """Dataclasses, arrays and numpy numbers as what JSON knows; None for NaN and infinity."""
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value
