"""The first compile of the kernels: once for a machine, up to a minute, announced and never silent.

Numba keeps the compiled code beside the package, or in the user's cache folder where the package cannot be
written (NUMBA_CACHE_DIR names another place).
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from time import perf_counter

import numpy as np

from rcseg_core import PinholeCamera, RangeColorFrame, SegmenterConfig, segment

_PATIENCE_S, _BEAT_S = 3.0, 10.0


def warm_up(config: SegmenterConfig, announce: Callable[[str], None]) -> float:
    """Segment a small scene, so that all kernels are compiled or loaded; return the seconds that it took.

    `announce` is called only when it takes long: the kernels are being compiled then.
    """
    done = threading.Event()
    start = perf_counter()

    def report() -> None:
        if done.wait(_PATIENCE_S):
            return
        announce("Compiling the kernels for this machine: about a minute, only the first time ...")
        while not done.wait(_BEAT_S):
            announce(f"  still compiling, {perf_counter() - start:.0f} s")
        announce(f"  compiled in {perf_counter() - start:.0f} s; kept for the next start")

    reporter = threading.Thread(target=report, daemon=True)
    reporter.start()
    try:
        _ = segment(_small_scene(), config).surfaces
    finally:
        done.set()
        reporter.join()
    return perf_counter() - start


def _small_scene() -> RangeColorFrame:
    """Two walls and a ball of different colours, with noise and a hole: every stage has something to do."""
    rows, cols = np.mgrid[0:96, 0:128]
    depth_m = np.where(cols < 64, 1.5, 1.5 + 0.004 * (cols - 64)).astype(np.float32)
    bulge = 20.0**2 - (rows - 48.0) ** 2 - (cols - 40.0) ** 2
    ball = bulge > 0
    depth_m[ball] -= (0.01 * np.sqrt(bulge[ball])).astype(np.float32)
    noise = np.random.default_rng(0)
    depth_m += noise.normal(0, 0.001, depth_m.shape).astype(np.float32)
    depth_m[80:84, 20:24] = np.nan
    color = np.where(
        ball[..., None], (200, 60, 40), np.where((cols < 64)[..., None], (90, 120, 90), (60, 80, 170))
    )
    color = np.clip(color + noise.normal(0, 2, color.shape), 0, 255).astype(np.uint8)
    return RangeColorFrame.from_depth(depth_m, color, PinholeCamera(110.0, 110.0, 63.5, 47.5))
