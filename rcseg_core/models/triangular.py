"""Normal equations by their Cholesky factor."""

from __future__ import annotations

from rcseg_core.compute.jit import bare


@bare
def solve_triangular(root, size, right, out):  # type: ignore[no-untyped-def]
    """Solve L L^T out = right.

    root : L in the lower triangle of (>= size, >= size), positive on its diagonal
    right, out : (>= size,), not the same array
    """
    for a in range(size):
        total = right[a]
        for c in range(a):
            total -= root[a, c] * out[c]
        out[a] = total / root[a, a]
    for a in range(size - 1, -1, -1):
        total = out[a]
        for c in range(a + 1, size):
            total -= root[c, a] * out[c]
        out[a] = total / root[a, a]
