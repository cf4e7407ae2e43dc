"""A long compile is announced while it lasts; a warm start says nothing."""

import time

from rcseg_core import SegmenterConfig
from rcseg_ros import warmup


def run(monkeypatch, seconds):
    frames, said = [], []

    def slow(frame, config):
        frames.append(frame)
        time.sleep(seconds)

    monkeypatch.setattr(warmup, "segment", slow)
    monkeypatch.setattr(warmup, "_PATIENCE_S", 0.1)
    monkeypatch.setattr(warmup, "_BEAT_S", 0.1)
    took = warmup.warm_up(SegmenterConfig(), said.append)
    (frame,) = frames
    assert took >= seconds and frame.valid.any() and not frame.valid.all()
    return said


def test_a_long_compile_is_announced_and_goes_on_being_told(monkeypatch):
    said = run(monkeypatch, 0.5)
    assert said[0].startswith("Compiling the kernels")
    assert len(said) >= 4 and "still compiling" in said[1] and "compiled in" in said[-1]


def test_a_warm_start_is_silent(monkeypatch):
    assert run(monkeypatch, 0.0) == []
