"""One recorded frame from messages to results: decode, segment, encode; what replay spreads over workers."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, is_dataclass
from time import perf_counter, thread_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_core import RangeColorFrame, Segmentation, SegmenterConfig, segment
from rcseg_core.errors import InputError
from rcseg_core.evaluation import evaluate_labels
from rcseg_ros.assembly import assemble_frame
from rcseg_ros.bag import RawMessage
from rcseg_ros.conversions import Header, MessageError, decode_labels, header_of
from rcseg_ros.result_bag import make_message, serialize
from rcseg_ros.results import ResultMessages
from rcseg_ros.sync import Pair

OUTPUTS = ("labels", "surface_labels", "regions", "edges", "overlay", "reconstruction")


@dataclass(frozen=True)
class Output:
    """A serialised result: name of the topic below the node's, type, CDR bytes."""

    topic: str
    type: str
    data: bytes | memoryview


@dataclass(frozen=True)
class FrameResult:
    """What became of one pair: outputs and a row of metrics, or the reason why it was rejected."""

    log_ns: int
    row: dict[str, Any]
    outputs: tuple[Output, ...] = ()
    picture: NDArray[np.uint8] | None = None
    rejected: str = ""
    error: str = ""


@dataclass(frozen=True)
class FrameWork:
    """Turns pairs of recorded messages into results; holds nothing that changes, so any thread may call it.

    decode : deserialises a recorded message
    truth : recorded truth label images by kind ("labels", "surface_labels") and stamp
    """

    config: SegmenterConfig
    decode: Callable[[RawMessage], Any]
    outputs: tuple[str, ...] = OUTPUTS
    truth: Mapping[str, Mapping[int, RawMessage]] | None = None
    picture: bool = False

    def __call__(self, pair: Pair) -> FrameResult:
        raw: RawMessage = pair.range
        try:
            range_message = self.decode(raw)
            image = None if pair.color is None else self.decode(pair.color)
            camera_info = None if pair.camera is None else self.decode(pair.camera)
            frame = assemble_frame(range_message, image, camera_info)
        except InputError as error:
            reason = error.reason if isinstance(error, MessageError) else "unusable_frame"
            return FrameResult(raw.log_ns, {}, rejected=reason, error=str(error))
        start, start_cpu = perf_counter(), thread_time()
        result = segment(frame, self.config)
        seconds, cpu = perf_counter() - start, thread_time() - start_cpu
        header = header_of(range_message)
        row = frame_row(header, pair.offset_ns, frame, result, seconds) | {"segment_cpu_ms": cpu * 1e3}
        row |= self._compare(pair.stamp_ns, result)
        messages = ResultMessages(header, frame, result, make_message)
        outputs = tuple(_serialized(name, getattr(messages, name)) for name in self.outputs)
        return FrameResult(raw.log_ns, row, outputs, messages.picture if self.picture else None)

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


def _serialized(name: str, message: Any) -> Output:
    return Output(name, message.__msgtype__, serialize(message))


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
        "valid_share": float(frame.valid.mean()),
        "labelled_share": float((result.labels > 0).mean()),
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
