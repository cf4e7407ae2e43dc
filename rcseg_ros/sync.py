"""Pairs range with colour by stamp: an exact match first, else the nearest within a slop.

One class serves live topics and recordings, so that a replay tests what the robot runs. A pair is made when
each is the other's nearest and no message to come, in order, could be nearer; so the pairs depend on the
stamps and the order of arrival alone, never on the clock. Live, the newest pair wins and what is older is let
go; in a replay all is kept that a later message could still match. What is let go is counted by its reason.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import Counter, deque
from dataclasses import dataclass
from typing import Any

_JUMP_BACK_NS = 1_000_000_000  # stamps this much older than the latest start a new run (a bag that loops)


@dataclass(frozen=True)
class Pair:
    """One frame's messages: range (cloud or depth image), and colour and camera_info where there are any.

    ``offset_ns`` is the colour's stamp minus the range's, whose stamp the frame takes.
    """

    stamp_ns: int
    range: Any
    color: Any | None
    camera: Any | None
    offset_ns: int


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
    live : the newest pair wins; False: keep everything that can still be paired (replay)

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
        live: bool = False,
    ) -> None:
        self.slop_ns = slop_ns
        self.with_color = with_color
        self.needs_camera = needs_camera
        self.live = live
        self.drops: Counter[str] = Counter()
        self._range = _Stream("range", queue_size)
        self._color = _Stream("color", queue_size)
        self._cameras: deque[tuple[int, Any]] = deque(maxlen=4)
        self._held: deque[Pair] = deque()
        self._last_pair_ns: int | None = None

    def add_range(self, stamp_ns: int, message: Any) -> list[Pair]:
        """Take in a cloud or depth image; return the pairs that are now complete, oldest first."""
        return self._add(self._range, stamp_ns, message)

    def add_color(self, stamp_ns: int, message: Any) -> list[Pair]:
        """Take in a colour image; return the pairs that are now complete, oldest first."""
        return self._add(self._color, stamp_ns, message)

    def add_camera(self, stamp_ns: int, message: Any) -> list[Pair]:
        """Take in a camera_info; return the pairs that waited for it."""
        self._cameras.append((stamp_ns, message))
        held, self._held = self._held, deque()
        return [self._with_camera(pair) for pair in held]

    def flush(self) -> list[Pair]:
        """Pair what can be paired now that nothing more comes, and count the rest as dropped."""
        pairs = self._ready(self._match(final=True))
        for stream in (self._range, self._color):
            self._drop(stream, list(stream.stamps), "unpaired")
        self.drops["no_camera_info"] += len(self._held)
        self._held.clear()
        return pairs

    def _add(self, stream: _Stream, stamp: int, message: Any) -> list[Pair]:
        pairs: list[Pair] = []
        latest = max((s.latest for s in (self._range, self._color) if s.latest is not None), default=stamp)
        if stamp < latest - max(_JUMP_BACK_NS, 2 * self.slop_ns):
            pairs = self._restart()
        if stream.knows(stamp):
            self.drops[f"duplicate_{stream.name}"] += 1
            return pairs
        if self.live and self._last_pair_ns is not None and stamp <= self._last_pair_ns - self.slop_ns:
            self.drops[f"late_{stream.name}"] += 1
            return pairs
        stream.add(stamp, message)
        pairs += self._ready(self._match())
        if len(stream.stamps) > stream.size:
            self._drop(stream, stream.stamps[:1], "queue_full")
        return pairs

    def _restart(self) -> list[Pair]:
        pairs = self.flush()
        self.drops["time_jump"] += 1
        self._range.clear()
        self._color.clear()
        self._last_pair_ns = None
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
            stream.take(stamp)
        if stamps:
            self.drops[f"{reason}_{stream.name}"] += len(stamps)

    def _ready(self, pairs: list[Pair]) -> list[Pair]:
        if not self.needs_camera or self._cameras:
            return [self._with_camera(pair) for pair in pairs]
        self._held.extend(pairs)
        while len(self._held) > self._range.size:
            self._held.popleft()
            self.drops["no_camera_info"] += 1
        return []

    def _with_camera(self, pair: Pair) -> Pair:
        """The camera_info of the nearest stamp; drivers send it with each image, or once."""
        if not self._cameras:
            return pair
        _, camera = min(self._cameras, key=lambda item: (abs(item[0] - pair.stamp_ns), item[0]))
        return Pair(pair.stamp_ns, pair.range, pair.color, camera, pair.offset_ns)
