"""How well a shape fits its cells, in one pass over them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.decision.rule import error_budget
from rcseg_core.shapes.cells import Cells
from rcseg_core.shapes.distances import PLANE, _complete, _miss, _ray_miss
from rcseg_core.shapes.fitting import Shape, shape_vector

Array = NDArray[np.float64]

#: Residuals beyond this many deviations count for no more: a crumb on a table makes it no less a plane.
CLIP = 4.0


class Score(NamedTuple):
    """How m cells miss a shape.

    chi2 : of the cells, outliers clipped
    excess : sum of the squared misfits that are allowed, over the variance of each cell
    facing : mean product of gradient and point, m; negative where the outside is seen
    rms2_m, rms2_sigma : mean square distance of single pixels, m^2, and over the noise along the ray
    missed, noise : mean square distance of the cells and its noise, m^2
    gradients : (m, 3) of the distance
    """

    chi2: float
    excess: float
    facing: float
    rms2_m: float
    rms2_sigma: float
    missed: float
    noise: float
    gradients: Array


@bare
def _score(kind, vector, frame, cells, allowance, scatter, row, gradients, sums):  # type: ignore[no-untyped-def]
    """Sums of `Score`, those of means times the pixels; the last one is the pixels.

    cells : points, spread, pixels, worth, tolerance2 of `Cells`
    allowance : squared misfit that is allowed, over variance: of the systematic part, and share of the rest
    """
    points, spread, pixels, worth, tolerance2 = cells
    for i in range(points.shape[0]):
        if kind != PLANE and spread.shape[2] == 1:
            whitened, sigma, gx, gy, gz, _ = _ray_miss(
                kind, vector, points[i, 0], points[i, 1], points[i, 2], spread[i, 0, 0], spread[i, 1, 0],
                spread[i, 2, 0],
            )  # fmt: skip
            gradients[i, 0], gradients[i, 1], gradients[i, 2] = gx, gy, gz
        else:
            whitened, sigma = _miss(kind, vector, frame, points[i], spread[i], row, gradients[i])
        excess = worth[i] * (allowance[0] + allowance[1] * (1.0 + tolerance2[i]))
        variance = sigma * sigma
        missed = whitened * whitened * variance
        # a pixel misses the mean of its cell by noise; the mean misses the shape by less noise, and by misfit
        one = worth[i] * variance / max(scatter, 1.0)
        beyond = scatter * (1.0 - 1.0 / pixels[i])
        facing = 0.0
        for c in range(3):
            facing += gradients[i, c] * points[i, c]
        sums[0] += min(whitened * whitened, CLIP * CLIP * (1.0 + excess))
        sums[1] += excess
        sums[2] += pixels[i] * facing
        sums[3] += pixels[i] * (beyond * one + missed)
        sums[4] += pixels[i] * (beyond + missed / one)
        sums[5] += pixels[i] * missed
        sums[6] += pixels[i] * variance
        sums[7] += pixels[i]


def allowance(cells: Cells, share: float) -> tuple[float, float]:
    """Squared misfit that is allowed, over the variance of a pixel: what the systematic error explains where
    three coefficients follow the surface; and how much of sigma and of the tolerance, squared."""
    return float(error_budget(0.0, cells.systematic2, 1.0, 3)), share**2


def score(shape: Shape, cells: Cells, share: float) -> Score:
    """How the cells miss a shape; share : of sigma and of the tolerance, that they may miss it by (rms)."""
    frame, gradients, sums = np.empty((2, 3)), np.empty(cells.points.shape), np.zeros(8)
    _complete(shape.direction, frame)
    table = cells.points, cells.spread, cells.pixels, cells.worth, cells.tolerance2
    _score(
        shape.kind, shape_vector(shape), frame, table, allowance(cells, share), float(cells.scatter),
        np.empty(5), gradients, sums,
    )  # fmt: skip
    chi2, excess, *totals, pixels = sums.tolist()
    facing, rms2_m, rms2_sigma, missed, noise = (total / pixels for total in totals)
    return Score(chi2, excess, facing, rms2_m, rms2_sigma, missed, noise, gradients)
