"""From moments to what users read: Bezier patches with standard errors, centroids, normals, neighbours.

Everything is computed for all regions of one degree at once, in the local basis, and converted to the
Bernstein form on the region's box exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.compute.parallel import BANDS, over_bands
from rcseg_core.frame import PinholeCamera, RangeColorFrame
from rcseg_core.graph.adjacency import Pairs
from rcseg_core.models.bezier import BezierPatch, jets, monomials_to_bernstein
from rcseg_core.models.moments import Moments, tensor_exponents
from rcseg_core.models.polynomials import Models
from rcseg_core.result.segmentation import Region
from rcseg_core.signal.signals import Signals
from rcseg_core.signal.units import UNIT_PX


@bare
def _sum_points(points, flags, row, start, end, total):  # type: ignore[no-untyped-def]
    """x, y, z and number of the measured points of a run. Sums in registers: in an array each would wait for
    the one before."""
    x = y = z = n = 0.0
    for col in range(start, end):
        if flags[row, col] == 0:
            x += points[row, col, 0]
            y += points[row, col, 1]
            z += points[row, col, 2]
            n += 1.0
    total[0] = x
    total[1] = y
    total[2] = z
    total[3] = n


@bare
def _sum_three(image, flags, row, start, end, first, run):  # type: ignore[no-untyped-def]
    """Lower triangle of the products of the three channels from `first` on, over a run."""
    rr = rg = rb = gg = gb = bb = 0.0
    for col in range(start, end):
        if flags[row, col] == 0:
            r = np.float64(image[row, col, first])
            g = np.float64(image[row, col, first + 1])
            b = np.float64(image[row, col, first + 2])
            rr += r * r
            rg += r * g
            rb += r * b
            gg += g * g
            gb += g * b
            bb += b * b
    run[first, first] = rr
    run[first + 1, first] = rg
    run[first + 1, first + 1] = gg
    run[first + 2, first] = rb
    run[first + 2, first + 1] = gb
    run[first + 2, first + 2] = bb


@bare
def _sums(points, image, flags, labels, n_range, first, last, run, centroid, products):  # type: ignore[no-untyped-def]
    """Over rows first..last-1 the sums of the measured points (N + 1, 4: x, y, z, n) and of channel products
    within each modality; run : (C + 1, C + 4) scratch, the sums of one run of a label."""
    width, channels = image.shape[1], image.shape[2]
    for row in range(first, last):
        col = 0
        while col < width:
            k = labels[row, col]
            if k <= 0:
                col += 1
                continue
            start = col
            while col < width and labels[row, col] == k:
                col += 1
            run[:, :] = 0.0
            _sum_points(points, flags, row, start, col, run[channels])
            if n_range == 3:
                _sum_three(image, flags, row, start, col, 0, run)
            else:
                total = 0.0
                for at in range(start, col):
                    if flags[row, at] == 0:
                        total += np.float64(image[row, at, 0]) * np.float64(image[row, at, 0])
                run[0, 0] = total
            _sum_three(image, flags, row, start, col, n_range, run)
            for c in range(4):
                centroid[k, c] += run[channels, c]
            for a in range(channels):
                for b in range(a + 1):
                    products[k, a, b] += run[a, b]


def _measured(
    frame: RangeColorFrame, signals: Signals, labels: NDArray[np.int32], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sums of `_sums` over the whole image: (N + 1, 4) and (N + 1, C, C)."""
    channels = signals.image.shape[2]
    centroid = np.zeros((BANDS, count + 1, 4))
    products = np.zeros((BANDS, count + 1, channels, channels))
    run = np.empty((BANDS, channels + 1, channels + 4))

    def sum_band(i: int, first: int, last: int) -> None:
        _sums(
            frame.points, signals.image, signals.flags, labels, signals.n_range, first, last, run[i],
            centroid[i], products[i],
        )  # fmt: skip

    over_bands(labels.shape[0], sum_band)
    return centroid.sum(axis=0), products.sum(axis=0)


def _inverse_grams(moments: Moments, members: NDArray[np.int64], degree: int) -> NDArray[np.float64]:
    """(m, p, p) inverse Gram matrices R^-1 in local monomials; NaN where R is singular."""
    terms = tensor_exponents(degree)
    a = terms[:, 0][:, None] + terms[:, 0][None]
    b = terms[:, 1][:, None] + terms[:, 1][None]
    gram = moments.power[members][:, a, b]
    diagonal = np.einsum("kii->ki", gram)
    with np.errstate(divide="ignore"):
        scale = np.where(diagonal > 0, 1.0 / np.sqrt(diagonal), 0.0)
    gram = gram * scale[:, :, None] * scale[:, None, :]
    values, vectors = np.linalg.eigh(gram)
    with np.errstate(divide="ignore"):
        weights = np.where(values > 1e-12, 1.0 / values, np.nan)
    inverse = np.einsum("kij,kj,klj->kil", vectors, weights, vectors)
    return np.asarray(inverse * scale[:, :, None] * scale[:, None, :])


def build_patches(
    moments: Moments, models: Models, boxes: NDArray[np.int64], products: NDArray[np.float64],
    signals: Signals, modality: int,
) -> list[BezierPatch]:  # fmt: skip
    """The patches of one modality (0 range, 1 colour) of regions 1..N, in sensor units.

    products : (N + 1, C, C) lower triangles of ``sum s_a s_b``, the T T^T of eq. (14)

    Eq. (15) takes the noise of pixels as independent. Where several make one independent measurement there
    are so many fewer, and the variances so many times larger, as long as a patch bends little over them.
    """
    first, last = (0, signals.n_range) if modality == 0 else (signals.n_range, signals.image.shape[2])
    kind = ("inverse_depth" if signals.inverse_depth else "xyz") if modality == 0 else "rgb"
    scale, offset = signals.scale[first:last], signals.offset[first:last]
    noise = signals.noise
    pixels_a_measurement = noise.range_correlation if modality == 0 else noise.color_correlation
    count = moments.energy.shape[0] - 1
    domains = [tuple(box) for box in boxes.tolist()]
    patches: list[Any] = [None] * count
    for degree in np.unique(models.degree[1:, modality]):
        k = int(degree)
        p = (k + 1) ** 2
        members = np.nonzero(models.degree[1:, modality] == degree)[0] + 1
        terms = tensor_exponents(k)
        bern_x, bern_y = _to_bernstein(k, moments.center[members], boxes[members])
        local = models.coef[members, first:last, : k + 1, : k + 1]
        control = np.matmul(np.matmul(bern_x[:, None], local), bern_y[:, None].swapaxes(2, 3))
        flat = local.reshape(members.size, last - first, p)
        cross = moments.cross[members, first:last][:, :, terms[:, 0], terms[:, 1]]
        lower = np.tril(products[members, first:last, first:last])
        energy = lower + np.tril(lower, -1).swapaxes(1, 2)
        # A R = V at the optimum, so the symmetrised (14) is T T^T - (A V^T + V A^T)/2
        explained = np.matmul(flat, cross.swapaxes(1, 2))
        rest = energy - 0.5 * (explained + explained.swapaxes(1, 2))
        covariance = rest / np.maximum(moments.power[members, 0, 0] - p, 1.0)[:, None, None]
        spread = np.sqrt(np.maximum(np.einsum("mcc->mc", covariance), 0.0))
        np.einsum("mcc->mc", covariance)[:] = spread**2
        lift = np.einsum("mai,mbj->mabij", bern_x, bern_y).reshape(members.size, p, p)
        variance = (np.matmul(lift, _inverse_grams(moments, members, k)) * lift).sum(axis=2)
        with np.errstate(invalid="ignore"):
            unit_error = np.sqrt(pixels_a_measurement * variance).reshape(-1, 1, k + 1, k + 1)
        errors = (spread * scale)[:, :, None, None] * unit_error  # root of eq. (15)
        control = control * scale[:, None, None] + offset[:, None, None]
        covariance = covariance * scale[:, None] * scale[None, :]
        for i, m in enumerate(members.tolist()):
            patches[m - 1] = BezierPatch(kind, k, control[i], errors[i], covariance[i], domains[m])
    return patches


def _to_bernstein(
    degree: int, center: NDArray[np.float64], box: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(m, k+1, k+1) matrices of both axes from local monomials (x, y in UNIT_PX) to [0, 1] over the boxes."""
    span = np.maximum(box[:, 2:] - box[:, :2], 1) / UNIT_PX
    start = (box[:, :2] - center[:, ::-1]) / UNIT_PX
    return (
        monomials_to_bernstein(degree, start[:, 1], span[:, 1]),
        monomials_to_bernstein(degree, start[:, 0], span[:, 0]),
    )


def _normals(
    patches: Sequence[BezierPatch], rows: NDArray[np.float64], cols: NDArray[np.float64],
    camera: PinholeCamera | None,
) -> NDArray[np.float64]:  # fmt: skip
    """(n, 3) unit normals of range patches at one pixel each, towards the sensor; NaN where degenerate."""
    if not patches:
        return np.empty((0, 3))
    values, by_row, by_col = jets(patches, rows, cols)
    if camera is not None and patches[0].kind == "inverse_depth":
        # tangent plane n.X = 1 with X = ray / w, so w = n.ray: linear in the pixel coordinates
        nx, ny = by_col[:, 0] * camera.fx, by_row[:, 0] * camera.fy
        x, y = (cols - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
        nz = values[:, 0] - nx * x - ny * y
        normals = np.stack([nx, ny, nz], axis=1)
        toward = -(nx * x + ny * y + nz)
    else:
        normals = np.cross(by_col, by_row)
        toward = -normals[:, 2]
    length = np.sqrt((normals * normals).sum(axis=1))
    with np.errstate(invalid="ignore", divide="ignore"):
        normals = normals / length[:, None]
    normals[length == 0.0] = np.nan
    return np.asarray(np.where(toward[:, None] >= 0, normals, -normals))


def describe_regions(
    frame: RangeColorFrame, signals: Signals, labels: NDArray[np.int32], surface_of: NDArray[np.int64],
    moments: Moments, models: Models, boxes: NDArray[np.int64], pairs: Pairs,
) -> list[Region]:  # fmt: skip
    """All regions, in the order of their labels."""
    count = boxes.shape[0] - 1
    centroid, products = _measured(frame, signals, labels, count)
    range_patches = build_patches(moments, models, boxes, products, signals, 0)
    color_patches = build_patches(moments, models, boxes, products, signals, 1)
    neighbors: list[list[int]] = [[] for _ in range(count + 1)]
    for a, b in pairs.nodes.tolist():
        neighbors[a].append(b)
        neighbors[b].append(a)
    with np.errstate(invalid="ignore", divide="ignore"):
        middle = centroid[:, :3] / centroid[:, 3:]
    n = np.maximum(moments.power[1:, 0, 0], 1.0)
    cols = moments.center[1:, 0] + moments.power[1:, 1, 0] / n * UNIT_PX
    rows = moments.center[1:, 1] + moments.power[1:, 0, 1] / n * UNIT_PX
    normals = _normals(range_patches, rows, cols, frame.camera)
    surfaces, sizes = surface_of.tolist(), np.bincount(labels.ravel(), minlength=count + 1).tolist()
    return [
        Region(
            label=k,
            surface=surfaces[k],
            pixel_count=sizes[k],
            box=range_patches[k - 1].domain,
            centroid=middle[k],
            normal=normals[k - 1],
            neighbors=tuple(sorted(neighbors[k])),
            range_patch=range_patches[k - 1],
            color_patch=color_patches[k - 1],
        )
        for k in range(1, count + 1)
    ]
