"""First-degree grouping in closed form: centred second moments of a region instead of power sums.

A plane has three coefficients, so everything that `evidence` asks of two regions is a handful of products.
With the spread (Sxx, Sxy, Syy) of a region's pixels about their mean, another plane that differs from its own
by dv at the mean and by (dgx, dgy) in slope costs it exactly

    rise = n dv^2 + Sxx dgx^2 + 2 Sxy dgx dgy + Syy dgy^2

This is d R d^T of the general form (d = A - A_s, R the Gram matrix), about the centre of gravity, where R is
block diagonal. It takes a thirtieth of the time of the general comparison.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.inline import inlined
from rcseg_core.compute.jit import bare
from rcseg_core.models.moments import Moments
from rcseg_core.signal.units import UNIT_PX

#: Pixels whose spread has a determinant below this share of its squared trace lie on a line: no slope across.
LEAST_SPREAD = 1e-9


class Planes(NamedTuple):
    """Centred moments of N regions; row 0 is the background.

    shape : (N, 6) float64, n, mean x, mean y (UNIT_PX), Sxx, Sxy, Syy
    signal : (N, C, 5) float64, mean, Sxs, Sys, and the slopes gx, gy of the least-squares plane
    """

    shape: NDArray[np.float64]
    signal: NDArray[np.float64]


@inlined
def slopes(sxx, sxy, syy, sxv, syv):  # type: ignore[no-untyped-def]
    """Least-squares slopes; the minimum-norm ones where the pixels lie on a line, zero for a point."""
    det = sxx * syy - sxy * sxy
    trace = sxx + syy
    if det > LEAST_SPREAD * trace * trace:
        return (syy * sxv - sxy * syv) / det, (sxx * syv - sxy * sxv) / det
    if trace > 0.0:
        return sxv / trace, syv / trace
    return 0.0, 0.0


@bare
def _center(power, cross, center, shape, signal):  # type: ignore[no-untyped-def]
    for k in range(1, power.shape[0]):
        n = power[k, 0, 0]
        shape[k, 0] = n
        if n < 1.0:
            continue
        mx = power[k, 1, 0] / n
        my = power[k, 0, 1] / n
        shape[k, 1] = mx + center[k, 0] / UNIT_PX
        shape[k, 2] = my + center[k, 1] / UNIT_PX
        shape[k, 3] = max(power[k, 2, 0] - n * mx * mx, 0.0)
        shape[k, 4] = power[k, 1, 1] - n * mx * my
        shape[k, 5] = max(power[k, 0, 2] - n * my * my, 0.0)
        for c in range(cross.shape[1]):
            v = cross[k, c, 0, 0]
            signal[k, c, 0] = v / n
            signal[k, c, 1] = cross[k, c, 1, 0] - mx * v
            signal[k, c, 2] = cross[k, c, 0, 1] - my * v
            gx, gy = slopes(shape[k, 3], shape[k, 4], shape[k, 5], signal[k, c, 1], signal[k, c, 2])
            signal[k, c, 3] = gx
            signal[k, c, 4] = gy


def center_planes(moments: Moments) -> Planes:
    """Centred moments from power sums of degree 1 or more."""
    count, channels = moments.energy.shape
    planes = Planes(np.zeros((count, 6)), np.zeros((count, channels, 5)))
    _center(moments.power, moments.cross, moments.center, planes.shape, planes.signal)
    return planes


@inlined
def joint_shape(planes, i, j, out):  # type: ignore[no-untyped-def]
    """Shape moments of the union (parallel-axis theorem) into out (6,)."""
    a = planes.shape[i]
    b = planes.shape[j]
    n = a[0] + b[0]
    share = a[0] * b[0] / n
    dx = b[1] - a[1]
    dy = b[2] - a[2]
    out[0] = n
    out[1] = (a[0] * a[1] + b[0] * b[1]) / n
    out[2] = (a[0] * a[2] + b[0] * b[2]) / n
    out[3] = a[3] + b[3] + share * dx * dx
    out[4] = a[4] + b[4] + share * dx * dy
    out[5] = a[5] + b[5] + share * dy * dy


@inlined
def joint_signal(planes, i, j, c, shape, out):  # type: ignore[no-untyped-def]
    """Signal moments of channel c of the union into out (5,); shape : joint_shape of the pair."""
    a = planes.shape[i]
    b = planes.shape[j]
    share = a[0] * b[0] / shape[0]
    p = planes.signal[i, c]
    q = planes.signal[j, c]
    dv = q[0] - p[0]
    out[0] = (a[0] * p[0] + b[0] * q[0]) / shape[0]
    out[1] = p[1] + q[1] + share * (b[1] - a[1]) * dv
    out[2] = p[2] + q[2] + share * (b[2] - a[2]) * dv
    gx, gy = slopes(shape[3], shape[4], shape[5], out[1], out[2])
    out[3] = gx
    out[4] = gy


@inlined
def rise(planes, k, c, shape, signal):  # type: ignore[no-untyped-def]
    """What the joint plane (shape, signal) costs region k in channel c more than its own plane."""
    own = planes.shape[k]
    v = planes.signal[k, c]
    gx = signal[3] - v[3]
    gy = signal[4] - v[4]
    dv = signal[0] + signal[3] * (own[1] - shape[1]) + signal[4] * (own[2] - shape[2]) - v[0]
    return own[0] * dv * dv + own[3] * gx * gx + 2.0 * own[4] * gx * gy + own[5] * gy * gy


@bare
def add_planes(planes, keep, gone, shape, signal):  # type: ignore[no-untyped-def]
    """Region `keep` takes in `gone`; shape (6,) and signal (C, 5) are scratch."""
    joint_shape(planes, keep, gone, shape)
    for c in range(planes.signal.shape[1]):
        joint_signal(planes, keep, gone, c, shape, signal[c])
    for a in range(6):
        planes.shape[keep, a] = shape[a]
    for c in range(planes.signal.shape[1]):
        for a in range(5):
            planes.signal[keep, c, a] = signal[c, a]
