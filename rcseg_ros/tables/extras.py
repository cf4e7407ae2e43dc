"""Libraries that are asked for only where they are used, with the words for where they are missing."""

from __future__ import annotations

from importlib.util import find_spec

from rcseg_core.errors import InputError


def need_pyarrow() -> None:
    """Raise InputError where pyarrow is not installed."""
    _need("pyarrow", "tables", "batch")


def need_ray() -> None:
    """Raise InputError where Ray is not installed."""
    _need("ray", "--runner ray", "ray")


def need_fsspec() -> None:
    """Raise InputError where fsspec is not installed."""
    _need("fsspec", "recordings at URLs", "remote")


def _need(module: str, what: str, extra: str) -> None:
    if find_spec(module) is None:
        raise InputError(f"{what}: {module} is not installed; pip install 'rcseg[{extra}]'")
