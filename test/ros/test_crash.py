"""A replay whose disk, folder or process goes away: one line, exit code 2, and another run completes.

A sample of benchmarks/crash.py.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))


@pytest.fixture(scope="module")
def crash():
    import crash as module

    return module


def test_accidents_are_one_line(crash, tmp_path):
    for name in ("disk full", "output folder removed"):
        folder = tmp_path / name
        folder.mkdir()
        assert not crash.ACCIDENTS[name](folder, 2), name
        assert not [*folder.iterdir()], name


def test_whole_frames_are_counted_wherever_a_file_ends(crash, tmp_path):
    crash.start(crash.BAG, tmp_path / "out", 2).communicate()
    (path,) = crash.left_by(tmp_path)
    content = path.read_bytes()
    cut = tmp_path / "cut.mcap"
    counts = []
    for end in range(0, len(content), len(content) // 40):
        cut.write_bytes(content[:end])
        counts.append(crash.whole_frames(cut))
    assert counts == sorted(counts) and {*counts} <= {0, 1, 2} and crash.whole_frames(path) == 2


def test_after_a_kill_whole_frames_are_left_and_another_run_completes(crash, tmp_path):
    process = crash.start(crash.BAG, tmp_path / "out", 12)
    while process.poll() is None and not any(map(crash.whole_frames, crash.left_by(tmp_path))):
        pass
    process.kill()
    process.communicate()
    assert sum(map(crash.whole_frames, crash.left_by(tmp_path))) >= 1
    assert not crash.completes(crash.BAG, tmp_path, 2)
