"""Why a node that hears its inputs publishes nothing: what is missing, how far stamps lie apart, what helps.

Fed with the stamp and the time of arrival of every message; knows no ROS. Two streams of one scene arrive
together, whatever clock stamped them: so neighbours by arrival tell the offset of the stamps.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import median

PATIENCE_NS = 1_500_000_000  # so long nothing may come of what is heard
WINDOW = 16  # messages of a topic that are judged
LARGE_BYTES = 1 << 16  # beyond, a message travels in pieces, each of which may be lost
_CLOCKS_NS = 60_000_000_000  # stamps further apart come from two clocks
_JITTER_NS = 5_000_000  # of arrivals, which offsets are measured by
_SECOND = 1e9


@dataclass
class Stream:
    """The latest messages of a topic: (arrival, stamp) in nanoseconds, and the size of the last in bytes."""

    seen: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=WINDOW))
    size: int = 0

    def period_ns(self) -> float:
        """Usual time between two arrivals; 0 before there are two."""
        gaps = [b[0] - a[0] for a, b in pairwise(self.seen)]
        return median(gaps) if gaps else 0.0

    def lost(self) -> tuple[int, int]:
        """How many messages seem to be missing between those that came, and how many came.

        A loss leaves gaps of whole multiples of the period, which the shortest gap between stamps tells; a
        driver that is merely slow leaves none.
        """
        stamps = sorted(stamp for _, stamp in self.seen)
        gaps = [b - a for a, b in pairwise(stamps) if b > a]
        if len(gaps) < 4 or self.size < LARGE_BYTES:
            return 0, len(stamps)
        period = min(gaps)
        steps = [gap / period for gap in gaps]
        if max(abs(step - round(step)) for step in steps) > 0.2 or max(steps) > 100:
            return 0, len(stamps)
        return sum(round(step) - 1 for step in steps), len(stamps)


@dataclass(frozen=True)
class Complaint:
    """Why nothing is published: a short name, which is logged once, and the words."""

    reason: str
    text: str


class Hearing:
    """What the inputs have heard since they listen."""

    def __init__(self) -> None:
        self.streams: dict[str, Stream] = {}
        self._unpaired_since_ns: int | None = None

    def heard(self, topic: str, stamp_ns: int, now_ns: int, size: int) -> None:
        """Take note of a message."""
        stream = self.streams.setdefault(topic, Stream())
        stream.seen.append((now_ns, stamp_ns))
        stream.size = size
        if self._unpaired_since_ns is None:
            self._unpaired_since_ns = now_ns

    def paired(self) -> None:
        """Take note of a frame: what was heard before has found its partners."""
        self._unpaired_since_ns = None

    def offset(self, range_topic: str) -> tuple[int, int] | None:
        """Colour's stamps less the range's, and how much that varies, in ns; None before three of each."""
        ranges, colors = self._seen(range_topic), self._seen("image")
        if min(len(ranges), len(colors)) < 3:
            return None
        apart = [
            min(colors, key=lambda seen: abs(seen[0] - arrived))[1] - stamp for arrived, stamp in ranges[-8:]
        ]
        middle = round(median(apart))
        return middle, round(median(abs(value - middle) for value in apart))

    def steady_offset(self, range_topic: str, slop_ns: int) -> int | None:
        """The offset in ns where it varies so little that stamps can be compared after it, else None."""
        found = self.offset(range_topic)
        return found[0] if found and found[1] <= max(slop_ns, _JITTER_NS) else None

    def silence(self, range_topic: str, now_ns: int) -> bool:
        """Whether nothing has been paired for so long that it wants an explanation."""
        if self._unpaired_since_ns is None:
            return False
        stream = self.streams.get(range_topic)
        usual = 3 * stream.period_ns() if stream else 0.0
        return now_ns - self._unpaired_since_ns > max(PATIENCE_NS, usual)

    def missing(
        self, names: Mapping[str, str], published: Mapping[str, str], wanted: list[str], now_ns: int
    ) -> Complaint | None:
        """The first input of those wanted that is not heard though another is.

        Parameters
        ----------
        names : full names of the topics
        published : what the graph knows of topics: "here", another topic that holds the same, or nothing
        wanted : inputs that a frame takes; those in one string, divided by a bar, replace each other
        """
        if not any(self._lately(topic, now_ns) for topic in names):
            return None
        for choice in wanted:
            topics = [topic for topic in choice.split("|") if topic in names]
            if topics and not any(self._lately(topic, now_ns) for topic in topics):
                listed = " and ".join(names[topic] for topic in topics)
                text = f"nothing heard on {listed}: {_why(topics, published)}"
                return Complaint(f"missing_{topics[0]}", text)
        return None

    def apart(
        self, range_topic: str, names: Mapping[str, str], slop_ns: int, taken_off_ns: int = 0
    ) -> Complaint | None:
        """How far the stamps of range and colour lie apart, where that keeps them from being paired."""
        found = self.offset(range_topic)
        if found is None or abs(found[0] - taken_off_ns) <= slop_ns:
            return None
        offset_ns, spread_ns = found
        side = f"{'after' if offset_ns > 0 else 'before'} those of {names[range_topic]}"
        if abs(offset_ns) > _CLOCKS_NS:
            return Complaint(
                "two_clocks",
                f"stamps of {names['image']} lie {abs(offset_ns) / _SECOND:.0f} s {side}: two clocks (one "
                "driver on simulated time?); give both the same use_sim_time, or set sync.offset_ms to auto",
            )
        if spread_ns <= max(slop_ns, _JITTER_NS):
            helps = f"set sync.offset_ms to {offset_ns / 1e6:.1f} or to auto"
        else:
            helps = f"they vary: set sync.slop_ms to {(abs(offset_ns) + 2 * spread_ns) / 1e6:.0f}"
        return Complaint(
            "stamps_apart",
            f"stamps of {names['image']} lie {abs(offset_ns) / 1e6:.1f} ms {side}, more than sync.slop_ms = "
            f"{slop_ns / 1e6:g}; {helps}",
        )

    def losses(self) -> dict[str, tuple[int, int]]:
        """Missing and received messages of each topic that seems to lose more than a few."""
        found = {topic: stream.lost() for topic, stream in self.streams.items()}
        return {topic: pair for topic, pair in found.items() if pair[0] > 0.15 * sum(pair)}

    def _seen(self, topic: str) -> list[tuple[int, int]]:
        return list(self.streams[topic].seen) if topic in self.streams else []

    def _lately(self, topic: str, now_ns: int) -> bool:
        seen = self._seen(topic)
        since = now_ns - max(3 * PATIENCE_NS, round(3 * self.streams[topic].period_ns())) if seen else 0
        return bool(seen) and seen[-1][0] > since


def _why(topics: list[str], published: Mapping[str, str]) -> str:
    for topic in topics:
        if published.get(topic) == "here":
            return "it has a publisher, but none of its messages arrives"
        if published.get(topic):
            return f"{published[topic]} is published; set input.transport to compressed"
    return "it has no publisher; remap it to the driver's topic"
