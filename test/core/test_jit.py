"""The cache of compiled kernels follows the sources that a kernel depends on."""

import importlib

import pytest

from rcseg_core import jit

MODULES = sorted(
    p.stem for p in jit.PACKAGE.glob("*.py") if "from rcseg_core.jit import" in p.read_text("utf-8")
)


def test_there_are_modules_with_kernels():
    assert {"moments", "evidence", "grouping", "seeds"} <= set(MODULES)


def test_a_kernel_depends_on_the_modules_whose_kernels_it_calls():
    names = {p.stem for p in jit.sources("grouping")}
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


@pytest.mark.parametrize("module", MODULES)
def test_no_kernel_can_use_a_constant_of_a_module_apart(module):
    held = vars(importlib.import_module(f"rcseg_core.{module}"))
    for name in jit.APART:
        own = vars(importlib.import_module(f"rcseg_core.{name}"))
        for key in set(own) & set(held):
            if not key.startswith("__") and own[key] is held[key]:
                assert not isinstance(held[key], int | float | str | tuple), f"{module}.{key} is a constant"
