"""A short siege of the node: every message is accounted for, and good frames have their labels.

A sample of benchmarks/siege.py.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))


def test_a_round(live, tmp_path):
    from siege import Siege

    siege = Siege(tmp_path, 7)
    siege.round(30)
    siege.peer.close()
    code, _ = siege.node.stop()
    assert not siege.faults and code == 0
    assert siege.total["good"] == 20 and siege.total["segmented"] > 20 and siege.total["rejected"] > 0


def test_frames_in_work_when_it_is_deactivated_are_counted(live, tmp_path):
    from siege import Siege

    siege = Siege(tmp_path, 8)
    for _ in range(2):
        siege.round(1)
    siege.peer.close()
    assert siege.node.stop()[0] == 0
    assert not siege.faults and siege.total["broken off"] > 0
