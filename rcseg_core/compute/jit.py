"""The Numba decorators of the package: cached, C-like division, no fastmath (NaN marks invalid pixels).

Numba renews a cached kernel when its own file changes, but not when a kernel that it calls, in another file,
does: after an update the old code would run on. So the kernels of a module lie in a folder named after a
digest of the module and of all that it imports from the package, sub-packages and every form of the import
statement included.
"""

import ast
import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, TypeVar, cast

import numba
from numba.core import caching, dispatcher

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
    made: Any = numba.njit(error_model="numpy", nogil=True, **options)(function)
    if isinstance(made, dispatcher.Dispatcher):  # NUMBA_DISABLE_JIT leaves a plain function
        vars(made)["_cache"] = _Kept(function)  # what cache=True does, with a place of our own
    return cast(F, made)


class _Place(caching._CacheLocator):  # type: ignore[misc]
    """Where Numba keeps a kernel, by the contents of its sources alone.

    Numba's own locators tell sources apart by their path and time, so a copy of the package, or a checkout of
    the same commit, would compile all kernels again.
    """

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._py_file = file  # Numba names it in its warnings
        self._line = function.__code__.co_firstlineno
        self._folder = cache_folder(module_name(Path(file)))

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> "_Place":
        return cls(function, file)

    def get_cache_path(self) -> str:
        return self._folder

    def get_source_stamp(self) -> str:
        return Path(self._folder).name

    def get_disambiguator(self) -> str:
        return str(self._line)


class _KeptResult(caching.CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes: ClassVar = [_Place]


class _Kept(caching.FunctionCache):  # type: ignore[misc]
    _impl_class = _KeptResult


#: Name of the package, and of this module below it.
TOP, _, HERE = __name__.partition(".")
PACKAGE = Path(__file__).resolve().parents[HERE.count(".")]
#: Modules of the package that hold no kernel and no constant of one.
APART = frozenset({"config", "errors", "frame"})


def module_name(file: Path) -> str:
    """Name of a module below the package, "signal.noise"; the name alone of a file that lies elsewhere."""
    if not file.resolve().is_relative_to(PACKAGE):
        return file.stem
    parts = file.resolve().relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _file(module: str) -> Path | None:
    """Source of a module of the package or, for a package ("" is the whole), of its ``__init__``."""
    place = PACKAGE.joinpath(*module.split(".")) if module else PACKAGE
    for path in (place / "__init__.py", *([place.with_suffix(".py")] if module else [])):
        if path.is_file():
            return path
    return None


def _statements(block: ast.AST) -> Iterator[ast.AST]:
    """All statements in a block, those of its inner blocks included; expressions hold no import."""
    for part in ("body", "orelse", "finalbody", "handlers", "cases"):
        for node in getattr(block, part, ()):
            yield node
            yield from _statements(node)


@cache
def _imports(source: bytes, package: str) -> frozenset[str]:
    """All that a source imports from the rcseg package, as names below it ("" for the package itself).

    Wherever a statement stands and whatever its form; a name may turn out to be none of a module. What comes
    from a package may be defined in its ``__init__`` or be a module of it, so both are named; with ``*`` all
    of its modules. Imports that are computed (importlib) cannot be seen.

    Parameters
    ----------
    package : the one that relative imports start from
    """
    found: set[str] = set()
    for node in _statements(ast.parse(source)):
        if isinstance(node, ast.Import):
            for alias in node.names:  # without `as` it is the whole package that gets a name
                found |= {alias.name} if alias.asname else {alias.name, alias.name.partition(".")[0]}
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".") if node.level else []
            base = ".".join([*parts[: len(parts) + 1 - node.level], *filter(None, [node.module])])
            found |= {base} | {f"{base}.{alias.name}" for alias in node.names}
    return frozenset(name[len(TOP) + 1 :] for name in found if f"{name}.".startswith(f"{TOP}."))


def sources(module: str) -> list[Path]:
    """The files that the kernels of a module of this package may depend on, sorted; itself among them.

    module : its name below the package, "moments" or "signal.noise"
    """
    seen: set[str] = set()
    waiting = {module, HERE}
    files = set()
    while waiting:
        name = waiting.pop()
        seen.add(name)
        if name.endswith("*"):
            place = PACKAGE.joinpath(*name.split(".")[:-1])
            beside = [*place.glob("*.py"), *place.glob("*/__init__.py")]
            waiting |= {module_name(path) for path in beside} - seen - APART
            continue
        path = _file(name)
        if path is None:
            continue
        files.add(path)
        parts = [TOP, *filter(None, name.split("."))]
        package = ".".join(parts if path.name == "__init__.py" else parts[:-1])
        waiting |= _imports(path.read_bytes(), package) - seen - APART
    return sorted(files)


@cache
def cache_folder(module: str) -> str:
    """Where the compiled kernels of exactly these sources of a module are kept.

    In NUMBA_CACHE_DIR if that is set, else beside the package, else (read-only installation) in the user's
    cache folder, else in a temporary one. Folders of earlier sources beside the package are removed.
    """
    digest = hashlib.sha256(numba.__version__.encode())  # two versions would write over each other's index
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
