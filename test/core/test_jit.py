"""The cache of compiled kernels follows the sources that a kernel depends on."""

import importlib
import os
import re
import shutil
import subprocess
import sys

import pytest

from rcseg_core.compute import jit

MODULES = sorted(
    jit.module_name(p)
    for p in jit.PACKAGE.rglob("*.py")
    if re.search(r"^@(jit\.)?(bare|kernel)$", p.read_text("utf-8"), re.MULTILINE)
)


def test_there_are_modules_with_kernels():
    assert {"models.moments", "decision.evidence", "graph.grouping", "partition.seeds"} <= set(MODULES)


def test_a_kernel_depends_on_the_modules_whose_kernels_it_calls():
    names = {p.stem for p in jit.sources("graph.grouping")}
    assert {"grouping", "evidence", "planes", "moments", "signals", "noise", "jit"} <= names
    assert "seeds" not in names and "config" not in names


def test_a_change_in_an_imported_module_moves_the_cache(tmp_path, monkeypatch):
    for name in ("moments", "evidence", "jit"):
        text = "from rcseg_core.moments import solve\n" if name == "evidence" else "x = 1\n"
        (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.setattr(jit, "PACKAGE", tmp_path)
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    before = {m: jit.cache_folder.__wrapped__(m) for m in ("moments", "evidence")}
    (tmp_path / "moments.py").write_text("x = 2\n")
    after = {m: jit.cache_folder.__wrapped__(m) for m in ("moments", "evidence")}
    assert all(before[m] != after[m] for m in before)
    assert len(list((tmp_path / "__pycache__").glob("kernels-*"))) == 2  # the old ones are gone
    (tmp_path / "evidence.py").write_text("from rcseg_core.moments import solve\ny = 3\n")
    assert jit.cache_folder.__wrapped__("moments") == after["moments"]


#: Every way to get at a name of signal/noise.py, from a module beside the sub-package or inside it.
FORMS = {
    "kernels": [
        "from rcseg_core.signal.noise import law",
        "from rcseg_core.signal import noise",
        "import rcseg_core.signal.noise",
        "import rcseg_core.signal.noise as n",
        "import numpy, rcseg_core.signal.noise as n",
        "from .signal.noise import law",
        "from .signal import noise",
        "from . import signal",
        "from rcseg_core import signal",
        "import rcseg_core",
        "from rcseg_core.signal import *",
        "from rcseg_core import (\n    signal,\n)",
        "if True:\n    from rcseg_core.signal.noise import law",
        "try:\n    pass\nexcept OSError:\n    def f():\n        from rcseg_core.signal.noise import law",
        "match 1:\n    case 1:\n        from rcseg_core.signal.noise import law",
        "x = 1; from rcseg_core.signal.noise import law",
        "from rcseg_core.through import law",
    ],
    "signal.kernels": ["from .noise import law", "from . import noise", "from . import law"],
    "deep.down.kernels": ["from ...signal.noise import law", "from ... import signal"],
    "signal": ["from .noise import law"],
}


@pytest.mark.parametrize(("module", "form"), [(module, form) for module in FORMS for form in FORMS[module]])
def test_every_form_of_import_is_seen(tmp_path, monkeypatch, module, form):
    files = {
        "__init__": "from rcseg_core.signal import law\n", "jit": "", "through": "from .signal import law\n",
        "signal/__init__": "from .noise import law\n", "signal/noise": "law = 1\n", "signal/apart": "",
        "deep/__init__": "", "deep/down/__init__": "", "other": "",
    }  # fmt: skip
    for name, text in files.items():
        (tmp_path / f"{name}.py").parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / f"{name}.py").write_text(text)
    own = tmp_path / (f"{module}/__init__.py" if module == "signal" else f"{module.replace('.', '/')}.py")
    own.write_text(form + "\n")
    monkeypatch.setattr(jit, "PACKAGE", tmp_path)
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    assert jit.module_name(own) == module
    assert own in jit.sources(module) and tmp_path / "other.py" not in jit.sources(module)
    before = jit.cache_folder.__wrapped__(module)
    (tmp_path / "signal" / "noise.py").write_text("law = 2\n")
    assert jit.cache_folder.__wrapped__(module) != before


def test_modules_of_one_name_in_two_packages_have_caches_of_their_own(tmp_path, monkeypatch):
    for name in ("jit.py", "noise.py", "signal/noise.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
    monkeypatch.setattr(jit, "PACKAGE", tmp_path)
    names = {jit.module_name(tmp_path / name) for name in ("noise.py", "signal/noise.py")}
    assert len({jit.cache_folder.__wrapped__(name) for name in names}) == 2


def test_no_module_of_the_package_computes_its_imports():
    for path in jit.PACKAGE.rglob("*.py"):
        assert not re.search(r"importlib|__import__", path.read_text("utf-8")) or path.stem == "jit", path


@pytest.mark.parametrize("module", MODULES)
def test_no_kernel_can_use_a_constant_of_a_module_apart(module):
    held = vars(importlib.import_module(f"rcseg_core.{module}"))
    for name in jit.APART:
        own = vars(importlib.import_module(f"rcseg_core.{name}"))
        for key in set(own) & set(held):
            if not key.startswith("__") and own[key] is held[key]:
                assert not isinstance(held[key], int | float | str | tuple), f"{module}.{key} is a constant"


def test_kernels_are_found_again_in_another_place_and_after_a_new_checkout(tmp_path):
    """The same sources elsewhere, with other times: nothing is compiled again."""
    kept = tmp_path / "kept"
    script = (
        "import numpy as np\n"
        "from rcseg_core.probe import twice\n"
        "assert twice(np.ones(3)).sum() == 6\n"
        "print(sum(twice.stats.cache_misses.values()))\n"
    )
    missed = []
    for year, name in ((1, "one"), (2, "two")):
        package = tmp_path / name / "rcseg_core"
        package.mkdir(parents=True)
        (package / "__init__.py").write_text("")
        shutil.copy(jit.__file__, package / "jit.py")
        (package / "probe.py").write_text(
            "from rcseg_core.jit import kernel\n\n\n@kernel\ndef twice(x):\n    return 2 * x\n"
        )
        os.utime(package / "probe.py", (year * 1e8, year * 1e8))
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(kept)}
        environment.pop("NUMBA_DISABLE_JIT", None)
        command = [sys.executable, "-c", script]
        missed.append(subprocess.check_output(command, env=environment, cwd=package.parent, text=True))
    assert missed == ["1\n", "0\n"]
