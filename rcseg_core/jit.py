"""The Numba decorators of the package: cached, C-like division, no fastmath (NaN marks invalid pixels).

Numba renews a cached kernel when its own file changes, but not when a kernel that it calls, in another file,
does: after an update the old code would run on. So the kernels of a module lie in a folder named after a
digest of the module and of all that it imports from the package.
"""

import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba

F = TypeVar("F", bound=Callable[..., Any])

#: Numba's private switch for its counting runtime, as an option of njit.
UNCOUNTED = {"_nrt": False}


def kernel(function: F) -> F:
    """Compile `function` once and keep the result on disk; arrays in, arrays out, no Python objects."""
    return compiled(function)


def bare(function: F) -> F:
    """Like `kernel` for code that allocates nothing, without reference counts.

    Numba counts a reference, atomically, for every array that is taken out of a structure; on the small
    bodies of the grouping loop that is most of the time. Without the counting runtime such a function must
    get all of its arrays from its caller. The switch is private to Numba (all releases from 0.59 on have it):
    where it is gone, this is `kernel`, slower with the same results.
    """
    return compiled(function, **(UNCOUNTED if HAS_SWITCH else {}))


def compiled(function: F, **options: Any) -> F:
    """`function` compiled with the options that all kernels share, and more."""
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = cache_folder(Path(function.__code__.co_filename).stem)
    try:
        made: F = numba.njit(cache=True, error_model="numpy", nogil=True, **options)(function)
    finally:
        numba.config.CACHE_DIR = before
    return made


PACKAGE = Path(__file__).resolve().parent
#: Modules of the package that hold no kernel and no constant of one.
APART = frozenset({"config", "errors", "frame"})


def sources(module: str) -> list[Path]:
    """The files that the kernels of a module of this package may depend on, sorted; itself among them."""
    seen: set[str] = set()
    waiting = {module, "jit"}
    while waiting:
        name = waiting.pop()
        seen.add(name)
        path = PACKAGE / f"{name}.py"
        if path.exists():
            imported = re.findall(r"^from rcseg_core\.(\w+) import", path.read_text("utf-8"), re.MULTILINE)
            waiting |= set(imported) - seen - APART
    return sorted(p for p in (PACKAGE / f"{name}.py" for name in seen) if p.exists())


@cache
def cache_folder(module: str) -> str:
    """Where the compiled kernels of exactly these sources of a module are kept.

    In NUMBA_CACHE_DIR if that is set, else beside the package, else (read-only installation) in the user's
    cache folder, else in a temporary one. Folders of earlier sources beside the package are removed.
    """
    digest = hashlib.sha256()
    for source in sources(module):
        digest.update(source.read_bytes())
    name = f"kernels-{module}-{digest.hexdigest()[:16]}"
    home = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) / "rcseg"
    named = os.environ.get("NUMBA_CACHE_DIR")
    for parent in [Path(named)] if named else [PACKAGE / "__pycache__", home]:
        try:
            folder = parent / name
            folder.mkdir(parents=True, exist_ok=True)
            if os.access(folder, os.W_OK):
                if parent == PACKAGE / "__pycache__":
                    for old in set(parent.glob(f"kernels-{module}-*")) - {folder}:
                        shutil.rmtree(old, ignore_errors=True)
                return str(folder)
        except (OSError, RuntimeError):
            continue
    return tempfile.mkdtemp(prefix="rcseg-kernels-")


def knows(options: dict[str, Any]) -> bool:
    """Whether this Numba takes these options; njit itself would only complain at the first call."""
    try:
        from numba.core.compiler import Flags
        from numba.core.registry import cpu_target

        cpu_target.options.parse_as_flags(Flags(), options)
    except (ImportError, AttributeError, KeyError, TypeError):
        return False
    return True


HAS_SWITCH = knows(UNCOUNTED)
