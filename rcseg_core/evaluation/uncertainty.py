"""Do stated errors hold? Recognised shapes and control points against the exact truth of synthetic scenes.

The normalised error squared of an estimate, e^T C^-1 e, is chi-squared with as many degrees of freedom as e
has components if the stated covariance C is right: its mean over the degrees of freedom is 1 then, above 1
where errors are larger than stated, and the P % region of C holds the truth in P % of all cases.

Surfaces count that lie on one surface of the truth but for 5 %, and were recognised as what it is: what else
is wrong with the others is told by other figures. Control points are compared with those of a patch of the
same degree that is fitted to the exact signal of the region, each with its own standard error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from rcseg_core.evaluation.plane_metrics import FLAT
from rcseg_core.models.bezier import basis

if TYPE_CHECKING:
    from rcseg_core.result.segmentation import Region, Segmentation, Surface
    from rcseg_core.synthetic import SyntheticScene

Array = NDArray[np.float64]

LEVELS = (0.5, 0.9, 0.95, 0.99)
"""Probabilities of the intervals whose coverage is counted."""
KINDS = ("plane", "sphere", "cylinder", "control points")
LEAST_PURITY = 0.95
SIZES_PX = (500, 2000, 10_000)
DEPTHS_M = (1.0, 2.0, 3.0)
"""Bounds of the classes that errors are told by."""
MOST_PIXELS = 4000
"""Pixels that a patch is fitted to at most: exact signals need no more."""


@dataclass(frozen=True)
class ErrorCheck:
    """One estimate against the truth.

    Attributes
    ----------
    what : "plane", "sphere", "cylinder" or "control points"
    label : of the surface, or of the region
    family, seed : the scene
    pixels : of the surface or region
    depth_m : mean depth of the truth there
    dof : components of the error
    nees : normalised error squared over `dof`; of control points the mean square of error over standard error
    held : share of the errors inside of the intervals of `LEVELS`: 0 or 1 for shapes, whose region is joint
    nees_random : as `nees`, by the random part of the stated errors alone
    """

    what: str
    label: int
    family: str
    seed: int
    pixels: int
    depth_m: float
    dof: int
    nees: float
    held: tuple[float, ...]
    nees_random: float = float("nan")


def check_uncertainty(scene: SyntheticScene, result: Segmentation) -> list[ErrorCheck]:
    """All shapes and patches of a result whose truth is known."""
    shapes = [_check_shape(scene, result, surface) for surface in result.surfaces]
    patches = [_check_patch(scene, result, region) for region in result.regions]
    return [check for check in [*shapes, *patches] if check is not None]


def summarise(checks: Sequence[ErrorCheck]) -> list[dict[str, Any]]:
    """Rows by what and family, size, and depth: number, mean and median of `nees`, coverage of `LEVELS`.

    Means weigh every shape, and every patch, alike.
    """
    classes: dict[str, Callable[[ErrorCheck], Any]] = {
        "family": lambda check: check.family,
        "pixels": lambda check: _class_of(check.pixels, SIZES_PX),
        "depth_m": lambda check: _class_of(check.depth_m, DEPTHS_M),
    }
    rows = []
    for what in sorted({check.what for check in checks}, key=KINDS.index):
        own = [check for check in checks if check.what == what]
        rows.append({"what": what, "by": "all", "class": "", **_figures(own)})
        if large := [check for check in own if check.pixels >= SIZES_PX[0]]:
            rows.append({"what": what, "by": "all", "class": f"{SIZES_PX[0]} px and more", **_figures(large)})
        for by, class_of in classes.items():
            keys = list(dict.fromkeys(class_of(check) for check in own))
            for key in keys if by == "family" else sorted(keys):
                part = [check for check in own if class_of(check) == key]
                name = key if by == "family" else _class_name(key, SIZES_PX if by == "pixels" else DEPTHS_M)
                rows.append({"what": what, "by": by, "class": name, **_figures(part)})
    return rows


def _figures(checks: Sequence[ErrorCheck]) -> dict[str, Any]:
    nees, held = np.array([c.nees for c in checks]), np.array([c.held for c in checks])
    figures = {
        "count": len(checks),
        "nees": float(nees.mean()),
        "nees_median": float(np.median(nees)),
        "nees_random": float(np.mean([c.nees_random for c in checks])),
    }
    return figures | {f"held_{100 * p:.0f}": float(held[:, i].mean()) for i, p in enumerate(LEVELS)}


def _class_of(value: float, bounds: Sequence[float]) -> int:
    return int(np.searchsorted(bounds, value, side="right"))


def _class_name(index: int, bounds: Sequence[float]) -> str:
    low = f"{bounds[index - 1]:g}" if index else ""
    high = f"{bounds[index]:g}" if index < len(bounds) else ""
    return f"{low}-{high}" if low and high else f"below {high}" if high else f"{low} and more"


def truth_of(truth: NDArray[np.integer], mask: NDArray[np.bool_]) -> int:
    """The truth surface that holds nearly all of a mask's pixels; 0 where none does."""
    counts = np.bincount(truth[mask], minlength=2)
    counts[0] = 0
    best = int(counts.argmax())
    return best if counts[best] >= LEAST_PURITY * np.count_nonzero(mask) else 0


def _check_shape(scene: SyntheticScene, result: Segmentation, surface: Surface) -> ErrorCheck | None:
    if surface.local is None:
        return None
    owner = truth_of(scene.surface_labels, result.surface_labels == surface.label)
    if not owner:
        return None
    own = scene.surface_labels == owner
    points, normals = scene.clean_points[own], scene.normals[own].astype(np.float64)
    kind = true_kind(normals)
    if kind != surface.primitive.kind:
        return None
    error = ERRORS[kind](surface.local, points, normals)
    covariance = surface.local.covariance + surface.local.systematic
    nees = float(error @ np.linalg.solve(covariance, error))
    held = tuple(float(nees <= chi2.ppf(p, len(error))) for p in LEVELS)
    return ErrorCheck(
        kind, surface.label, scene.family, scene.seed, surface.pixel_count, float(points[:, 2].mean()),
        len(error), nees / len(error), held,
        float(error @ np.linalg.solve(surface.local.covariance, error)) / len(error),
    )  # fmt: skip


def _check_patch(scene: SyntheticScene, result: Segmentation, region: Region) -> ErrorCheck | None:
    """The control points of a range patch, each against its own standard error."""
    patch, mask = region.range_patch, result.labels == region.label
    errors = patch.standard_errors
    owner = truth_of(scene.surface_labels, mask)
    if not owner or not np.isfinite(errors).all() or not (errors > 0).all():
        return None
    rows, cols = np.nonzero(mask & (scene.surface_labels == owner) & scene.frame.valid)
    if len(rows) <= (patch.degree + 1) ** 2:
        return None
    step = -(-len(rows) // MOST_PIXELS)
    rows, cols = rows[::step], cols[::step]
    points = scene.clean_points[rows, cols]
    signal = 1.0 / points[:, 2:] if patch.kind == "inverse_depth" else points
    row_0, col_0, row_1, col_1 = patch.domain
    u, v = (cols - col_0) / max(col_1 - col_0, 1), (rows - row_0) / max(row_1 - row_0, 1)
    exact = np.linalg.lstsq(basis(patch.degree, u, v), signal, rcond=None)[0]
    score = (patch.control_points - exact.T.reshape(patch.control_points.shape)) / errors
    held = tuple(float(np.mean(score**2 <= chi2.ppf(p, 1))) for p in LEVELS)
    return ErrorCheck(
        "control points", region.label, scene.family, scene.seed, region.pixel_count,
        float(points[:, 2].mean()), score.size, float(np.mean(score**2)), held, float(np.mean(score**2)),
    )  # fmt: skip


def true_kind(normals: Array) -> str:
    """Exact unit normals (m, 3) are one direction, a great circle, or neither."""
    values = np.linalg.eigvalsh(normals.T @ normals / len(normals))
    return "plane" if values[1] < FLAT else "cylinder" if values[0] < FLAT else "sphere"


def plane_error(plane: Any, points: Array, normals: Array) -> Array:
    """(3,) tilts and offset from a `LocalPlane` to the plane through exact points (m, 3)."""
    middle = points.mean(axis=0)
    true = np.linalg.eigh((points - middle).T @ (points - middle))[1][:, 0]
    x, y, z, origin = plane.pose[:3].T
    true = true if true @ z > 0 else -true
    return np.array([-true @ y, true @ x, true @ (middle - origin) / (true @ z)])


def sphere_error(sphere: Any, points: Array, normals: Array) -> Array:
    """(4,) of centre and radius from a `LocalSphere` to the ball through exact points (m, 3)."""
    center, radius = _round(points)
    return np.append(center - sphere.center, radius - sphere.radius)


def cylinder_error(cylinder: Any, points: Array, normals: Array) -> Array:
    """(5,) tilts, offsets and radius from a `LocalCylinder` to that with exact points and normals (m, 3)."""
    x, y, z, origin = cylinder.pose[:3].T
    axis = np.linalg.eigh(normals.T @ normals)[1][:, 0]
    axis = axis if axis @ z > 0 else -axis
    first = np.cross(axis, x)
    first /= np.linalg.norm(first)
    across = np.stack([first, np.cross(axis, first)])
    center, radius = _round((points - origin) @ across.T)
    off = center @ across
    off = off - (off @ z) / (axis @ z) * axis  # where the axis passes the plane of x and y
    return np.array([-axis @ y, axis @ x, off @ x, off @ y, radius - cylinder.radius])


ERRORS: dict[str, Callable[[Any, Array, Array], Array]] = {
    "plane": plane_error,
    "sphere": sphere_error,
    "cylinder": cylinder_error,
}


def _round(points: Array) -> tuple[Array, float]:
    """Centre and radius of the circle or sphere through exact points (m, d), about their mean."""
    middle = points.mean(axis=0)
    local = points - middle
    table = np.concatenate([2.0 * local, np.ones((len(local), 1))], axis=1)
    answer = np.linalg.lstsq(table, np.sum(local**2, axis=1), rcond=None)[0]
    radius = np.sqrt(answer[-1] + answer[:-1] @ answer[:-1])
    return middle + answer[:-1], float(radius)
