"""How far a measurement is from a shape, how that changes with the shape, and a fit's normal equations."""

from __future__ import annotations

import numpy as np

from rcseg_core.compute.jit import bare

PLANE, SPHERE, CYLINDER = 0, 1, 2
#: Local parameters of a step, by kind.
FREEDOM = (3, 4, 5)
#: Least squared cosine of incidence that a weight is computed with.
GRAZING2 = 0.01


@bare
def _complete(direction, frame):  # type: ignore[no-untyped-def]
    """Two unit vectors (2, 3) that make an orthonormal frame with a unit vector (3,)."""
    least = 0
    for i in range(1, 3):
        if abs(direction[i]) < abs(direction[least]):
            least = i
    # direction x e_least, then direction x that
    a = (least + 1) % 3
    b = (least + 2) % 3
    length = np.sqrt(direction[a] ** 2 + direction[b] ** 2)
    frame[0, least] = 0.0
    frame[0, a] = direction[b] / length
    frame[0, b] = -direction[a] / length
    for i in range(3):
        j = (i + 1) % 3
        k = (i + 2) % 3
        frame[1, i] = direction[j] * frame[0, k] - direction[k] * frame[0, j]


@bare
def _distance(kind, vector, x, y, z, gradient):  # type: ignore[no-untyped-def]
    """Signed distance of a point from a shape and its height along the direction; gradient (3,) : out."""
    x -= vector[0]
    y -= vector[1]
    z -= vector[2]
    along = x * vector[3] + y * vector[4] + z * vector[5]
    if kind == PLANE:
        gradient[0], gradient[1], gradient[2] = vector[3], vector[4], vector[5]
        return along, along
    if kind == CYLINDER:
        x -= along * vector[3]
        y -= along * vector[4]
        z -= along * vector[5]
    length = max(np.sqrt(x * x + y * y + z * z), 1e-12)
    gradient[0], gradient[1], gradient[2] = x / length, y / length, z / length
    return length - vector[6], along


@bare
def _step(share, mx, my, mz, radius):  # type: ignore[no-untyped-def]
    """The share of the direction (mx, my, mz) that leads to a curved shape, half a radius at the most."""
    far = abs(share) * np.sqrt(mx * mx + my * my + mz * mz)
    if far > 0.5 * radius:  # nowhere near: the straight line says nothing
        share *= 0.5 * radius / far
    return share


@bare
def _slopes(kind, frame, sigma, gx, gy, gz, along, row):  # type: ignore[no-untyped-def]
    """Derivatives of a whitened distance by the local parameters of a curved shape: row (q,)."""
    if kind == SPHERE:
        row[0], row[1], row[2], row[3] = -gx / sigma, -gy / sigma, -gz / sigma, -1.0 / sigma
        return
    # an axis a -> a + t e moves the foot of x by t (a . (x - p)) e, across the axis
    first = -(gx * frame[0, 0] + gy * frame[0, 1] + gz * frame[0, 2])
    second = -(gx * frame[1, 0] + gy * frame[1, 1] + gz * frame[1, 2])
    row[0], row[1] = first / sigma, second / sigma
    row[2], row[3] = along * first / sigma, along * second / sigma
    row[4] = -1.0 / sigma


@bare
def _miss(kind, vector, frame, point, spread, row, gradient):  # type: ignore[no-untyped-def]
    """Whitened distance of one point and its noise; derivatives into row (q,), gradient (3,).

    The distance is that along the way which the noise goes, a straight line to the surface; its noise and its
    derivatives are taken where it ends: at the point itself they would depend on the noise, and a radius
    would come out too small.
    """
    x, y, z = point[0], point[1], point[2]
    whitened = 0.0
    sigma = 0.0
    for step in range(1 if kind == PLANE else 2):
        distance, along = _distance(kind, vector, x, y, z, gradient)
        variance = 0.0
        whole = 0.0
        mx, my, mz = 0.0, 0.0, 0.0
        for j in range(spread.shape[1]):
            part = gradient[0] * spread[0, j] + gradient[1] * spread[1, j] + gradient[2] * spread[2, j]
            variance += part * part
            whole += spread[0, j] ** 2 + spread[1, j] ** 2 + spread[2, j] ** 2
            mx += spread[0, j] * part
            my += spread[1, j] * part
            mz += spread[2, j] * part
        # along a ray that only grazes the shape, a pixel's own width counts
        variance = max(variance, GRAZING2 * whole)
        sigma = np.sqrt(variance)
        whitened += distance / sigma
        if step == 0 and kind != PLANE:
            share = _step(distance / variance, mx, my, mz, vector[6])
            x -= share * mx
            y -= share * my
            z -= share * mz
    if kind == PLANE:
        x -= vector[0]
        y -= vector[1]
        z -= vector[2]
        row[0] = x * frame[0, 0] + y * frame[0, 1] + z * frame[0, 2]
        row[1] = x * frame[1, 0] + y * frame[1, 1] + z * frame[1, 2]
        row[2] = -1.0
        for j in range(3):
            row[j] /= sigma
    else:
        _slopes(kind, frame, sigma, gradient[0], gradient[1], gradient[2], along, row)
    return whitened, sigma


@bare
def _ray_miss(kind, vector, x, y, z, sx, sy, sz):  # type: ignore[no-untyped-def]
    """`_miss` of a curved shape where the noise goes along (sx, sy, sz), in registers alone.

    Returns the whitened distance, its noise, the gradient and the height along the direction.
    """
    whole = sx * sx + sy * sy + sz * sz
    whitened, sigma, gx, gy, gz, along = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for step in range(2):
        px, py, pz = x - vector[0], y - vector[1], z - vector[2]
        along = px * vector[3] + py * vector[4] + pz * vector[5]
        if kind == CYLINDER:
            px -= along * vector[3]
            py -= along * vector[4]
            pz -= along * vector[5]
        length = max(np.sqrt(px * px + py * py + pz * pz), 1e-12)
        gx, gy, gz = px / length, py / length, pz / length
        distance = length - vector[6]
        part = gx * sx + gy * sy + gz * sz
        variance = max(part * part, GRAZING2 * whole)
        sigma = np.sqrt(variance)
        whitened += distance / sigma
        if step == 0:
            mx, my, mz = sx * part, sy * part, sz * part
            share = _step(distance / variance, mx, my, mz, vector[6])
            x -= share * mx
            y -= share * my
            z -= share * mz
    return whitened, sigma, gx, gy, gz, along


@bare
def _plane_equations(vector, frame, points, spread, limit, gram, right):  # type: ignore[no-untyped-def]
    """`_equations` of a plane, where the noise goes along one line a point."""
    nx, ny, nz = vector[3], vector[4], vector[5]
    cost = g00 = g10 = g11 = g20 = g21 = g22 = r0 = r1 = r2 = 0.0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0] - vector[0], points[i, 1] - vector[1], points[i, 2] - vector[2]
        sx, sy, sz = spread[i, 0, 0], spread[i, 1, 0], spread[i, 2, 0]
        part = nx * sx + ny * sy + nz * sz
        sigma = np.sqrt(max(part * part, GRAZING2 * (sx * sx + sy * sy + sz * sz)))
        r = (x * nx + y * ny + z * nz) / sigma
        a = (x * frame[0, 0] + y * frame[0, 1] + z * frame[0, 2]) / sigma
        b = (x * frame[1, 0] + y * frame[1, 1] + z * frame[1, 2]) / sigma
        c = -1.0 / sigma
        inner = min(abs(r), limit[i])
        cost += inner * (2.0 * abs(r) - inner)
        weight = 1.0 if abs(r) <= limit[i] else limit[i] / abs(r)
        r0 += weight * a * r
        r1 += weight * b * r
        r2 += weight * c * r
        g00 += weight * a * a
        g10 += weight * b * a
        g11 += weight * b * b
        g20 += weight * c * a
        g21 += weight * c * b
        g22 += weight * c * c
    right[0], right[1], right[2] = r0, r1, r2
    gram[0, 0], gram[1, 0], gram[1, 1] = g00, g10, g11
    gram[2, 0], gram[2, 1], gram[2, 2] = g20, g21, g22
    return cost


@bare
def _equations(kind, vector, frame, points, spread, limit, gram, right, row, gradient):  # type: ignore[no-untyped-def]
    """Huber's cost (squares up to limit (m,), straight beyond), and its normal equations."""
    q = FREEDOM[kind]
    gram[:, :] = 0.0
    right[:] = 0.0
    along_rays = spread.shape[2] == 1
    if kind == PLANE and along_rays:
        return _plane_equations(vector, frame, points, spread, limit, gram, right)
    cost = 0.0
    for i in range(points.shape[0]):
        if along_rays:
            r, sigma, gx, gy, gz, along = _ray_miss(
                kind, vector, points[i, 0], points[i, 1], points[i, 2], spread[i, 0, 0], spread[i, 1, 0],
                spread[i, 2, 0],
            )  # fmt: skip
            _slopes(kind, frame, sigma, gx, gy, gz, along, row)
        else:
            r, _ = _miss(kind, vector, frame, points[i], spread[i], row, gradient)
        inner = min(abs(r), limit[i])
        cost += inner * (2.0 * abs(r) - inner)
        weight = 1.0 if abs(r) <= limit[i] else limit[i] / abs(r)
        for a in range(q):
            right[a] += weight * row[a] * r
            for b in range(a + 1):
                gram[a, b] += weight * row[a] * row[b]
    return cost
