"""Bezier patches (section 4, eq. 8-11): basis, conversion from local monomials, evaluation, elevation.

Domain: the region's own bounding box, u = (col - col_min) / (col_max - col_min) and v likewise in rows, both
in [0, 1]. Grouping works in centred monomials, where sums add; the conversion here is exact, once a region.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import comb
from typing import Any

import numpy as np
from numpy.typing import NDArray


def bernstein(degree: int, t: NDArray[Any]) -> NDArray[np.float64]:
    """Bernstein polynomials B_0..B_k of eq. (9) at t, shape (*t.shape, degree + 1)."""
    t = np.asarray(t, np.float64)[..., None]
    m = np.arange(degree + 1)
    weights = np.array([comb(degree, int(i)) for i in m], float)
    return np.asarray(weights * t**m * (1.0 - t) ** (degree - m))


def basis(degree: int, u: NDArray[Any], v: NDArray[Any]) -> NDArray[np.float64]:
    """M of eq. (11): products B_i(u) B_j(v), shape (*u.shape, (degree + 1)^2), j varying fastest."""
    product = bernstein(degree, u)[..., :, None] * bernstein(degree, v)[..., None, :]
    return np.asarray(product.reshape(*product.shape[:-2], (degree + 1) ** 2))


@lru_cache(maxsize=8)
def power_to_bernstein(degree: int) -> NDArray[np.float64]:
    """(k+1, k+1) matrix that turns coefficients of t^i into Bernstein coefficients."""
    return np.array(
        [
            [comb(j, i) / comb(degree, i) if i <= j else 0.0 for i in range(degree + 1)]
            for j in range(degree + 1)
        ]
    )


def monomial_to_bernstein(degree: int, offset: float, span: float) -> NDArray[np.float64]:
    """(k+1, k+1) matrix from coefficients of x^i to Bernstein coefficients in t, x = offset + span t."""
    return np.asarray(monomials_to_bernstein(degree, np.array([offset]), np.array([span]))[0])


def monomials_to_bernstein(
    degree: int, offset: NDArray[np.float64], span: NDArray[np.float64]
) -> NDArray[np.float64]:
    """`monomial_to_bernstein` of n offsets and spans at once: (n, k+1, k+1)."""
    powers = np.zeros((len(offset), degree + 1, degree + 1))
    for i in range(degree + 1):
        for m in range(i + 1):
            powers[:, m, i] = comb(i, m) * offset ** (i - m) * span**m
    return np.asarray(power_to_bernstein(degree) @ powers)


def elevate(control_points: NDArray[Any]) -> NDArray[np.float64]:
    """The same patch with a degree one higher, (channels, k+2, k+2) from (channels, k+1, k+1)."""
    k = control_points.shape[-1] - 1
    lift = np.zeros((k + 2, k + 1))
    for i in range(k + 2):
        if i > 0:
            lift[i, i - 1] = i / (k + 1)
        if i <= k:
            lift[i, i] = 1 - i / (k + 1)
    return np.asarray(np.einsum("ai,cij,bj->cab", lift, control_points, lift))


def subdivide(control_points: NDArray[Any], t0: float, t1: float, axis: int) -> NDArray[np.float64]:
    """The part of a patch from t0 to t1 of u (axis 0) or v (axis 1), also beyond it, on [0, 1] again."""
    k = control_points.shape[-1] - 1
    inverse = np.linalg.inv(power_to_bernstein(k))
    matrix = monomial_to_bernstein(k, t0, t1 - t0) @ inverse
    if axis == 0:
        return np.asarray(np.einsum("ai,cij->caj", matrix, control_points))
    return np.asarray(np.einsum("bj,cij->cib", matrix, control_points))


@dataclass(frozen=True)
class BezierPatch:
    """One parametric model of one signal over one region.

    Attributes
    ----------
    kind : "inverse_depth" (1 channel, 1/m; point = ray / value), "xyz" (3 channels, m) or "rgb" (3, levels)
    degree : int, tensor degree k in u and in v (eq. 8)
    control_points : (channels, k+1, k+1) float64; first index along u (columns), second along v (rows)
    standard_errors : same shape, root of eq. (15), pixels that make one measurement counted as one;
        NaN where the pixels do not determine a coefficient
    covariance : (channels, channels) float64, residual covariance, eq. (14) over the degrees of freedom
    domain : (row_min, col_min, row_max, col_max), inclusive pixels that map to [0, 1]
    """

    kind: str
    degree: int
    control_points: NDArray[np.float64]
    standard_errors: NDArray[np.float64]
    covariance: NDArray[np.float64]
    domain: tuple[int, int, int, int]

    def parameters(self, rows: Any, cols: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(u, v) of pixel coordinates (any shape); a domain of one row or column counts as one pixel wide."""
        row_min, col_min, row_max, col_max = self.domain
        u = (np.asarray(cols, float) - col_min) / max(col_max - col_min, 1)
        v = (np.asarray(rows, float) - row_min) / max(row_max - row_min, 1)
        return u, v

    def evaluate(self, rows: Any, cols: Any) -> NDArray[np.float64]:
        """Values of the patch at pixels (also outside the domain), eq. (8): shape (*rows.shape, channels)."""
        u, v = self.parameters(rows, cols)
        u, v = np.broadcast_arrays(u, v)
        flat = self.control_points.reshape(self.control_points.shape[0], -1)
        return np.asarray(basis(self.degree, u, v) @ flat.T)

    def derivatives(self, row: float, col: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Derivatives per pixel along rows and along columns at one pixel, (channels,) each."""
        _, along_rows, along_cols = jets([self], np.array([float(row)]), np.array([float(col)]))
        return along_rows[0], along_cols[0]


def jets(
    patches: Sequence[BezierPatch], rows: NDArray[Any], cols: NDArray[Any]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Values and derivatives per pixel, along rows and along columns, of n patches at one pixel each.

    Parameters
    ----------
    patches : of one kind; degrees may differ
    rows, cols : (n,) pixel of each

    Returns
    -------
    three (n, channels) float64
    """
    channels = patches[0].control_points.shape[0] if patches else 0
    value, along_u, along_v = (np.zeros((len(patches), channels)) for _ in range(3))
    degrees = np.array([patch.degree for patch in patches], int)
    for k in np.unique(degrees).tolist():
        mine = np.nonzero(degrees == k)[0]
        control = np.stack([patches[i].control_points for i in mine.tolist()])
        domains = np.array([patches[i].domain for i in mine.tolist()], np.float64)
        low_row, low_col, high_row, high_col = domains.T
        wide, high = np.maximum(high_col - low_col, 1), np.maximum(high_row - low_row, 1)
        u, v = (cols[mine] - low_col) / wide, (rows[mine] - low_row) / high
        bu, bv = bernstein(k, u), bernstein(k, v)
        value[mine] = np.einsum("ncij,ni,nj->nc", control, bu, bv)
        by_u = np.einsum("ncij,ni,nj->nc", np.diff(control, axis=2), bernstein(k - 1, u), bv)
        by_v = np.einsum("ncij,ni,nj->nc", np.diff(control, axis=3), bu, bernstein(k - 1, v))
        along_u[mine], along_v[mine] = k * by_u / wide[:, None], k * by_v / high[:, None]
    return value, along_v, along_u
