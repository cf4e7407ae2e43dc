"""The one Numba decorator of the package: cached, C-like division, no fastmath (NaN marks invalid pixels)."""

from typing import Any, Callable, TypeVar

import numba

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile `function` once and keep the result on disk; arrays in, arrays out, no Python objects."""
    compiled: F = numba.njit(cache=True, error_model="numpy", nogil=True)(function)
    return compiled


def bare(function: F) -> F:
    """Like `kernel` for code that allocates nothing, without reference counts.

    Numba counts a reference, atomically, for every array that is taken out of a structure; on the small bodies of
    the grouping loop that is most of the time. Without the counting runtime such a function must get all of its
    arrays from its caller.
    """
    compiled: F = numba.njit(cache=True, error_model="numpy", nogil=True, _nrt=False)(function)
    return compiled
