"""Which files make a recording, whatever its folder, its metadata.yaml and their names say.

A file is known by its first bytes. Compressed files, and sqlite3 files with changes in a log beside them that
a recorder had no time to write into them, are opened as copies in a temporary folder: a recording is not
changed by being read.
"""

from __future__ import annotations

import re
import shlex
import shutil
import sqlite3
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any

import zstandard

from rcseg_core.errors import InputError
from rcseg_ros.frames.expansion import allowed_bytes, load_yaml
from rcseg_ros.recordings.mcap_file import open_mcap
from rcseg_ros.recordings.sqlite_file import open_sqlite
from rcseg_ros.recordings.storage import StoredFile, one_line

METADATA = "metadata.yaml"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_MCAP_MAGIC, _SQLITE_MAGIC, _ROS1_MAGIC = b"\x89MCAP0\r\n", b"SQLite format 3\x00", b"#ROSBAG V"
_SUFFIXES = (".mcap", ".db3")
_COMPRESSED = (".zstd", ".zst")


@dataclass
class Metadata:
    """What metadata.yaml says of its folder; without one, or with one that cannot be read, nothing."""

    files: list[str] = field(default_factory=list)
    messages: int = 0
    fault: str = ""


def is_stored_file(path: Path) -> bool:
    """Whether the name is one of a file of a recording."""
    name = path.name
    for suffix in _COMPRESSED:
        name = name.removesuffix(suffix)
    return name.endswith(_SUFFIXES)


def stem(name: str) -> str:
    """A file's name without .mcap, .db3 and the like."""
    return re.sub(r"\.(mcap|db3)(\.zstd?)?$", "", name)


def find_recordings(root: Path) -> list[tuple[str, Path]]:
    """Names and paths of the recordings: rosbag2 folders, and .mcap and .db3 files outside of such."""
    if root.is_file():
        return [(stem(root.name), root)] if is_stored_file(root) or root.suffix == ".bag" else []
    if (root / METADATA).exists():
        return [(root.absolute().name, root)]
    if not root.is_dir():
        return []
    folders = {path.parent for path in root.rglob(METADATA)}
    files = [path for path in root.rglob("*") if is_stored_file(path) and path.parent not in folders]
    named = [(folder.relative_to(root).as_posix(), folder) for folder in folders]
    named += [(stem(file.relative_to(root).as_posix()), file) for file in files]
    return sorted(named)


def find_files(path: Path, metadata: Metadata) -> list[Path]:
    """The files of a recording in natural order: 2 before 10.

    Parameters
    ----------
    path : a file, or a folder whose files make one recording
    metadata : what its metadata.yaml says; files that it names count whatever their suffix is

    Raises
    ------
    InputError
        If there is none.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file or folder")
    if path.is_file():
        if not is_stored_file(path) and _kind(path) == "unknown":
            raise InputError(
                f"{path}: not a recording rcseg reads; give an .mcap file or a rosbag2 folder, or a .db3 file"
            )
        return [path]
    files = {file for file in path.iterdir() if file.is_file() and is_stored_file(file)}
    files |= {path / name for name in metadata.files if (path / name).is_file()}
    if not files:
        if bags := sorted(path.glob("*.bag")):
            raise ros1_bag(bags[0])
        if metadata.files:
            raise InputError(f"{path}: no file that {METADATA} names is here: {', '.join(metadata.files)}")
        within = ", ".join(sorted(file.parent.name for file in path.glob(f"*/{METADATA}")))
        hint = f"; give one of the recordings in it: {within}" if within else ""
        raise InputError(f"{path}: neither {METADATA} nor an .mcap or .db3 file in this folder{hint}")
    packed = {file for file in files if file.suffix in _COMPRESSED and file.with_suffix("") in files}
    # Of a file and its packed double the one that metadata.yaml names: a player unpacks beside the original;
    # where none was written a recorder was stopped while it packed.
    doubles = {file.with_suffix("") if file.name in metadata.files else file for file in packed}
    return sorted(files - doubles, key=natural_order)


def left_logs(folder: Path) -> list[str]:
    """Logs of changes whose sqlite3 file has another name by now, or is gone: messages that nobody reads."""
    logs = [file for file in folder.glob("*-wal") if file.stat().st_size]
    return sorted(log.name for log in logs if not log.with_name(log.name.removesuffix("-wal")).exists())


def natural_order(path: Path) -> list[tuple[int, str]]:
    """Key that sorts numbers in names by value."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def read_metadata(folder: Path) -> Metadata:
    """Names of the files and number of the messages, by metadata.yaml; `fault`: why not."""
    file = folder / METADATA
    if not folder.is_dir():
        return Metadata()
    if not file.exists():
        return Metadata(fault=f"no {METADATA} in this folder")
    try:
        about: Any = load_yaml(file.read_text("utf-8"))["rosbag2_bagfile_information"]
        names = [PurePath(str(name)).name for name in about["relative_file_paths"]]
        return Metadata(names, int(about.get("message_count", 0)))
    except Exception as error:  # a recording does not depend on it
        return Metadata(fault=f"{METADATA} cannot be used: {one_line(error)}")


def open_file(path: Path, scratch: Path) -> StoredFile:
    """Open a file of a recording; `scratch`, an empty folder, takes a copy where one is needed.

    Raises
    ------
    InputError
        If it holds what rcseg does not read, or there is no room for the copy.
    """
    kind = _kind(path)
    try:
        if kind == "ros1":
            raise ros1_bag(path)
        if kind == "zstd":
            return _open_packed(path, scratch)
        if kind == "sqlite3" or (kind == "unknown" and path.suffix == ".db3"):
            return open_sqlite(_with_log(path, scratch))
    except OSError as error:
        raise InputError(
            f"{path}: cannot be unpacked to {scratch.parent}: {error.strerror or error}; "
            "set TMPDIR to a folder with more room"
        ) from error
    return open_mcap(path)


def ros1_bag(path: Path) -> InputError:
    """The error for ROS 1 messages, with the command that makes ROS 2 messages of them."""
    # Without the type store camera_info would keep the field names of ROS 1.
    source, target = str(path.with_suffix(".bag")), f"{path.stem}_ros2"
    options = ["--src", source, "--dst", target, "--dst-typestore", "ros2_jazzy"]
    command = shlex.join(["rosbags-convert", *options])
    what = "a ROS 1 bag" if path.suffix == ".bag" else "holds ROS 1 messages; from the .bag it was made of"
    return InputError(f"{path}: {what}; convert it: {command}")


def _kind(path: Path) -> str:
    magics = {"zstd": ZSTD_MAGIC, "ros1": _ROS1_MAGIC, "sqlite3": _SQLITE_MAGIC, "mcap": _MCAP_MAGIC}
    with path.open("rb") as stream:
        head = stream.read(16)
    return next((kind for kind, magic in magics.items() if head.startswith(magic)), "unknown")


def _open_packed(path: Path, scratch: Path) -> StoredFile:
    """A file that was compressed as a whole; of a damaged one what comes before the damage."""
    target, damage, left = scratch / path.with_suffix("").name, "", allowed_bytes(path.stat().st_size)
    with path.open("rb") as packed, target.open("wb") as unpacked:
        try:
            reader = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
            while left > 0 and (block := reader.read(min(left, 2**20))):
                left -= unpacked.write(block)
            if left <= 0:
                damage = "it unpacks to more than its size allows, and was cut off there"
        except zstandard.ZstdError as error:
            damage = one_line(error)
    stored = open_file(target, scratch)
    stored.damage = damage if left <= 0 else stored.damage or damage
    return stored


def _with_log(path: Path, scratch: Path) -> Path:
    """An sqlite3 file with all that was recorded: a copy where changes lie in a file of their own."""
    path = path.resolve()  # sqlite3 keeps its logs beside the file, not beside a link to it
    logs = [path.with_name(path.name + ending) for ending in ("-wal", "-journal")]
    logs = [log for log in logs if log.is_file() and log.stat().st_size]
    if not logs:
        return path
    for file in (path, *logs):
        shutil.copyfile(file, scratch / file.name)
    copy = scratch / path.name
    with suppress(sqlite3.Error), closing(sqlite3.connect(copy)) as base:
        base.execute(
            "PRAGMA journal_mode = DELETE"
        )  # writes the changes into the file, or takes half ones back
        base.execute("SELECT count(*) FROM sqlite_master").fetchall()
    return copy
