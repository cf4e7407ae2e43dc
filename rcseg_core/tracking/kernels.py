"""The small linear algebra of tracking, compiled: fifty surfaces a frame leave no time for calls of LAPACK.

Matrices are symmetric and at most 5 x 5, the free parameters of a shape; q says how many count. Scratch is
handed in: (SCRATCH, MOST + 1, MOST) for those that take one named so.
"""

from __future__ import annotations

import numpy as np

from rcseg_core.compute.jit import bare

#: Most free parameters of a shape, and scratch matrices of `add_frame`.
MOST, SCRATCH = 5, 12


@bare
def cholesky(matrix, q, root):  # type: ignore[no-untyped-def]
    """Lower root of a positive definite matrix; the logarithm of its determinant, inf where it is none."""
    log_det = 0.0
    for a in range(q):
        for b in range(a + 1):
            total = matrix[a, b]
            for c in range(b):
                total -= root[a, c] * root[b, c]
            if a == b:
                if not total > 1e-15 * abs(matrix[a, a]):
                    return np.inf
                root[a, a] = np.sqrt(total)
                log_det += np.log(total)
            else:
                root[a, b] = total / root[b, b]
    return log_det


@bare
def inverse(matrix, q, root, out):  # type: ignore[no-untyped-def]
    """Inverse by `cholesky`; returns what that does, and leaves out where it is inf."""
    log_det = cholesky(matrix, q, root)
    if not log_det < np.inf:
        return log_det
    for column in range(q):
        for a in range(q):
            total = 1.0 if a == column else 0.0
            for b in range(a):
                total -= root[a, b] * out[b, column]
            out[a, column] = total / root[a, a]
        for a in range(q - 1, -1, -1):
            total = out[a, column]
            for b in range(a + 1, q):
                total -= root[b, a] * out[b, column]
            out[a, column] = total / root[a, a]
    return log_det


@bare
def product(first, second, q, out):  # type: ignore[no-untyped-def]
    """out = first second."""
    for a in range(q):
        for b in range(q):
            total = 0.0
            for c in range(q):
                total += first[a, c] * second[c, b]
            out[a, b] = total


@bare
def product_t(first, second, q, out):  # type: ignore[no-untyped-def]
    """out = first second'."""
    for a in range(q):
        for b in range(q):
            total = 0.0
            for c in range(q):
                total += first[a, c] * second[b, c]
            out[a, b] = total


@bare
def symmetric_root(matrix, q, values, vectors, out):  # type: ignore[no-untyped-def]
    """The symmetric root of a positive semidefinite matrix, by Jacobi's rotations; the rest is scratch."""
    for a in range(q):
        for b in range(q):
            values[a, b] = matrix[a, b]
            vectors[a, b] = 1.0 if a == b else 0.0
    for _ in range(12):
        off = 0.0
        size = 0.0
        for a in range(q):
            size += values[a, a] ** 2
            for b in range(a):
                off += values[a, b] ** 2
        if off <= 1e-30 * size:
            break
        for a in range(q - 1):
            for b in range(a + 1, q):
                if values[a, b] == 0.0:
                    continue
                ratio = (values[b, b] - values[a, a]) / (2.0 * values[a, b])
                t = 1.0 / (abs(ratio) + np.sqrt(ratio * ratio + 1.0))
                if ratio < 0.0:
                    t = -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(q):
                    x, y = values[k, a], values[k, b]
                    values[k, a], values[k, b] = c * x - s * y, s * x + c * y
                for k in range(q):
                    x, y = values[a, k], values[b, k]
                    values[a, k], values[b, k] = c * x - s * y, s * x + c * y
                for k in range(q):
                    x, y = vectors[k, a], vectors[k, b]
                    vectors[k, a], vectors[k, b] = c * x - s * y, s * x + c * y
    for a in range(q):
        for b in range(q):
            total = 0.0
            for k in range(q):
                total += vectors[a, k] * np.sqrt(max(values[k, k], 0.0)) * vectors[b, k]
            out[a, b] = total


@bare
def chi_squared(difference, total, q, root):  # type: ignore[no-untyped-def]
    """difference' total^-1 difference; inf where total is no covariance."""
    if not cholesky(total, q, root) < np.inf:
        return np.inf
    answer = 0.0
    for a in range(q):
        value = difference[a]
        for b in range(a):
            value -= root[a, b] * root[q, b]  # row q holds the solution so far
        root[q, a] = value / root[a, a]
        answer += root[q, a] ** 2
    return answer


@bare
def relate_planes(  # type: ignore[no-untyped-def]
    anchor, pose, random, systematic, least_cosine, difference, out_random, out_systematic, scratch
):
    """See `fusion.relate`; False where the normals are too far apart. anchor, pose (4, 4)."""
    turn, table, half = scratch[0], scratch[1], scratch[2]
    for a in range(3):
        for b in range(3):
            turn[a, b] = anchor[0, a] * pose[0, b] + anchor[1, a] * pose[1, b] + anchor[2, a] * pose[2, b]
            table[a, b] = 0.0
    if turn[2, 2] < least_cosine:
        return False
    dx, dy, dz = pose[0, 3] - anchor[0, 3], pose[1, 3] - anchor[1, 3], pose[2, 3] - anchor[2, 3]
    x = anchor[0, 0] * dx + anchor[1, 0] * dy + anchor[2, 0] * dz
    y = anchor[0, 1] * dx + anchor[1, 1] * dy + anchor[2, 1] * dz
    z = anchor[0, 2] * dx + anchor[1, 2] * dy + anchor[2, 2] * dz
    difference[0] = -turn[1, 2] / turn[2, 2]
    difference[1] = turn[0, 2] / turn[2, 2]
    # the plane's height above the anchor: z - tilt_y (u - x) + tilt_x (v - y), here at u = v = 0
    difference[2] = z + difference[1] * x - difference[0] * y
    for a in range(2):
        for b in range(2):
            table[a, b] = turn[a, b]
    for b in range(2):
        table[2, b] = -y * table[0, b] + x * table[1, b]
    table[2, 2] = 1.0
    product(table, random, 3, half)
    product_t(half, table, 3, out_random)
    product(table, systematic, 3, half)
    product_t(half, table, 3, out_systematic)
    return True


@bare
def add_frame(difference, random, systematic, q, best, sums, value, change, fused, scratch):  # type: ignore[no-untyped-def]
    """One more measurement of a filter, see `fusion`.

    best : (1,) least logarithm of the determinant of a frame's covariance so far
    sums : (3, 5, 5) of W, W R W and W S^(1/2); value : (5,) of W z
    change, fused (2, 5, 5) : out, the mean, its random and its systematic covariance
    Returns whether the frame counts.
    """
    weight, root, total, other = scratch[0], scratch[1], scratch[2], scratch[3]
    for a in range(q):
        for b in range(q):
            total[a, b] = random[a, b] + systematic[a, b]
    certain = inverse(total, q, root, weight)
    if not certain < np.inf:
        return False
    product(weight, random, q, other)
    product(other, weight, q, scratch[4])
    symmetric_root(systematic, q, scratch[5], scratch[6], other)
    product(weight, other, q, scratch[5])
    # scratch 7, 8, 9: the sums with this frame; first row of 10: its value
    for a in range(q):
        scratch[10, 0, a] = 0.0
        for b in range(q):
            scratch[10, 0, a] += weight[a, b] * difference[b]
            scratch[7, a, b] = sums[0, a, b] + weight[a, b]
            scratch[8, a, b] = sums[1, a, b] + scratch[4, a, b]
            scratch[9, a, b] = sums[2, a, b] + scratch[5, a, b]
    together = _mean(scratch[7], scratch[8], scratch[9], q, root, total, other, scratch[6], fused)
    alone = certain < best[0]
    if together > min(certain, best[0]):
        if not alone:
            return False
        for a in range(q):  # alone better than with all before: the mean begins anew
            value[a] = 0.0
            for b in range(q):
                scratch[7, a, b] = weight[a, b]
                scratch[8, a, b] = scratch[4, a, b]
                scratch[9, a, b] = scratch[5, a, b]
        _mean(scratch[7], scratch[8], scratch[9], q, root, total, other, scratch[6], fused)
    if alone:
        best[0] = certain
    for a in range(q):
        value[a] += scratch[10, 0, a]
        for b in range(q):
            sums[0, a, b] = scratch[7, a, b]
            sums[1, a, b] = scratch[8, a, b]
            sums[2, a, b] = scratch[9, a, b]
    for a in range(q):
        change[a] = 0.0
        for b in range(q):
            change[a] += total[a, b] * value[b]
    return True


@bare
def add_spread(more, q, best, sums, value, change, fused, scratch):  # type: ignore[no-untyped-def]
    """Make the random part of a filter's mean larger by `more` (q, q): from here on it counts as one frame
    that said what the mean says. Arguments as of `add_frame`; change stays, fused grows. False where no
    frame has counted yet."""
    spread, root, weight, half = scratch[0], scratch[1], scratch[2], scratch[3]
    if not inverse(sums[0], q, root, spread) < np.inf:
        return False
    product(spread, sums[2], q, scratch[4])  # the systematic part's root
    for a in range(q):
        for b in range(q):
            fused[0, a, b] += more[a, b]
            spread[a, b] += more[a, b]
            half[a, b] = fused[0, a, b] + fused[1, a, b]
    best[0] = cholesky(half, q, root)
    inverse(spread, q, root, weight)
    product(weight, fused[0], q, half)
    product(half, weight, q, sums[1])
    product(weight, scratch[4], q, sums[2])
    for a in range(q):
        value[a] = 0.0
        for b in range(q):
            sums[0, a, b] = weight[a, b]
            value[a] += weight[a, b] * change[b]
    return True


@bare
def _mean(weights, randoms, roots, q, root, spread, half, lever, fused):  # type: ignore[no-untyped-def]
    """Covariances of a mean into fused (2, 5, 5), inverse of its weights into spread; the logarithm of the
    determinant of both together."""
    inverse(weights, q, root, spread)
    product(spread, randoms, q, half)
    product(half, spread, q, fused[0])
    product(spread, roots, q, lever)
    product_t(lever, lever, q, fused[1])
    for a in range(q):
        for b in range(q):
            half[a, b] = fused[0, a, b] + fused[1, a, b]
    return cholesky(half, q, root)
