"""Surfaces of second order as a pinhole sees them: spheres, cylinders, cones and ellipsoids, to the limb.

No polynomial of the image follows them, so they are the account that facets of a curved thing have to beat.
"""

from __future__ import annotations

import numpy as np

from rcseg_core.compute.inline import inlined
from rcseg_core.compute.jit import bare
from rcseg_core.models.triangular import solve_triangular


@inlined
def _bow(x, y, c, sign, out):  # type: ignore[no-untyped-def]
    """The value of a second-order surface and its derivatives by the coefficients, see `second_order`."""
    a = c[0] + c[1] * x + c[2] * y + c[3] * x * x + c[4] * x * y + c[5] * y * y
    half = 0.5 * (c[6] + c[7] * x + c[8] * y)
    root = sign * np.sqrt(max(half * half + a, 1e-4))
    out[0] = 0.5 / root
    out[1], out[2] = x * out[0], y * out[0]
    out[3], out[4], out[5] = x * out[1], x * out[2], y * out[2]
    out[6] = 0.5 + half * out[0]
    out[7], out[8] = x * out[6], y * out[6]
    return half + root


@bare
def _normal_step(gram, right, damping, step, size=9):  # type: ignore[no-untyped-def]
    """Cholesky of the damped lower triangle in place; step (size,) out."""
    for a in range(size):
        for b in range(a + 1):
            total = gram[a, b] * (1.0 + damping if a == b else 1.0)
            for c in range(b):
                total -= gram[a, c] * gram[b, c]
            if a == b:
                gram[a, a] = np.sqrt(max(total, 1e-12))
            else:
                gram[a, b] = total / gram[b, b]
    solve_triangular(gram, size, right, step)


@bare
def second_order(cells, cap2, wide, unit, enough, gram, work):  # type: ignore[no-untyped-def]
    """Least length of the misses from one surface of second order: a sphere, cylinder, cone or ellipsoid.

    With X = ray / w such a surface X^T Q X = 0 is w^2 = A(x, y) + w B(x, y) with A of second and B of first
    order, in any affine coordinates of the image and of w: linear least squares, then Gauss-Newton of the
    misses themselves. Once it is not above `enough` nobody wants it shorter. work (4, 9) : scratch
    """
    n = cells.value.shape[0]
    spread = 0.0
    total = 0.0
    for i in range(n):
        spread += cells.weight[i] * cells.value[i] ** 2
        total += cells.weight[i]
    spread = np.sqrt(spread / total) + 1e-12
    start, right, row = work[0], work[2], work[3]
    gram[:9, :9] = 0.0
    right[:] = 0.0
    for i in range(n):
        x, y = cells.place[i, 0], cells.place[i, 1]
        v = cells.value[i] / spread
        row[0], row[1], row[2] = 1.0, x, y
        row[3], row[4], row[5] = x * x, x * y, y * y
        row[6], row[7], row[8] = v, v * x, v * y
        for a in range(9):
            right[a] += cells.weight[i] * row[a] * v * v
            for b in range(a + 1):
                gram[a, b] += cells.weight[i] * row[a] * row[b]
    _normal_step(gram, right, 1e-9, start)
    best = _bow_length(cells, start, spread, cap2, wide, unit, enough, gram, work)
    # noise bends that start where the relief is small; a shallow bow is nearly linear in A for a large B
    for deep in (1.0, 4.0):
        for side in (-1.0, 1.0):
            if best <= enough:
                return best
            gram[:6, :6] = 0.0
            right[:] = 0.0
            for i in range(n):
                x, y = cells.place[i, 0], cells.place[i, 1]
                v = cells.value[i] / spread
                row[0], row[1], row[2] = 1.0, x, y
                row[3], row[4], row[5] = x * x, x * y, y * y
                for a in range(6):
                    right[a] += cells.weight[i] * row[a] * v * (v - 4.0 * side * deep)
                    for b in range(a + 1):
                        gram[a, b] += cells.weight[i] * row[a] * row[b]
            _normal_step(gram, right, 1e-9, start, 6)
            start[6], start[7], start[8] = 4.0 * side * deep, 0.0, 0.0
            best = min(best, _bow_length(cells, start, spread, cap2, wide, unit, enough, gram, work))
    return best


@bare
def _bow_length(cells, start, spread, cap2, wide, unit, enough, gram, work):  # type: ignore[no-untyped-def]
    """Least length of the misses on the way of Gauss-Newton from a start, on either side of the surface."""
    n = cells.value.shape[0]
    coef, right, row = work[1], work[2], work[3]
    best = np.inf
    for sign in (-1.0, 1.0):
        for a in range(9):
            coef[a] = start[a]
        damping = 1e-2
        last = np.inf
        for _ in range(8):
            gram[:9, :9] = 0.0
            right[:] = 0.0
            length = 0.0
            for i in range(n):
                miss = cells.value[i] / spread - _bow(cells.place[i, 0], cells.place[i, 1], coef, sign, row)
                square = miss * miss * spread * spread
                length += cells.weight[i] * min(square, wide) / unit
                if square <= cap2 or last == np.inf:
                    for a in range(9):
                        right[a] += cells.weight[i] * row[a] * miss
                        for b in range(a + 1):
                            gram[a, b] += cells.weight[i] * row[a] * row[b]
            best = min(best, length)
            if best <= enough:
                return best
            if length > last * (1.0 - 1e-4):
                break
            last = length
            _normal_step(gram, right, damping, row)
            for a in range(9):
                coef[a] += row[a]
            damping *= 0.3
    return best
