"""A recording that is cut off gives all messages before the cut: a sample of benchmarks/truncation.py."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from rcseg_ros.recordings.bag import Recording

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))


@pytest.fixture(scope="module")
def truncation():
    import truncation as module

    return module


def test_whatever_is_before_the_cut_comes_out(truncation, tmp_path):
    """Each end of a chunk and the bytes around it, the head of the file, and every 40th kilobyte."""
    cutter = truncation.Cutter(truncation.BAG, tmp_path)
    ends = {end + by for end in cutter._ends for by in (-1, 0, 1)}
    lengths = sorted(
        {*range(0, 400, 7), *range(0, cutter.size, 40_009), cutter.size - 1, *ends}, reverse=True
    )
    assert not [fault for fault in map(cutter.fault, lengths) if fault]


def test_the_oracle_knows_all_messages(truncation):
    with Recording(truncation.BAG) as recording:
        count = sum(topic.count for topic in recording.topics.values())
    assert sum(len(messages) for _, messages in truncation.whole_messages(truncation.BAG)) == count > 20
