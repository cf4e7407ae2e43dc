"""What the node knows of its own health: counts, latencies and rejections, as one diagnostic_msgs status a
second.

Nothing that arrives on a topic may end the node; it is counted here by reason instead, and worth a warning
once in a throttle period. Written by the executor's and the worker's thread, so every access takes the
lock.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from rcseg_core import Segmentation
from rcseg_ros.live.hearing import Complaint
from rcseg_ros.results.outputs import Make

OK, WARN = b"\x00", b"\x01"  # constants of diagnostic_msgs/DiagnosticStatus
WINDOW = 300  # latencies that the percentiles are taken over
SILENCE_S = 5.0  # an active node that hears nothing for so long says so


def noise_values(result: Segmentation) -> dict[str, str]:
    """The noise that a frame was segmented with, for diagnostics: a sensor that degrades shows here first."""
    noise, scale = result.noise, result.scale
    values = {"noise.source": noise.source, "noise.range_sigma_mm": f"{1e3 * scale.sigma_m:.2f}"}
    if np.isfinite(scale.depth_m):
        values["noise.at_median_depth_m"] = f"{scale.depth_m:.2f}"
    return values | {
        "noise.range_correlation_px": f"{noise.range_correlation:.1f}",
        "noise.color_sigma": " ".join(f"{sigma:.1f}" for sigma in noise.color),
        "noise.color_correlation_px": f"{noise.color_correlation:.1f}",
    }


class Health:
    """Counters since the last configure."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._rejected: Counter[str] = Counter()
        self._last_rejection: dict[str, str] = {}
        self._warned_at: dict[str, float] = {}
        self._latency_s: deque[float] = deque(maxlen=WINDOW)
        self._segment_s: deque[float] = deque(maxlen=WINDOW)
        self._published_at: deque[float] = deque(maxlen=WINDOW)
        self._measured: dict[str, str] = {}
        self._heard_at = time.monotonic()
        self._reported: tuple[int, int] = (0, 0)
        self._progress = ""
        self._notes: dict[str, str] = {}
        self._complaint = ""
        self._complained: set[str] = set()

    def progress(self, text: str) -> None:
        """What the node is doing at length, which the status then says; empty when it is done."""
        with self._lock:
            self._progress = text.strip()

    def note(self, name: str, text: str) -> None:
        """A value that the status then shows under that name."""
        with self._lock:
            self._notes[name] = text

    def complain(self, complaint: Complaint | None) -> bool:
        """Why nothing is published, or None; True when this reason is new and wants a log line."""
        with self._lock:
            self._complaint = complaint.text if complaint else ""
            new = complaint is not None and complaint.reason not in self._complained
            if complaint is not None:
                self._complained.add(complaint.reason)
        return new

    def count(self, name: str, by: int = 1) -> None:
        """Count an event, for example a message in or a frame dropped."""
        with self._lock:
            self._counts[name] += by
            if name.startswith("received"):
                self._heard_at = time.monotonic()

    def reject(self, reason: str, text: str, warn_period_s: float) -> bool:
        """Count a rejection; True when a warning of this reason is due."""
        now = time.monotonic()
        with self._lock:
            self._rejected[reason] += 1
            self._last_rejection[reason] = text
            due = now - self._warned_at.get(reason, -np.inf) >= warn_period_s
            if due:
                self._warned_at[reason] = now
        return due

    def published(
        self, latency_s: float, segment_s: float, measured: Mapping[str, str] | None = None
    ) -> None:
        """Record a frame: from its last input's arrival to its labels' publication, and segment() alone.

        measured : what the latest frame told of the sensor, see `noise_values`
        """
        with self._lock:
            self._measured = dict(measured or {})
            self._counts["segmented"] += 1
            self._latency_s.append(latency_s)
            self._segment_s.append(segment_s)
            self._published_at.append(time.monotonic())

    def status(self, name: str, state: str, drops: Mapping[str, int], make: Make) -> Any:
        """Build the diagnostic_msgs/DiagnosticStatus of this moment; `drops` are the pairing's own counts."""
        with self._lock:
            counts = {**self._counts, **{f"dropped.{reason}": number for reason, number in drops.items()}}
            values = {"state": state, **self._rates(), **self._measured}
            values |= {k: str(v) for k, v in sorted(counts.items())} | self._notes
            for reason, number in sorted(self._rejected.items()):
                values[f"rejected.{reason}"] = f"{number} (last: {self._last_rejection[reason]})"
            level, message = self._summary(state)
        pairs = [make("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in values.items()]
        return make(
            "diagnostic_msgs/msg/DiagnosticStatus", level=level, name=name, message=message, values=pairs
        )

    @property
    def silent(self) -> bool:
        """Whether no input was heard for a while."""
        return time.monotonic() - self._heard_at > SILENCE_S

    def _rates(self) -> dict[str, str]:
        now = time.monotonic()
        recent = [t for t in self._published_at if now - t < 5.0]
        values = {"rate_hz": f"{len(recent) / 5.0:.1f}"}
        for name, series in (("latency", self._latency_s), ("segment", self._segment_s)):
            if series:
                p50, p95 = np.percentile(series, [50, 95]) * 1e3
                values |= {f"{name}_p50_ms": f"{p50:.1f}", f"{name}_p95_ms": f"{p95:.1f}"}
        return values

    def _summary(self, state: str) -> tuple[bytes, str]:
        """Warn of rejections since the last report and of silence; drops are how a live node keeps up."""
        rejected = sum(self._rejected.values())
        before, self._reported = self._reported, (rejected, self._counts["segmented"])
        if self._progress:
            return OK, self._progress
        if state != "active":
            return OK, state
        if rejected > before[0]:
            reason = self._rejected.most_common(1)[0][0]
            return WARN, f"{rejected - before[0]} rejected since the last report, most often {reason}"
        if self._complaint:
            return WARN, self._complaint
        if self.silent:
            return WARN, f"no input for {time.monotonic() - self._heard_at:.0f} s"
        return OK, f"{self._reported[1] - before[1]} frames since the last report"
