"""An output folder that appears whole or not at all: written beside its place, moved there at the end."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from types import TracebackType

from rcseg_core.errors import InputError


class StagedFolder:
    """Context manager; write into `path`, then `commit`. Without commit nothing is left.

    Parameters
    ----------
    target : where the folder shall appear; its parent must exist
    force : replace an earlier result of rcseg there; anything else is never removed
    marker : file by which an earlier result is known

    Raises
    ------
    InputError
        If the target exists, or cannot be made.
    """

    def __init__(self, target: Path, force: bool, marker: str) -> None:
        self.target = target.absolute()
        self._check_free(force, marker)
        try:
            self._scratch = Path(tempfile.mkdtemp(prefix=f".{self.target.name}.", dir=self.target.parent))
        except OSError as error:
            raise InputError(f"{target}: cannot write there: {error.strerror}") from None
        #: The folder to write; its maker creates it.
        self.path = self._scratch / self.target.name

    def _check_free(self, force: bool, marker: str) -> None:
        target = self.target
        if not target.parent.is_dir():
            raise InputError(f"{target}: cannot write there: {target.parent} is not a folder")
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
            self.target.rename(self._scratch / "replaced")
        self.path.rename(self.target)

    def __enter__(self) -> StagedFolder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        shutil.rmtree(self._scratch, ignore_errors=True)
