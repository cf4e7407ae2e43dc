"""Hostile inputs for a given time: `make fuzz MINUTES=10`, or `python benchmarks/fuzz.py --minutes 10`.

Each target of test/ros/fuzzing.py and fuzzing_results.py gets its turn, in rounds of new examples, within
4 GB of memory beyond what is in use. What fails is made small by hypothesis, printed, and ends the run with
exit code 1.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "ros"))

import fuzzing
import fuzzing_results
from hypothesis import HealthCheck, given, seed, settings

TARGETS = fuzzing.TARGETS | fuzzing_results.TARGETS
MEMORY = 4 << 30


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("targets", nargs="*", choices=[[], *TARGETS], default=[])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0, help="of the first round; each round takes the next")
    options = parser.parse_args()
    warnings.simplefilter("error", RuntimeWarning)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, resource.RLIM_INFINITY))
    end, number = time.monotonic() + 60 * options.minutes, options.seed
    counts: Counter[str] = Counter()
    seconds: Counter[str] = Counter()
    broken: set[str] = set()
    names = options.targets or list(TARGETS)
    while time.monotonic() < end and broken < set(names):
        for name in names:
            if name not in broken and time.monotonic() < end:
                started = time.monotonic()
                counts[name], failed = _round(name, number, counts[name])
                seconds[name] += time.monotonic() - started
                broken |= {name} if failed else set()
        number += 1
    for name in names:
        state = "FAILED" if name in broken else "held"
        print(f"{name:12} {counts[name]:8} examples {seconds[name]:7.0f} s  {state}")
    print(f"{counts.total()} examples, seeds {options.seed} to {number - 1}; {len(broken)} targets failed")
    return 1 if broken else 0


def _round(name: str, number: int, count: int) -> tuple[int, bool]:
    """Some new examples of a target; how many it has had by now, and whether one failed."""
    strategy, take, examples = TARGETS[name]

    def counted(drawn: object) -> None:
        nonlocal count
        count += 1
        take(drawn)

    run = settings(
        max_examples=4 * examples, deadline=None, database=None, suppress_health_check=list(HealthCheck)
    )(seed(number)(given(strategy)(counted)))
    try:
        run()
    except Exception:
        print(f"{name}, seed {number}:")
        traceback.print_exc()
        return count, True
    return count, False


if __name__ == "__main__":
    sys.exit(main())
