"""Which recordings a command names: files, folders, patterns, lists of such in a text file, URLs.

A recording is known by its path, and known again by size, time of change and a digest of the ends of its
files: there lie the header and the index, which tell of every change that a recorder or a copy makes, and a
terabyte is not read to plan a run.
"""

from __future__ import annotations

import glob
import hashlib
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

from rcseg_core.errors import InputError
from rcseg_ros.recordings.layout import METADATA, find_recordings, is_stored_file, stem
from rcseg_ros.tables.extras import need_fsspec

#: Bytes at either end of a file that its digest is of.
END_BYTES = 2**20
_LISTS = (".txt", ".lst", ".list")


@dataclass(frozen=True)
class Source:
    """A recording that was found.

    path : absolute, or a URL
    name : proposed for it; two may have the same
    size, mtime_ns : bytes of all its files, and the last change of one; 0 where a store does not tell
    """

    path: str
    name: str
    size: int
    mtime_ns: int


def find_inputs(inputs: Iterable[str]) -> list[Source]:
    """All recordings that are named, each once, in the order of their paths.

    Raises
    ------
    InputError
        If one of the inputs names nothing, or there is no recording at all.
    """
    found = {source.path: source for text in inputs for source in _listed(text)}
    if not found:
        raise InputError(
            "no recording among the inputs; give .mcap or .db3 files, rosbag2 folders, folders of such, "
            "patterns, URLs, or a .txt file with one of these a line"
        )
    return [found[path] for path in sorted(found)]


def digest(path: str) -> str:
    """Digest of the ends of a recording's files and of their sizes, 32 hexadecimal digits.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    sums = hashlib.blake2b(digest_size=16)
    try:
        for name, size, stream in _streams(path):
            sums.update(f"{name} {size} ".encode())
            sums.update(stream.read(END_BYTES))
            if size > END_BYTES:
                stream.seek(max(END_BYTES, size - END_BYTES))
                sums.update(stream.read(END_BYTES))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    return sums.hexdigest()


@contextmanager
def local_copy(path: str) -> Iterator[Path]:
    """The recording as a local path; one at a URL is copied to a temporary folder while it is used."""
    if not is_url(path):
        yield Path(path)
        return
    store, where = _store(path)
    with TemporaryDirectory(prefix="rcseg-") as folder:
        target = Path(folder) / PurePosixPath(where).name
        try:
            store.get(where, str(target), recursive=store.isdir(where))
        except Exception as error:  # every store has errors of its own
            raise InputError(f"{path}: cannot be read: {' '.join(str(error).split()) or error!r}") from None
        yield target


def is_url(text: str) -> bool:
    """Whether it names something that fsspec opens."""
    return re.match(r"[a-zA-Z][\w+.-]*://", text) is not None


def _listed(text: str) -> list[Source]:
    try:
        return list(_expand(text, Path()))
    except InputError:
        raise
    except RecursionError:
        raise InputError(f"{text}: lists name each other in a circle") from None
    except (OSError, ValueError) as error:  # no text, or names that no file can have
        words = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{text}: cannot be read as a list of recordings: {words}") from None


def _expand(text: str, base: Path) -> Iterator[Source]:
    if is_url(text):
        yield from _expand_url(text)
        return
    path = base / text
    if not path.exists() and glob.has_magic(text):
        matches = sorted(glob.glob(str(path), recursive=True))
        if not matches:
            raise InputError(f"{text}: nothing matches this pattern")
        for match in matches:
            yield from _expand_path(Path(match))
    elif path.suffix in _LISTS and path.is_file():
        lines = (line.strip() for line in path.read_text("utf-8").splitlines())
        for line in lines:
            if line and not line.startswith("#"):
                yield from _expand(line, path.parent)
    elif not path.exists():
        raise InputError(f"{text}: no such file or folder")
    elif path.is_file():
        yield _local(path, stem(path.name))  # whatever it is: why it is none is told when it is read
    else:
        yield from _expand_path(path)


def _expand_path(path: Path) -> Iterator[Source]:
    recordings = find_recordings(path)
    if path.is_dir() and not recordings and any(path.glob("*.bag")):
        recordings = [(path.name, path)]
    for name, one in recordings:
        yield _local(one, name)


def _local(path: Path, name: str) -> Source:
    files = [file.stat() for file in _files(path)]
    size, changed = sum(file.st_size for file in files), max((file.st_mtime_ns for file in files), default=0)
    return Source(str(path.absolute()), name.removesuffix(".bag"), size, changed)


def _files(path: Path) -> list[Path]:
    return [path] if path.is_file() else sorted(file for file in path.iterdir() if file.is_file())


def _streams(path: str) -> Iterator[tuple[str, int, Any]]:
    """Name, size and open stream of each file of a recording."""
    if is_url(path):
        store, where = _store(path)
        for name, about in _listing(store, where):
            with store.open(name, "rb") as stream:
                yield PurePosixPath(name).name, int(about.get("size") or 0), stream
        return
    for file in _files(Path(path)):
        with file.open("rb") as stream:
            yield file.name, file.stat().st_size, stream


def _store(url: str) -> tuple[Any, str]:
    need_fsspec()
    import fsspec

    try:
        store, where = fsspec.core.url_to_fs(url)
    except (ImportError, ValueError) as error:
        raise InputError(f"{url}: {' '.join(str(error).split())}") from None
    return store, where


def _listing(store: Any, where: str) -> list[tuple[str, dict[str, Any]]]:
    if not store.isdir(where):
        return [(where, store.info(where))]
    return sorted(store.find(where, maxdepth=1, detail=True).items())


def _expand_url(url: str) -> Iterator[Source]:
    store, where = _store(url)
    protocol = url.partition("://")[0]
    try:
        roots = sorted(store.glob(where)) if glob.has_magic(where) else [where]
        found = [one for root in roots for one in _recordings_of(store, root)]
    except FileNotFoundError:
        found = []
    except Exception as error:  # no access, no network: every store has errors of its own
        raise InputError(f"{url}: cannot be listed: {' '.join(str(error).split()) or error!r}") from None
    if not found:
        raise InputError(f"{url}: no recording there")
    for one in found:
        sizes = [int(about.get("size") or 0) for _, about in _listing(store, one)]
        yield Source(f"{protocol}://{one.lstrip('/')}", stem(PurePosixPath(one).name), sum(sizes), 0)


def _recordings_of(store: Any, root: str) -> list[str]:
    if store.isfile(root):
        return [root]
    files = [PurePosixPath(file) for file in store.find(root)]
    folders = {file.parent for file in files if file.name == METADATA}
    single = [file for file in files if is_stored_file(Path(file.name)) and file.parent not in folders]
    return sorted(str(one) for one in [*folders, *single])
