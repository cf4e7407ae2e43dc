"""An output folder that appears whole or not at all: written beside its place, moved there at the end."""

from __future__ import annotations

import errno
import fcntl
import glob
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType

from rcseg_core.errors import InputError

_REPLACED = "replaced"  # name of an earlier result while the new one takes its place


class StagedFolder:
    """Context manager; write into `path`, then `commit`. Without commit nothing is left.

    Parameters
    ----------
    target : where the folder shall appear; folders above it are made, and kept only with it
    force : replace an earlier result of rcseg there; anything else is never removed
    marker : file by which an earlier result is known

    Raises
    ------
    InputError
        If the target exists, or cannot be made; at the end, if something could not be written.
    """

    def __init__(self, target: Path, force: bool, marker: str) -> None:
        self.target = target.absolute()
        _clear_dead(self.target)
        self._check_free(force, marker)
        self._made = [folder for folder in self.target.parents if not folder.exists()]
        try:
            self.target.parent.mkdir(parents=True, exist_ok=True)
            self._scratch = Path(tempfile.mkdtemp(prefix=f".{self.target.name}.", dir=self.target.parent))
            self._held = _hold(self._scratch)
        except OSError as error:
            raise InputError(f"{target}: cannot write there: {error.strerror}") from None
        #: The folder to write; its maker creates it.
        self.path = self._scratch / self.target.name

    def _check_free(self, force: bool, marker: str) -> None:
        target = self.target
        check_place(target)
        if not target.exists() and not target.is_symlink():
            return
        if not target.is_dir() or target.is_symlink():
            raise InputError(f"{target}: is a file; name a folder that does not exist yet")
        ours = (target / marker).is_file() or not any(target.iterdir())
        if not ours:
            raise InputError(f"{target}: exists and is no result of rcseg; name another folder")
        if not force:
            raise InputError(f"{target}: exists already; name another folder, or replace it with --force")

    def commit(self) -> None:
        """Move the finished folder to its place."""
        if self.target.exists():
            self.target.rename(self._scratch / _REPLACED)
        self.path.rename(self.target)

    def __enter__(self) -> StagedFolder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        shutil.rmtree(self._scratch, ignore_errors=True)
        os.close(self._held)
        with suppress(OSError):  # not empty: the result is in it, or something else by now
            for folder in self._made:
                folder.rmdir()
        if isinstance(value, OSError):  # a full disk, or the folder was taken away
            raise InputError(f"{self.target}: cannot write there: {value.strerror or value}") from value


@contextmanager
def staged(target: Path | None, force: bool, marker: str) -> Iterator[StagedFolder | None]:
    """A StagedFolder, or None where nothing is to be written."""
    if target is None:
        yield None
        return
    with StagedFolder(target, force, marker) as folder:
        yield folder


def check_place(target: Path) -> None:
    """Refuse a path below something that is no folder, or below one that may not be written.

    Raises
    ------
    InputError
    """
    above = next(folder for folder in target.absolute().parents if folder.exists())
    if not above.is_dir():
        raise InputError(f"{target}: cannot write there: {above} is not a folder")
    if not os.access(above, os.W_OK | os.X_OK):
        raise InputError(f"{target}: cannot write there: {os.strerror(errno.EACCES)}")


def _hold(folder: Path) -> int:
    """Lock a folder as long as this process lives; the open descriptor.

    Raises
    ------
    OSError
        Another process holds it.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def _clear_dead(target: Path) -> None:
    """Remove what runs to the same place left there when they were killed; an earlier result is put back."""
    for folder in target.parent.glob(f".{glob.escape(target.name)}.????????"):
        with suppress(OSError):
            if {path.name for path in folder.iterdir()} <= {target.name, _REPLACED}:
                held = _hold(folder)
                if (folder / _REPLACED).exists() and not target.exists():
                    (folder / _REPLACED).rename(target)
                shutil.rmtree(folder, ignore_errors=True)
                os.close(held)
