"""A recorded file as topics and a stream of messages in the order of time.

A file without an index is read from its beginning up to the damage, twice: first for the times, then for the
messages, of which only those are held back that an earlier one still follows. `mcap_file` and `sqlite_file`
open the two formats.
"""

from __future__ import annotations

import heapq
import struct
from array import array
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import parse_qos

#: Encodings of definitions that can be parsed; a recorder writes "unknown" where it has none.
DEFINITIONS = {"ros2msg": False, "ros2idl": True, "omgidl": True}


@dataclass(frozen=True)
class Topic:
    """One recorded topic; ``definition`` is the message definition's text, empty where the file has none."""

    name: str
    type: str
    count: int
    definition: str = field(default="", repr=False)
    is_idl: bool = False
    qos: tuple[Qos, ...] = field(default=(), repr=False)
    encoding: str = "cdr"


@dataclass(frozen=True)
class RawMessage:
    """A message as it lies in the recording: CDR bytes and the time at which it was recorded."""

    topic: str
    log_ns: int
    data: bytes = field(repr=False)

    @property
    def stamp_ns(self) -> int:
        """Stamp of a message that begins with a header; the time of recording where that is zero."""
        if len(self.data) < 12:
            return self.log_ns
        sec, nanosec = struct.unpack_from("<iI" if self.data[1] & 1 else ">iI", self.data, 4)
        return sec * 1_000_000_000 + nanosec or self.log_ns


#: Times of recording, from the first up to but without the second.
Span = tuple[int, int]
ALWAYS: Span = (-(2**63), 2**63 - 1)


class StoredFile(Protocol):
    """A file of a recording; ``start_ns`` is no later than its first message, None without messages."""

    path: Path
    topics: Mapping[str, Topic]
    start_ns: int | None
    damage: str  # why not all of the file can be read; empty where it can
    has_index: bool  # whether messages of a time are found without reading those before

    def messages(self, topics: Collection[str], span: Span = ALWAYS) -> Iterator[RawMessage]: ...

    def times(self, topic: str) -> NDArray[np.int64]:
        """Times of recording of a topic's messages, rising, from the index alone."""


def one_line(error: Exception) -> str:
    """The words of an error, or its kind where it has none."""
    return " ".join(str(error).split()) or type(error).__name__


def same_type(one: Topic, other: Topic) -> bool:
    """Whether two channels of one name carry messages that are read alike."""
    return (one.type, one.encoding) == (other.type, other.encoding)


def merge_topics(found: Sequence[tuple[Topic, int]]) -> dict[str, Topic]:
    """Topics by name with the sum of their counts; of several types the first that is a ROS 2 message."""
    topics: dict[str, Topic] = {}
    for topic, count in sorted(found, key=lambda item: item[0].encoding != "cdr"):
        known = topics.setdefault(topic.name, replace(topic, count=0))
        if same_type(known, topic):
            topics[topic.name] = replace(known, count=known.count + count)
    return topics


@lru_cache(maxsize=256)
def qos_of(text: str | None) -> tuple[Qos, ...]:
    """Recorded QoS profiles; none where they cannot be read."""
    try:
        return tuple(parse_qos(text or ""))
    except Exception:  # it decides on nothing here: recordings with odd ones are read all the same
        return ()


#: From a file and the topics that are wanted, None for all, to its messages in the order of writing.
#: Where all are asked for only the times are of interest, and data may be left empty.
Scan = Callable[[Path, "Collection[str] | None"], Iterator[tuple[Topic, RawMessage]]]


class ScannedFile:
    """A file that is read from its beginning to its first bad byte."""

    has_index = False

    def __init__(self, path: Path, scan: Scan, damage: str = "") -> None:
        self.path = path
        self.damage = damage
        self._scan = scan
        self._times, self._numbers = array("q"), array("L")  # of each message, and its topic's number
        self._names: dict[str, int] = {}
        counts: Counter[Topic] = Counter()
        try:
            for topic, raw in scan(path, None):
                self._times.append(raw.log_ns)
                self._numbers.append(self._names.setdefault(topic.name, len(self._names)))
                counts[topic] += 1
        except Exception as error:
            self.damage = f"readable for {counts.total()} messages: {one_line(error)}"
        self.topics = merge_topics(list(counts.items()))
        self.start_ns = min(self._times, default=None)

    def messages(self, topics: Collection[str], span: Span = ALWAYS) -> Iterator[RawMessage]:
        wanted = [number for name, number in self._names.items() if name in topics]
        times = np.asarray(self._times)[np.isin(np.asarray(self._numbers), wanted)]
        for raw in _in_order_of_time(self._readable(topics, len(times)), times):
            if raw is not None and span[0] <= raw.log_ns < span[1]:
                yield raw

    def times(self, topic: str) -> NDArray[np.int64]:
        mine = np.asarray(self._numbers) == self._names.get(topic, -1)
        return np.sort(np.asarray(self._times, np.int64)[mine])

    def _readable(self, topics: Collection[str], count: int) -> Iterator[tuple[int, RawMessage | None]]:
        """The messages that the first reading found, None for those of another type than their topic's."""
        if count:
            for number, (topic, raw) in enumerate(self._scan(self.path, topics), start=1):
                yield raw.log_ns, raw if same_type(self.topics[topic.name], topic) else None
                if number == count:
                    return


def _in_order_of_time(
    items: Iterator[tuple[int, RawMessage | None]], times: NDArray[np.int64]
) -> Iterator[RawMessage | None]:
    """Items by time, each as soon as no earlier one follows; those of equal time as they come."""
    earliest_after = np.minimum.accumulate(np.append(times, 2**63 - 1)[::-1])[::-1]
    waiting: list[tuple[int, int, RawMessage | None]] = []
    failure = None
    try:
        for number, (ns, item) in enumerate(items, start=1):
            heapq.heappush(waiting, (ns, number, item))
            while waiting and waiting[0][0] <= earliest_after[number]:
                yield heapq.heappop(waiting)[2]
    except Exception as error:
        failure = error
    while waiting:
        yield heapq.heappop(waiting)[2]
    if failure is not None:
        raise failure
