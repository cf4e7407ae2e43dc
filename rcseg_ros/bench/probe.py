"""One frame in a fresh process: how long until its labels, and how much memory that takes.

The bench starts this file as `python -m rcseg_ros.bench.probe FRAME.npz CONFIG.json` and reads one line of
JSON. The kernel's high-water mark of this address space is read rather than getrusage's, which a child
inherits from the process that started it.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

STATUS = Path("/proc/self/status")


def peak_mb() -> float:
    """Highest resident memory of this process so far, MB; NaN where the system does not tell."""
    if not STATUS.exists():
        return float("nan")
    for line in STATUS.read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) / 1024
    return float("nan")


def probe(frame_path: Path, config_path: Path) -> dict[str, float]:
    """Import, read the frame, segment it twice; seconds and MB of each step."""
    start = time.perf_counter()
    from rcseg_core import SegmenterConfig, segment
    from rcseg_core.datasets import load_frame

    imported = time.perf_counter()
    config = SegmenterConfig.from_dict(json.loads(config_path.read_text("utf-8")))
    frame = load_frame(frame_path).frame
    before_mb, before = peak_mb(), time.perf_counter()
    segment(frame, config)
    labels_at = time.time()
    first = time.perf_counter()
    segment(frame, config)
    return {
        "labels_at": labels_at,
        "import_s": imported - start,
        "first_segment_s": first - before,
        "second_segment_s": time.perf_counter() - first,
        "memory_before_mb": before_mb,
        "memory_added_mb": peak_mb() - before_mb,
    }


def fresh_process(frame_path: Path, config_path: Path, *, cold: bool = False) -> dict[str, float]:
    """`probe` in a new process; `start_to_labels_s` is the time from starting Python to the first labels.

    Parameters
    ----------
    cold : with an empty cache of compiled kernels, which then takes about a minute
    """
    command = [sys.executable, "-m", "rcseg_ros.bench.probe", str(frame_path), str(config_path)]
    with tempfile.TemporaryDirectory() as cache:
        environment = {**os.environ, "NUMBA_CACHE_DIR": cache} if cold else None
        start = time.time()
        run = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    figures: dict[str, float] = json.loads(run.stdout.splitlines()[-1])
    return {"start_to_labels_s": figures.pop("labels_at") - start, **figures}


if __name__ == "__main__":
    print(json.dumps(probe(Path(sys.argv[1]), Path(sys.argv[2]))))
