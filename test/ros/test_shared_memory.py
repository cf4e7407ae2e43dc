"""Segments of killed processes are given back; what a living one uses is never touched."""

from __future__ import annotations

import contextlib
import fcntl
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rcseg_ros.live import shared_memory
from rcseg_ros.live.shared_memory import SHARED_MEMORY, clear_dead_segments, clear_own_segments

NAME = "fastrtps_0123456789abcdef"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with one segment of 4096 bytes that nobody holds, its files as old as can be."""
    monkeypatch.setattr(shared_memory, "YOUNG_S", -1.0)
    (tmp_path / NAME).write_bytes(bytes(4096))
    (tmp_path / f"{NAME}_el").touch()
    return tmp_path


def test_what_nobody_holds_is_removed(folder):
    assert clear_dead_segments(folder) == 4096
    assert not list(folder.iterdir())


@pytest.mark.parametrize("how", [fcntl.LOCK_EX, fcntl.LOCK_SH])
def test_what_is_held_stays(folder, how):
    with (folder / f"{NAME}_el").open("ab") as held:
        fcntl.flock(held, how)
        assert clear_dead_segments(folder) == 0
        assert len(list(folder.iterdir())) == 2
    assert clear_dead_segments(folder) == 4096


def test_what_is_young_may_be_about_to_be_locked(folder, monkeypatch):
    monkeypatch.setattr(shared_memory, "YOUNG_S", 60.0)
    assert clear_dead_segments(folder) == 0 and len(list(folder.iterdir())) == 2


def test_other_names_stay(folder):
    others = ["fastrtps_port7411", "fastrtps_port7411_el", "sem.fastrtps_port7411_mutex", "fastrtps_other_el"]
    others += ["fastrtps_0123456789abcdeg_el", "x_fastrtps_0123456789abcdef_el", "fastrtps_fedcba9876543210"]
    for name in others:
        (folder / name).touch()
    clear_dead_segments(folder)
    assert sorted(path.name for path in folder.iterdir()) == sorted(others)


def test_a_link_is_not_followed(folder, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "precious"
    elsewhere.write_bytes(b"x")
    (folder / f"{NAME}_el").unlink()
    (folder / f"{NAME}_el").symlink_to(elsewhere)
    assert clear_dead_segments(folder) == 0
    assert elsewhere.read_bytes() == b"x"


def test_half_of_a_pair_and_an_absent_folder_are_no_error(folder):
    (folder / NAME).unlink()
    assert clear_dead_segments(folder) == 0
    assert clear_dead_segments(folder / "absent") == 0


def test_own_segments_are_those_that_this_process_holds_locked(folder):
    other = "fastrtps_fedcba9876543210"
    (folder / other).touch()
    with (folder / f"{NAME}_el").open("ab") as held, (folder / f"{other}_el").open("ab"):
        fcntl.flock(held, fcntl.LOCK_EX)
        assert clear_own_segments(folder) == 4096
    assert sorted(path.name for path in folder.iterdir()) == [other, f"{other}_el"]


# Live.


def _held_by(pid: int) -> set[str]:
    """Segments whose lock files a process has open."""
    names = set()
    for link in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(OSError):
            names.add(Path(os.readlink(link)).name)
    return {name.removesuffix("_el") for name in names if shared_memory._SEGMENT_LOCK.fullmatch(name)}


def _there(names: set[str]) -> set[str]:
    return {name for name in names if (SHARED_MEMORY / name).exists()}


def _large(names: set[str]) -> bool:
    return any((SHARED_MEMORY / name).stat().st_size > 100e6 for name in _there(names))


def test_the_segment_of_a_killed_node_is_gone_after_the_next_start(live, tmp_path):
    parameters, remaps = {"autostart": False, "no.such": 1}, {"__node": "killed"}
    killed = live.NodeProcess(tmp_path / "killed.txt", parameters, remaps)
    killed.wait_for_output("unknown parameter")
    names = _held_by(killed.process.pid)
    assert _large(names), "the profile for large messages was meant to be in force"
    time.sleep(shared_memory.YOUNG_S)
    killed.process.kill()
    killed.process.wait()
    assert _there(names) == names, "a killed process cannot clean up"
    following = live.NodeProcess(tmp_path / "following.txt", parameters, remaps)
    following.wait_for_output("unknown parameter")
    assert not _there(names)
    own = _held_by(following.process.pid)
    assert _large(own)
    clear_dead_segments()
    assert _there(own) == own, "a living node's"
    assert following.stop()[0] == 0
    assert not _there(own)


STUCK = """
import os, threading, time
from rcseg_ros import node
def forever(config, announce):
    print("in work", flush=True)
    time.sleep(600)
node.warm_up = forever
node.main()
"""


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_a_node_that_ends_in_mid_transition_leaves_nothing(live, how):
    process = subprocess.Popen(
        [sys.executable, "-c", STUCK], env=live.environment(), text=True, start_new_session=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    assert any("in work" in line for line in process.stdout)
    names = _held_by(process.pid)
    assert _large(names)
    process.send_signal(how)
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 0 and "Traceback" not in output, output
    assert not _there(names)


def test_a_peer_that_was_closed_leaves_nothing(live):
    before = _held_by(os.getpid())
    peer = live.Peer("nobody", ())
    names = _held_by(os.getpid()) - before
    assert names
    peer.close()
    assert not _there(names)
