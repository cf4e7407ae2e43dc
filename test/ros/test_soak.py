"""The soak's straight line and its interval, and a short soak of the Python API.

A sample of benchmarks/soak.py.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

import soak


def noise(rng, count, alike):
    """First-order autoregressive noise of variance 1."""
    steps = rng.normal(0, np.sqrt(1 - alike**2), count)
    values = np.empty(count)
    values[0] = rng.normal()
    for i in range(1, count):
        values[i] = alike * values[i - 1] + steps[i]
    return values


@pytest.mark.parametrize("alike", [0.0, 0.8])
def test_the_interval_holds_the_true_slope_as_often_as_it_says(alike):
    rng, frames, slope, held = np.random.default_rng(1), np.arange(300.0), 1e-3, 0
    for _ in range(400):
        line = soak.straight_line(frames, 200 + slope * frames + noise(rng, 300, alike))
        held += abs(line.slope - slope) <= line.error
    assert 0.90 <= held / 400 <= 0.99


def test_a_leak_is_a_fault_and_a_flat_run_is_none():
    rng = np.random.default_rng(0)
    for leak_mb, faulty in ((5e-4, True), (0.0, False)):
        seen = soak.Soak(20_000)
        frames = np.arange(0, 20_000, 20)
        flat = np.full(1000, 7.0)
        seen.samples[:] = np.c_[frames, 300 + leak_mb * frames + rng.normal(0, 0.2, 1000), flat, flat]
        seen.milliseconds[:] = 10.0
        text, faults = soak.judge("python", seen)
        assert bool(faults) == faulty, text


def test_threads_that_become_more_are_a_fault():
    seen = soak.Soak(1000)
    frames = np.arange(1000)
    seen.samples[:] = np.c_[frames, np.full(1000, 300.0), 5 + frames // 100, np.full(1000, 9)]
    seen.milliseconds[:] = 1.0
    assert soak.judge("node", seen)[1] == ["node: threads become more"]


def test_a_short_soak_of_the_python_api(tmp_path):
    seen = soak.soak_python(100, 64, 48)
    assert np.isfinite(seen.milliseconds).all() and np.isfinite(seen.samples).all()
    assert not soak.judge("python", seen)[1]
    soak.draw({"python": seen}, tmp_path / "soak.png")
    assert (tmp_path / "soak.png").stat().st_size > 10_000
