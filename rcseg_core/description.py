"""From moments to what users read: Bezier patches with standard errors, centroids, normals, neighbours.

Everything is computed for all regions of one degree at once, in the local basis, and converted to the
Bernstein form on the region's box exactly.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_core.adjacency import Pairs
from rcseg_core.bezier import BezierPatch, monomial_to_bernstein
from rcseg_core.frame import RangeColorFrame
from rcseg_core.jit import kernel
from rcseg_core.models import Models
from rcseg_core.moments import UNIT_PX, Moments, tensor_exponents
from rcseg_core.segmentation import Region
from rcseg_core.signals import Signals


@kernel
def _sums(points, image, flags, labels, n_range, centroid, products):  # type: ignore[no-untyped-def]
    """Sums of the measured points (N + 1, 4: x, y, z, n) and of channel products within each modality."""
    height, width, channels = image.shape
    for row in range(height):
        for col in range(width):
            k = labels[row, col]
            if k <= 0 or flags[row, col] != 0:
                continue
            for c in range(3):
                centroid[k, c] += points[row, col, c]
            centroid[k, 3] += 1.0
            for a in range(channels):
                first = 0 if a < n_range else n_range
                for b in range(first, a + 1):
                    products[k, a, b] += np.float64(image[row, col, a]) * np.float64(image[row, col, b])


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
    """
    first, last = (0, signals.n_range) if modality == 0 else (signals.n_range, signals.image.shape[2])
    kind = ("inverse_depth" if signals.inverse_depth else "xyz") if modality == 0 else "rgb"
    scale, offset = signals.scale[first:last], signals.offset[first:last]
    count = moments.energy.shape[0] - 1
    patches: list[Any] = [None] * count
    for degree in np.unique(models.degree[1:, modality]):
        k = int(degree)
        p = (k + 1) ** 2
        members = np.nonzero(models.degree[1:, modality] == degree)[0] + 1
        inverse = _inverse_grams(moments, members, k)
        terms = tensor_exponents(k)
        for position, m in enumerate(members):
            box = boxes[m]
            bern_x, bern_y = _to_bernstein(k, moments.center[m], box)
            local = models.coef[m, first:last, : k + 1, : k + 1]
            control = np.einsum("ai,cij,bj->cab", bern_x, local, bern_y)
            flat = local.reshape(last - first, p)
            cross = moments.cross[m, first:last][:, terms[:, 0], terms[:, 1]]
            energy = np.tril(products[m, first:last, first:last])
            energy = energy + np.tril(energy, -1).T
            # A R = V at the optimum, so the symmetrised (14) is T T^T - (A V^T + V A^T)/2
            rest = energy - 0.5 * (flat @ cross.T + cross @ flat.T)
            n = moments.power[m, 0, 0]
            covariance = rest / max(n - p, 1.0)
            spread = np.sqrt(np.maximum(np.diag(covariance), 0.0))
            np.fill_diagonal(covariance, spread**2)
            lift = np.kron(bern_x, bern_y)
            variance = np.einsum("ai,ij,aj->a", lift, inverse[position], lift)
            with np.errstate(invalid="ignore"):
                unit_error = np.sqrt(variance).reshape(k + 1, k + 1)
            patches[m - 1] = BezierPatch(
                kind=kind,
                degree=k,
                control_points=control * scale[:, None, None] + offset[:, None, None],
                standard_errors=(spread * scale)[:, None, None] * unit_error,  # root of eq. (15)
                covariance=covariance * scale[:, None] * scale[None, :],
                domain=_box(box),
            )
    return patches


def _box(box: NDArray[np.int64]) -> tuple[int, int, int, int]:
    """Row of a box array as plain integers."""
    row_min, col_min, row_max, col_max = box.tolist()
    return row_min, col_min, row_max, col_max


def _to_bernstein(
    degree: int, center: NDArray[np.float64], box: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Conversion matrices of both axes from local monomials (x, y in UNIT_PX) to [0, 1] over the box."""
    row_min, col_min, row_max, col_max = box
    return (
        monomial_to_bernstein(degree, (col_min - center[0]) / UNIT_PX, max(col_max - col_min, 1) / UNIT_PX),
        monomial_to_bernstein(degree, (row_min - center[1]) / UNIT_PX, max(row_max - row_min, 1) / UNIT_PX),
    )


def _normal(patch: BezierPatch, row: float, col: float, frame: RangeColorFrame) -> NDArray[np.float64]:
    """Unit normal of a range patch at a pixel, towards the sensor; NaN where the patch is degenerate."""
    by_row, by_col = patch.derivatives(row, col)
    if patch.kind == "inverse_depth":
        camera = frame.camera
        assert camera is not None
        w = float(patch.evaluate(row, col)[0])
        # tangent plane n.X = 1 with X = ray / w, so w = n.ray: linear in the pixel coordinates
        nx, ny = by_col[0] * camera.fx, by_row[0] * camera.fy
        ray = np.array([(col - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, 1.0])
        normal = np.array([nx, ny, w - nx * ray[0] - ny * ray[1]])
        toward = -float(normal @ ray)
    else:
        normal = np.cross(by_col, by_row)
        toward = -float(normal[2])
    length = float(np.linalg.norm(normal))
    if length == 0.0:
        return np.full(3, np.nan)
    return normal / length * (1.0 if toward >= 0 else -1.0)


def describe_regions(
    frame: RangeColorFrame, signals: Signals, labels: NDArray[np.int32], surface_of: NDArray[np.int64],
    moments: Moments, models: Models, boxes: NDArray[np.int64], pairs: Pairs,
) -> list[Region]:  # fmt: skip
    """All regions, in the order of their labels."""
    count = boxes.shape[0] - 1
    channels = signals.image.shape[2]
    centroid = np.zeros((count + 1, 4))
    products = np.zeros((count + 1, channels, channels))
    _sums(frame.points, signals.image, signals.flags, labels, signals.n_range, centroid, products)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    range_patches = build_patches(moments, models, boxes, products, signals, 0)
    color_patches = build_patches(moments, models, boxes, products, signals, 1)
    neighbors: list[list[int]] = [[] for _ in range(count + 1)]
    for a, b in pairs.nodes:
        neighbors[a].append(int(b))
        neighbors[b].append(int(a))
    regions = []
    for k in range(1, count + 1):
        with np.errstate(invalid="ignore", divide="ignore"):
            middle = centroid[k, :3] / centroid[k, 3]
        n = max(moments.power[k, 0, 0], 1.0)
        col = moments.center[k, 0] + moments.power[k, 1, 0] / n * UNIT_PX
        row = moments.center[k, 1] + moments.power[k, 0, 1] / n * UNIT_PX
        regions.append(
            Region(
                label=k,
                surface=int(surface_of[k]),
                pixel_count=int(sizes[k]),
                box=_box(boxes[k]),
                centroid=middle,
                normal=_normal(range_patches[k - 1], row, col, frame),
                neighbors=tuple(sorted(neighbors[k])),
                range_patch=range_patches[k - 1],
                color_patch=color_patches[k - 1],
            )
        )
    return regions
