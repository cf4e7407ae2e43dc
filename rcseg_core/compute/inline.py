"""Small helpers that take records: their bodies stand in the loops that call them.

A call hands over every field of every array of a record, some hundred words; that costs more than a body of a
few products. The compiler knows it only where it inlines on its own.
"""

from rcseg_core.compute.jit import HAS_SWITCH, UNCOUNTED, F, compiled, knows

#: An option of njit that is not in its documentation; without it the results are the same, later.
FORCED = {"forceinline": True}
HAS_FORCED = knows(FORCED)


def inlined(function: F) -> F:
    """Like `jit.bare`, and without a call where other kernels use it."""
    return compiled(function, **(UNCOUNTED if HAS_SWITCH else {}), **(FORCED if HAS_FORCED else {}))
