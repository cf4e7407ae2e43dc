"""Pairs range with colour by stamp: an exact match first, else the nearest within a slop.

One class serves live topics and recordings, so that a replay tests what the robot runs. A pair is made when
each is the other's nearest and no message to come, in order, could be nearer; so the pairs depend on the
stamps and the order of arrival alone, never on the clock. Live, the newest pair wins and what is older is let
go; in a replay all is kept that a later message could still match. What is let go is counted by its reason.
"""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

_JUMP_BACK_NS = 1_000_000_000  # stamps this much older than the latest start a new run (a bag that loops)
_LAG_NS = 500_000_000  # no driver takes so much longer than another from the image to its message
_TWO_CLOCKS_NS = 60_000_000_000  # stamps of one recording that lie further apart come from two clocks


@dataclass(frozen=True)
class Pair:
    """One frame's messages: range (cloud or depth image), and colour and camera_info where there are any.

    ``offset_ns`` is the colour's stamp, less the offset set for the pairing, minus the range's, whose stamp
    the frame takes; ``range_camera`` is the camera_info of a range that another camera than the colour's
    measures.
    """

    stamp_ns: int
    range: Any
    color: Any | None
    camera: Any | None
    offset_ns: int
    range_camera: Any | None = None


class _Stream:
    """Messages of one topic that wait for a partner, by stamp."""

    def __init__(self, name: str, size: int) -> None:
        self.name = name
        self.size = size
        self.clear()

    def clear(self) -> None:
        self.stamps: list[int] = []
        self.messages: dict[int, Any] = {}
        self.latest: int | None = None
        self.period_ns = 0
        self.used: deque[int] = deque(maxlen=self.size)

    def add(self, stamp: int, message: Any) -> None:
        insort(self.stamps, stamp)
        self.messages[stamp] = message
        if self.latest is not None and stamp > self.latest:
            self.period_ns = stamp - self.latest
        self.latest = stamp if self.latest is None else max(stamp, self.latest)

    def knows(self, stamp: int) -> bool:
        return stamp in self.messages or stamp in self.used

    def take(self, stamp: int) -> Any:
        self.stamps.remove(stamp)
        self.used.append(stamp)
        return self.messages.pop(stamp)

    def nearest(self, stamp: int) -> int | None:
        """Waiting stamp nearest to the given one; of two equally near the earlier."""
        i = bisect_left(self.stamps, stamp)
        around = self.stamps[max(i - 1, 0) : i + 1]
        return min(around, key=lambda s: (abs(s - stamp), s)) if around else None


class FrameSync:
    """Pair range messages with colour messages and the camera_info in force.

    Parameters
    ----------
    slop_ns : largest difference of stamps in a pair
    queue_size : messages of one topic that may wait; beyond, the oldest is dropped and counted
    with_color : False makes a frame of each range message alone (clouds that carry their own colour)
    needs_camera : hold frames back until the first camera_info has come
    needs_range_camera : tells of a pair whether its range has a camera_info of its own to wait for
    live : the newest pair wins; False: keep everything that can still be paired (replay)
    offset_ns : what colour stamps are too late by; taken off before they are compared
    on_lost : called with the reason and each range message that is let go

    Attributes
    ----------
    drops : Counter
        Messages let go, by reason: ``duplicate_*``, ``late_*``, ``queue_full_*``, ``unpaired_*`` (``*`` is
        ``range`` or ``color``) and ``no_camera_info``; ``time_jump`` counts restarts, not messages.
    """

    def __init__(
        self,
        *,
        slop_ns: int = 20_000_000,
        queue_size: int = 30,
        with_color: bool = True,
        needs_camera: bool = False,
        needs_range_camera: Callable[[Pair], bool] = lambda pair: False,
        live: bool = False,
        offset_ns: int = 0,
        on_lost: Callable[[str, Any], None] = lambda reason, message: None,
    ) -> None:
        self.slop_ns = slop_ns
        self.with_color = with_color
        self.needs_camera = needs_camera
        self.needs_range_camera = needs_range_camera
        self.live = live
        self.offset_ns = offset_ns
        self._on_lost = on_lost
        self.drops: Counter[str] = Counter()
        self._range = _Stream("range", queue_size)
        self._color = _Stream("color", queue_size)
        self._cameras: deque[tuple[int, Any]] = deque(maxlen=4)
        self._range_cameras: deque[tuple[int, Any]] = deque(maxlen=4)
        self._held: deque[Pair] = deque()
        self._last_pair_ns: int | None = None

    def add_range(self, stamp_ns: int, message: Any) -> list[Pair]:
        """Take in a cloud or depth image; return the pairs that are now complete, oldest first."""
        return self._add(self._range, stamp_ns, message)

    def add_color(self, stamp_ns: int, message: Any) -> list[Pair]:
        """Take in a colour image; return the pairs that are now complete, oldest first."""
        return self._add(self._color, stamp_ns - self.offset_ns, message)

    def add_camera(self, stamp_ns: int, message: Any) -> list[Pair]:
        """Take in a camera_info; return the pairs that waited for it."""
        self._cameras.append((stamp_ns, message))
        return self._released()

    def add_range_camera(self, stamp_ns: int, message: Any) -> list[Pair]:
        """Take in the range's own camera_info; return the pairs that waited for it."""
        self._range_cameras.append((stamp_ns, message))
        return self._released()

    def _released(self) -> list[Pair]:
        held, self._held = list(self._held), deque()
        return self._ready(held)

    def by_topic(
        self, range_: str, color: str | None, camera: str | None, range_camera: str | None
    ) -> dict[str | None, Callable[[int, Any], list[Pair]]]:
        """What takes in the messages of each topic; None: there is none."""
        return {
            range_camera: self.add_range_camera,
            camera: self.add_camera,
            color: self.add_color,
            range_: self.add_range,
        }

    def start_anew(self, stamp_of: Callable[[Any], int | None] = lambda message: None) -> list[Pair]:
        """Let go of what waits for a partner; the camera stays, and so do pairs that wait for one.

        stamp_of : the stamp in nanoseconds under which a message is taken in again; None lets it go.

        Returns the pairs that these make, oldest first.
        """
        kept = []
        for stream in (self._range, self._color):
            for waiting in list(stream.stamps):
                stamp = stamp_of(stream.messages[waiting])
                if stamp is None:
                    self._drop(stream, [waiting], "unpaired")
                else:
                    kept.append((stamp, stream, stream.take(waiting)))
            stream.clear()
        self._last_pair_ns = None
        pairs = []
        for stamp, stream, message in sorted(kept, key=lambda item: item[0]):
            add = self.add_range if stream is self._range else self.add_color
            pairs += add(stamp, message)
        return pairs

    def flush(self) -> list[Pair]:
        """Pair what can be paired now that nothing more comes, and count the rest as dropped."""
        pairs = self._ready(self._match(final=True))
        self.let_go()
        return pairs

    def let_go(self) -> None:
        """Count all that waits as dropped, without pairing any of it."""
        self.start_anew()
        while self._held:
            self._without_camera(self._held.popleft())

    @property
    def awaited(self) -> list[str]:
        """Cameras that paired frames are held back for: ``camera_info``, ``depth_camera_info``."""
        return self._missing_cameras(self._held)

    def _missing_cameras(self, pairs: Iterable[Pair]) -> list[str]:
        own = not self._range_cameras and any(self.needs_range_camera(pair) for pair in pairs)
        missing = {"camera_info": self.needs_camera and not self._cameras, "depth_camera_info": own}
        return [name for name, waits in missing.items() if waits]

    def _add(self, stream: _Stream, stamp: int, message: Any) -> list[Pair]:
        pairs: list[Pair] = []
        latest = max((s.latest for s in (self._range, self._color) if s.latest is not None), default=stamp)
        if stamp < latest - max(_JUMP_BACK_NS, 2 * self.slop_ns):
            pairs = self._restart()
        if stream.knows(stamp):
            self._lose(stream, "duplicate", message)
            return pairs
        if self.live and self._last_pair_ns is not None and stamp <= self._last_pair_ns - self.slop_ns:
            self._lose(stream, "late", message)
            return pairs
        stream.add(stamp, message)
        pairs += self._ready(self._match())
        if len(stream.stamps) > stream.size:
            self._drop(stream, stream.stamps[:1], "queue_full")
        return pairs

    def _restart(self) -> list[Pair]:
        pairs = self.flush()
        self.drops["time_jump"] += 1
        return pairs

    def _match(self, final: bool = False) -> list[Pair]:
        pairs = []
        if not self.with_color:
            pairs = [Pair(r, self._range.take(r), None, None, 0) for r in list(self._range.stamps)]
            self._last_pair_ns = pairs[-1].stamp_ns if pairs else self._last_pair_ns
            return pairs
        while (found := self._settled(final)) is not None:
            r, c = found
            pairs.append(Pair(r, self._range.take(r), self._color.take(c), None, c - r))
            if self.live:
                self._drop(self._range, [s for s in self._range.stamps if s < r], "unpaired")
                self._drop(self._color, [s for s in self._color.stamps if s < c], "unpaired")
            self._last_pair_ns = r if self._last_pair_ns is None else max(r, self._last_pair_ns)
        return pairs

    def _settled(self, final: bool) -> tuple[int, int] | None:
        """First (range, colour) of mutual nearest stamps that nothing still to come can better."""
        for r in self._range.stamps:
            c = self._color.nearest(r)
            if c is None or abs(c - r) > self.slop_ns or self._range.nearest(c) != r:
                continue
            gap = abs(c - r)
            if final or gap == 0:
                return r, c
            assert self._color.latest is not None and self._range.latest is not None
            # Live, half a period ahead is foreseen: waiting for the next image would cost a frame's time.
            foreseen = self._color.period_ns // 2 if self.live else 0
            no_nearer_color = self._color.latest + foreseen >= r + gap
            no_nearer_range = self.live or self._range.latest >= c + gap
            if no_nearer_color and no_nearer_range:
                return r, c
        return None

    def _drop(self, stream: _Stream, stamps: list[int], reason: str) -> None:
        for stamp in stamps:
            self._lose(stream, reason, stream.take(stamp))

    def _lose(self, stream: _Stream, reason: str, message: Any) -> None:
        reason = f"{reason}_{stream.name}"
        self.drops[reason] += 1
        if stream is self._range:
            self._on_lost(reason, message)

    def _without_camera(self, pair: Pair) -> None:
        self.drops["no_camera_info"] += 1
        self._on_lost("no_camera_info", pair.range)

    def _ready(self, pairs: list[Pair]) -> list[Pair]:
        if not self._missing_cameras(pairs):
            return [self._with_camera(pair) for pair in pairs]
        self._held.extend(pairs)
        while len(self._held) > self._range.size:
            self._without_camera(self._held.popleft())
        return []

    def _with_camera(self, pair: Pair) -> Pair:
        """The camera_infos of the nearest stamp; drivers send them with each image, or once."""
        return replace(
            pair,
            camera=_nearest(self._cameras, pair.stamp_ns),
            range_camera=_nearest(self._range_cameras, pair.stamp_ns),
        )


def _nearest(stamped: Iterable[tuple[int, Any]], stamp_ns: int) -> Any | None:
    nearest = min(stamped, key=lambda item: (abs(item[0] - stamp_ns), item[0]), default=None)
    return None if nearest is None else nearest[1]


def explain_gap(range_ns: Sequence[int], color_ns: Sequence[int], slop_ns: int) -> str:
    """Why range and colour did not meet, in words: two clocks, a steady offset, or stamps at will.

    Parameters
    ----------
    range_ns, color_ns : stamps of all messages of either topic, int64 nanoseconds
    slop_ns : largest difference of stamps in a pair

    Returns
    -------
    str : by how much the stamps differ, and what to do; empty where one of the topics has no message
    """
    if not len(range_ns) or not len(color_ns):
        return ""
    ranges, colors = np.unique(np.asarray(range_ns, np.int64)), np.unique(np.asarray(color_ns, np.int64))
    apart = max(int(colors[0] - ranges[-1]), int(ranges[0] - colors[-1]))
    if apart > _TWO_CLOCKS_NS:
        return (
            f"their stamps come from two clocks: range {ranges[0] / 1e9:.3f} to {ranges[-1] / 1e9:.3f} s, "
            f"colour {colors[0] / 1e9:.3f} to {colors[-1] / 1e9:.3f} s; a larger slop does not help: give "
            "the drivers one clock, or let them leave stamps at zero, which pairs by the time of recording"
        )
    after = np.clip(np.searchsorted(colors, ranges), 1, len(colors) - 1) if len(colors) > 1 else 0
    around = np.stack([colors[np.maximum(after - 1, 0)] - ranges, colors[after] - ranges])
    nearest = np.take_along_axis(around, np.argmin(np.abs(around), axis=0)[None], axis=0)[0]
    lost = np.sort(nearest[np.abs(nearest) > slop_ns])
    if not len(lost):
        return "every frame has a colour image within the slop, but some share it"
    low, middle, high = (
        float(lost[i]) / 1e6 for i in (len(lost) // 10, len(lost) // 2, -1 - len(lost) // 10)
    )
    what = f"{len(lost)} of {len(ranges)} have none within {slop_ns / 1e6:g} ms"
    side = "after" if middle > 0 else "before"
    if high - low <= max(2.0, 0.2 * abs(middle)):
        need = math.ceil(max(abs(low), abs(high))) + 1
        return (
            f"{what}; the nearest colour stamp lies {abs(middle):.3g} ms {side} the range stamp, steadily: "
            f"try --slop {need}, if the images are of one moment"
        )
    return (
        f"{what}; the nearest colour stamp lies {low:.3g} to {high:.3g} ms after the range stamp: colour "
        "images are missing, or the cameras are not synchronised; a larger --slop pairs different moments"
    )


def explain_lag(range_name: str, range_ns: Sequence[int], color_name: str, color_ns: Sequence[int]) -> str:
    """A warning where range and colour pair though they are of different moments, by clocks that differ.

    Parameters
    ----------
    range_ns, color_ns : time from the stamp to the recording of all messages of either topic, nanoseconds

    Returns
    -------
    str : empty where nothing speaks of two clocks
    """
    if not len(range_ns) or not len(color_ns):
        return ""
    range_s, color_s = (float(np.median(lags)) / 1e9 for lags in (range_ns, color_ns))
    if abs(range_s - color_s) * 1e9 < _LAG_NS:
        return ""
    return (
        f"stamps of {range_name} lie {range_s:.2f} s before their recording, those of {color_name} "
        f"{color_s:.2f} s: if that is by two clocks, images of different moments are paired"
    )
