"""The one Numba decorator of the package: cached, C-like division, no fastmath (NaN marks invalid pixels)."""

from typing import Any, Callable, TypeVar

import numba

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile `function` once and keep the result on disk; arrays in, arrays out, no Python objects."""
    compiled: F = numba.njit(cache=True, error_model="numpy", nogil=True)(function)
    return compiled
