"""A short bench as a ratio: segment() on a small room beside other work of the same process.

Times are processor times of one thread, the best of rounds that take turns, so that other load on the machine
hardly shows. The ratios to compare with lie in speed_reference.json; renew them on a quiet machine after a
change that is meant to cost or save time:

    python test/ros/speed.py            # shows the ratios beside the reference
    python test/ros/speed.py --renew    # writes them
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from time import thread_time

import cv2
import numpy as np

from rcseg_core import SegmenterConfig, segment
from rcseg_core.compute.parallel import set_threads, threads
from rcseg_core.synthetic import make_scene

REFERENCE = Path(__file__).with_name("speed_reference.json")
#: Times a reference ratio at which speed is lost: gone wrong by half.
LIMIT = 1.5
ROUNDS = 7
WIDTH, HEIGHT = 320, 240

Call = Callable[[], object]


def chores() -> Call:
    """What any machine with numpy and OpenCV does alike: filters, sorting, sums and some plain Python."""
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    values = rng.normal(size=HEIGHT * WIDTH)
    groups = rng.integers(0, 500, values.size)
    square = np.ones((7, 7), np.uint8)

    def call() -> None:
        for _ in range(4):
            cv2.dilate(cv2.blur(cv2.medianBlur(picture, 5), (5, 5)), square)
            np.bincount(groups, np.exp(-values * values), 500)
        np.sort(values)
        total = 0
        for i in range(60_000):
            total += i * i % 7

    return call


def peers() -> dict[str, Call]:
    """Calls to compare with, by name."""
    found = {"chores": chores()}
    if hasattr(cv2, "findPlanes"):  # OpenCV 5; it reads points of four channels
        points = scene().points
        four = np.concatenate([points, np.zeros((HEIGHT, WIDTH, 1), np.float32)], axis=2)
        found["cv2.findPlanes"] = lambda: cv2.findPlanes(four, None)
    return found


def scene():
    return make_scene("room", 0, width=WIDTH, height=HEIGHT).frame


def product() -> Call:
    frame, config = scene(), SegmenterConfig()
    return lambda: segment(frame, config)


@contextmanager
def one_thread():
    """Kernels and OpenCV on the calling thread, whose processor time is then all there is."""
    before = threads(), cv2.getNumThreads()
    set_threads(1)
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        set_threads(before[0])
        cv2.setNumThreads(before[1])


class Race:
    """The best times so far of one call and of its peers; more rounds can only make them better."""

    def __init__(self, call: Call, others: dict[str, Call]) -> None:
        self._calls = {"": call, **others}
        self._best_s = dict.fromkeys(self._calls, float("inf"))
        for each in self._calls.values():
            each()  # compiled, loaded and cached before the first round

    def run(self, rounds: int = ROUNDS) -> dict[str, float]:
        """Ratios to the peers, by name, after so many rounds more."""
        with one_thread():
            for _ in range(rounds):
                for name, call in self._calls.items():
                    start = thread_time()
                    call()
                    self._best_s[name] = min(self._best_s[name], thread_time() - start)
        return {name: self._best_s[""] / s for name, s in self._best_s.items() if name}


def slower_by(ratios: dict[str, float], reference: dict[str, float]) -> float:
    """How many times the reference: the least over the peers that both know.

    Processors differ in what they do well; time that the product itself has lost shows against every peer.
    """
    return min(ratios[name] / reference[name] for name in ratios if name in reference)


def known() -> dict[str, float]:
    return json.loads(REFERENCE.read_text("utf-8"))["ratios"]


def main() -> None:
    race = Race(product(), peers())
    ratios = race.run(5 * ROUNDS)
    reference = known() if REFERENCE.exists() else {}
    for name, ratio in ratios.items():
        print(f"segment() takes {ratio:.3f} of {name}; reference {reference.get(name, float('nan')):.3f}")
    if "--renew" in sys.argv:
        about = f"time of segment(), room of {WIDTH}x{HEIGHT}, one thread, over that of a peer"
        document = {"about": about, "renew": "python test/ros/speed.py --renew", "ratios": ratios}
        REFERENCE.write_text(json.dumps(document, indent=1) + "\n", "utf-8")
        print(f"written to {REFERENCE}")


if __name__ == "__main__":
    main()
