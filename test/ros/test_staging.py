"""Results appear whole or not at all, whatever ends the run that makes them."""

from __future__ import annotations

import subprocess
import sys

import pytest

from rcseg_core.errors import InputError
from rcseg_ros.recordings.staging import StagedFolder

KILLED = """
import os, sys
from pathlib import Path
from rcseg_ros.recordings.staging import StagedFolder
stage = StagedFolder(Path(sys.argv[1]), True, "marker")
stage.path.mkdir()
(stage.path / "new").touch()
if sys.argv[2] == "late":
    stage.target.rename(stage.path.parent / "replaced")
os._exit(9)
"""


def _killed(target, when):
    subprocess.run([sys.executable, "-c", KILLED, str(target), when], check=False, timeout=60)


def _result(target):
    with StagedFolder(target, True, "marker") as stage:
        stage.path.mkdir()
        (stage.path / "marker").touch()
        stage.commit()


def test_what_a_killed_run_left_is_removed_by_the_next(tmp_path):
    _killed(tmp_path / "out", "early")
    assert len(list(tmp_path.glob(".out.*"))) == 1
    _result(tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_kill_while_a_result_takes_the_place_of_another_loses_neither(tmp_path):
    _result(tmp_path / "out")
    _killed(tmp_path / "out", "late")
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="exists already"):
        StagedFolder(tmp_path / "out", False, "marker")
    assert (tmp_path / "out" / "marker").exists() and not list(tmp_path.glob(".out.*"))


def test_what_another_process_writes_and_what_is_not_ours_stays(tmp_path):
    other = tmp_path / ".out.notebook"
    other.mkdir()
    (other / "mine").touch()
    with StagedFolder(tmp_path / "out", False, "marker") as first:
        first.path.mkdir()
        _result(tmp_path / "out")
        assert first.path.exists()
    assert (other / "mine").exists()


def test_an_error_of_writing_names_the_place(tmp_path):
    with (
        pytest.raises(InputError, match=r"out: cannot write there: No space left"),
        StagedFolder(tmp_path / "out", False, "marker"),
    ):
        raise OSError(28, "No space left on device")
    assert not list(tmp_path.iterdir())
