"""`rcseg replay` that is killed, or whose disk, folder or input goes away.

    python benchmarks/crash.py [--kills 50] [--frames 8]

What is left is whole, the exit code and one line say what happened, and another run completes and leaves
nothing else. Exit code 1 where one case is not as promised. Frames that are left are read by mcap's own
stream reader and decoded by rosbags.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import random
import resource
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from mcap.exceptions import EndOfFile
from mcap.records import Message
from mcap.stream_reader import StreamReader
from rosbags.rosbag2 import Reader
from zstandard import ZstdError

from rcseg_ros.recordings.result_bag import result_types

ROOT = Path(__file__).resolve().parents[1]
BAG = ROOT / "bags" / "tabletop"
_PR_CAPBSET_DROP = 24  # linux/prctl.h
LABELS, LABELS_TYPE = "/rcseg/labels", "sensor_msgs/msg/Image"


def command(bag: Path, out: Path, frames: int) -> list[str]:
    options = ["-o", str(out), "--max-frames", str(frames), "--preset", "fast", "--force"]
    return [sys.executable, "-m", "rcseg_ros.cli", "replay", str(bag), *options]


def start(
    bag: Path, out: Path, frames: int, before: Callable[[], None] | None = None
) -> subprocess.Popen[str]:
    return subprocess.Popen(
        command(bag, out, frames), cwd=ROOT, start_new_session=True, preexec_fn=before, text=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
    )  # fmt: skip


def whole_frames(path: Path) -> int:
    """Label images in an mcap, however it ends; each must decode."""
    count = 0
    with path.open("rb") as stream:
        channels: dict[int, str] = {}
        try:
            for record in StreamReader(stream, validate_crcs=True).records:
                if hasattr(record, "topic"):
                    channels[record.id] = record.topic
                elif isinstance(record, Message) and channels[record.channel_id] == LABELS:
                    image = result_types().deserialize_cdr(record.data, LABELS_TYPE)
                    assert len(image.data) == image.height * image.step
                    count += 1
        except (EndOfFile, ZstdError, struct.error):  # mcap's reader takes what is cut for whole
            pass
    return count


def finished_frames(out: Path) -> int:
    """Label images in a finished result, read by rosbags."""
    with Reader(out) as reader:
        connections = [c for c in reader.connections if c.topic == LABELS]
        return sum(1 for _ in reader.messages(connections))


def left_by(folder: Path) -> list[Path]:
    return [*folder.glob(".out.*/out/*.mcap"), *folder.glob("out/*.mcap")]


def told(process: subprocess.Popen[str], timeout_s: float = 300.0) -> str:
    """What is wrong with how it ended, where it is to be exit code 2 and one line."""
    _, error = process.communicate(timeout=timeout_s)
    lines = [line for line in error.splitlines() if line.startswith("rcseg: ")]
    if process.returncode != 2 or len(lines) != 1 or "Traceback" in error:
        return f"exit code {process.returncode}: {error.strip()[-300:]}"
    print(f"    {lines[0]}")
    return ""


def completes(bag: Path, folder: Path, frames: int) -> str:
    """What is wrong with a run after the accident."""
    done = subprocess.run(command(bag, folder / "out", frames), cwd=ROOT, capture_output=True, text=True)
    if done.returncode != 0:
        return f"the second run ended with {done.returncode}: {done.stderr[-300:]}"
    if finished_frames(folder / "out") != frames:
        return "the second run is not complete"
    hidden = [path.name for path in folder.glob(".out.*")]
    return f"left behind: {hidden}" if hidden else ""


def killed(folder: Path, frames: int, moment_s: float) -> str:
    process = start(BAG, folder / "out", frames)
    time.sleep(moment_s)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    counts = [whole_frames(path) for path in left_by(folder)]
    print(f"    after {moment_s:.2f} s: {counts or 'no'} whole frames left")
    return ""


def full_disk(folder: Path, frames: int) -> str:
    """No file may grow beyond 300 kB, which is what a full disk says too."""

    def bound() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))

    return told(start(BAG, folder / "out", frames, bound))


def no_output_folder(folder: Path, frames: int) -> str:
    """It is removed as soon as something is in it."""
    process = start(BAG, folder / "out", frames)
    while process.poll() is None and not list(folder.glob(".out.*/out/*.mcap")):
        time.sleep(0.01)
    for hidden in folder.glob(".out.*"):
        shutil.rmtree(hidden, ignore_errors=True)
    return told(process)


def vanishing_input(folder: Path, frames: int) -> str:
    """The recording is emptied while it is read."""
    bag = folder / "in"
    shutil.copytree(BAG, bag)
    process = start(bag, folder / "out", frames)
    while process.poll() is None and not list(folder.glob(".out.*/out/*.mcap")):
        time.sleep(0.01)
    for file in bag.glob("*.mcap"):
        file.write_bytes(b"")
    _, error = process.communicate(timeout=300)
    shutil.rmtree(bag)
    return f"exit code {process.returncode}: {error[-300:]}" if "Traceback" in error else ""


def unreadable_input(folder: Path, frames: int) -> str:
    bag = folder / "in"
    (bag / "a.mcap").mkdir(parents=True)
    fault = told(start(bag, folder / "out", frames))
    shutil.rmtree(bag)
    return fault


def as_users_are() -> None:
    """In the child: root may not pass over permissions either."""
    if os.geteuid() == 0:
        libc = ctypes.CDLL(None, use_errno=True)
        for capability in (1, 2):  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH
            if libc.prctl(_PR_CAPBSET_DROP, capability, 0, 0, 0):
                raise OSError(ctypes.get_errno(), "prctl")


def permission_lost(folder: Path, frames: int) -> str:
    """The folder of the results becomes read-only while they are written."""
    process = start(BAG, folder / "out", frames, as_users_are)
    while process.poll() is None and not list(folder.glob(".out.*/out/*.mcap")):
        time.sleep(0.01)
    folder.chmod(0o555)
    fault = told(process)
    folder.chmod(0o755)
    return fault


def no_permission(folder: Path, frames: int) -> str:
    """The recording may not be read."""
    bag = folder / "in"
    shutil.copytree(BAG, bag)
    for file in bag.iterdir():
        file.chmod(0)
    fault = told(start(bag, folder / "out", frames, as_users_are))
    shutil.rmtree(bag)
    return fault


ACCIDENTS = {
    "disk full": full_disk,
    "output folder removed": no_output_folder,
    "input vanishes": vanishing_input,
    "input unreadable": unreadable_input,
    "permission lost": permission_lost,
    "no permission": no_permission,
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng, faults = random.Random(options.seed), []
    with tempfile.TemporaryDirectory() as name:
        started = time.monotonic()
        faults += _judged("a first run", completes(BAG, Path(name), options.frames))
        length_s = time.monotonic() - started
    for accident in ACCIDENTS:
        with tempfile.TemporaryDirectory() as name:
            faults += _judged(accident, ACCIDENTS[accident](Path(name), options.frames))
            faults += _judged(f"{accident}, again", completes(BAG, Path(name), options.frames))
    for number in range(options.kills):
        with tempfile.TemporaryDirectory() as name:
            killed(Path(name), options.frames, rng.uniform(0.2, 1.1) * length_s)
            faults += _judged(f"kill {number + 1}", completes(BAG, Path(name), options.frames))
    print(f"{options.kills} kills and {len(ACCIDENTS)} accidents: {len(faults)} faults")
    return 1 if faults else 0


def _judged(what: str, fault: str) -> list[str]:
    print(f"{what}: {fault or 'as promised'}", flush=True)
    return [fault] if fault else []


if __name__ == "__main__":
    sys.exit(main())
