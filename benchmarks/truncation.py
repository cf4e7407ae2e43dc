"""Every place where the bundled recording can be cut off: what comes before the cut must come out.

    python benchmarks/truncation.py [--dense 65536] [--stride 997] [--index] [--share 1/1]

Every length up to --dense, each --stride bytes beyond and at the ends of chunks; with --index every length
within the index too. A recording that is cut must open, or be refused in one line, give exactly the messages
whose chunks end before the cut (by mcap's own stream reader), and tell of the damage. Exit code 1 where one
does not.
All in one process and, where there is one, in a file system in memory: most of the time would go into
making and removing temporary folders.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from bisect import bisect_right
from pathlib import Path

from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk

from rcseg_core.errors import InputError
from rcseg_ros.recordings.bag import Recording

ROOT = Path(__file__).resolve().parents[1]
BAG = ROOT / "bags" / "tabletop" / "tabletop.mcap"


def whole_messages(path: Path) -> list[tuple[int, list[tuple[int, bytes]]]]:
    """Where each chunk, or message outside of one, ends, and what it holds: log time and data."""
    found = []
    with path.open("rb") as stream:
        for record in StreamReader(stream, emit_chunks=True).records:
            inner = breakup_chunk(record) if isinstance(record, Chunk) else [record]
            messages = [(m.log_time, m.data) for m in inner if isinstance(m, Message)]
            if messages:
                found.append((stream.tell(), messages))
    return found


class Cutter:
    """Cuts one recording again and again, each time shorter."""

    def __init__(self, source: Path, folder: Path) -> None:
        self._data = source.read_bytes()
        self._path = folder / "cut.mcap"
        self._path.write_bytes(self._data)
        self._chunks = whole_messages(source)
        self._ends = [end for end, _ in self._chunks]
        self.size = len(self._data)

    def lengths(self, dense: int, stride: int, index: bool = False) -> list[int]:
        """Lengths to cut to, the longest first."""
        found = {*range(min(dense, self.size)), *range(dense, self.size, stride)}
        found |= {end + by for end in self._ends for by in (-1, 0, 1)}
        found |= {*range(self._ends[-1], self.size)} if index else set()
        return sorted(found, reverse=True)

    def fault(self, length: int) -> str:
        """What is wrong with the recording of that length; to be called with shorter and shorter ones."""
        with self._path.open("r+b") as stream:
            stream.truncate(length)
        count = bisect_right(self._ends, length)
        wanted = sorted((m for _, chunk in self._chunks[:count] for m in chunk), key=lambda m: m[0])
        try:
            with Recording(self._path) as recording:
                found = [(raw.log_ns, bytes(raw.data)) for raw in recording.messages(list(recording.topics))]
                damage = list(recording.damage)
        except InputError as error:
            if "\n" in str(error):
                return f"more than one line: {error}"
            found, damage = [], ["refused"]
        if sorted(found) != sorted(wanted):
            return f"{len(found)} messages came out of {len(wanted)}"
        return "" if damage else "nothing was said of it"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dense", type=int, default=65536, help="every length up to this")
    parser.add_argument("--stride", type=int, default=997, help="and each so many bytes beyond")
    parser.add_argument("--index", action="store_true", help="and every length within the index")
    parser.add_argument("--share", default="1/1", help="i/n: this part of the lengths alone")
    options = parser.parse_args()
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        tempfile.tempdir = folder  # of the recordings too
        cutter = Cutter(BAG, Path(folder))
        part, parts = map(int, options.share.split("/"))
        lengths = cutter.lengths(options.dense, options.stride, options.index)[part - 1 :: parts]
        started, spent, faults = time.process_time(), 0.0, []
        for number, length in enumerate(lengths):
            before = time.process_time()
            fault = cutter.fault(length)
            spent = max(spent, time.process_time() - before)
            if fault:
                faults.append(f"{length}: {fault}")
                print(faults[-1], flush=True)
            if number % 5000 == 0:
                print(
                    f"{number} of {len(lengths)} lengths, {time.process_time() - started:.0f} s", flush=True
                )
    total = time.process_time() - started
    print(f"{len(lengths)} lengths of {BAG.name}: {len(faults)} faults")
    print(f"{total:.0f} s of processor time, at most {1e3 * spent:.0f} ms for one")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
