"""Step 2 on the colour of known surfaces: the widest windows of all are surfaces of one colour.

Most surfaces have one first-order colour but for some print, spots or shadows. One model for such a surface
is its seed, where the paper would place a hundred windows and group them again; only what it does not predict
is left to the windows.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.compute.parallel import over_bands
from rcseg_core.decision.generalization import residuals_by_degree
from rcseg_core.models.moments import accumulate, region_boxes
from rcseg_core.models.polynomials import Models, fit_models
from rcseg_core.signal.signals import INVALID, MISFIT, Signals
from rcseg_core.signal.units import UNIT_PX

#: Share of a surface that one model must predict, and its least pixels in every ROW_STEP-th row.
MIN_PLAIN, LEAST_PLAIN, ROW_STEP = 0.8, 100, 4
#: A part that hangs together makes a seed from this area on.
LEAST_PART = 19 * 19


@bare
def _predicted(image, usable, within, center, coef, accepted, limit, first, last, out):  # type: ignore[no-untyped-def]
    """Rows of out: 1 where the plane of an accepted surface predicts a usable pixel within `limit`, 2 where a
    pixel was not measured, else 0.

    center (N + 1, 2), coef (N + 1, 3, 3): planes value, slope in x, slope in y; limit : squared distance
    """
    for row in range(first, last):
        for col in range(within.shape[1]):
            k = within[row, col]
            out[row, col] = 0
            if k <= 0 or not accepted[k] or usable[row, col] != 0:
                if k > 0 and accepted[k] and usable[row, col] == INVALID:
                    out[row, col] = 2
                continue
            x = (col - center[k, 0]) / UNIT_PX
            y = (row - center[k, 1]) / UNIT_PX
            far = 0.0
            for c in range(3):
                d = image[row, col, c] - coef[k, c, 0] - coef[k, c, 1] * x - coef[k, c, 2] * y
                far += d * d
            out[row, col] = far <= limit


@bare
def _number(seeds, number, plain):  # type: ignore[no-untyped-def]
    """New numbers, 0 on pixels that only hang the others together."""
    for row in range(seeds.shape[0]):
        for col in range(seeds.shape[1]):
            seeds[row, col] = number[seeds[row, col]] if plain[row, col] == 1 else 0


def _planes(models: Models) -> NDArray[np.float64]:
    """(N + 1, 3, 3) value and slopes of first-degree models."""
    return np.stack([models.coef[..., 0, 0], models.coef[..., 1, 0], models.coef[..., 0, 1]], axis=-1)


def plain_surfaces(
    signals: Signals, blocked: NDArray[np.uint8], within: NDArray[np.int32], cut: float, noise_factor: float
) -> tuple[NDArray[np.int32], int]:
    """Seeds that cover the plain part of each surface.

    A model is fitted to every fourth row, twice without what it does not predict. Where MIN_PLAIN of the
    surface remain and their residual passes as noise, as it must in any window, the connected pixels that
    the model predicts are seeds; missing pixels do not part them.

    Parameters
    ----------
    signals : of colour alone
    blocked : (H, W) uint8, non-zero on edges and between surfaces
    within : (H, W) int32, the surfaces
    cut : squared residual, in sigmas, beyond which a pixel is not predicted
    noise_factor : by which the residual variance may exceed the noise, besides the tolerance

    Returns
    -------
    (H, W) int32, 0 where nothing is plain, seeds 1..count elsewhere; count
    """
    nothing = np.zeros(within.shape, np.int32)
    count = int(within.max(initial=0))
    if count == 0:
        return nothing, 0
    usable: NDArray[np.uint8] = np.where(blocked > 0, np.uint8(MISFIT), signals.flags)
    rows = slice(ROW_STEP // 2, None, ROW_STEP)
    image, part = np.ascontiguousarray(signals.image[rows]), np.ascontiguousarray(within[rows])
    left_out = np.ascontiguousarray(usable[rows])
    # half of the tolerance, as for the pixels of a window
    limit = cut * (1.0 + 0.25 * signals.color_eps2 / 3.0)
    first = np.ones((count + 1, 2), np.int64)
    accepted = np.ones(count + 1, np.bool_)
    boxes, kept = region_boxes(part, count), np.empty_like(left_out)
    whole = moments = accumulate(image, left_out, part, count, 1, boxes)
    for wider in (4.0, 1.0):
        models = fit_models(moments, first, 0, planes=True)
        _predicted(
            image, left_out, part, models.center, _planes(models), accepted, wider * limit, 0, len(part), kept
        )
        moments = accumulate(image, kept ^ np.uint8(1), part, count, 1, boxes)
    n = moments.count
    dof = np.maximum(n - 3, 1)
    rss = residuals_by_degree(moments, 0, 1)[:, 1, 0]
    accepted = rss <= dof * 3 * (noise_factor + 4.0 / np.sqrt(dof)) + n * 0.25 * signals.color_eps2
    accepted &= n >= np.maximum(MIN_PLAIN * whole.count, LEAST_PLAIN)
    if not accepted[1:].any():
        return nothing, 0
    models = fit_models(moments, first, 0, planes=True)
    # from every fourth row back to all rows
    center, planes = models.center * (1, ROW_STEP) + (0, ROW_STEP // 2), _planes(models) / (1, 1, ROW_STEP)
    plain = np.empty(within.shape, np.uint8)
    over_bands(
        len(plain),
        lambda _, a, b: _predicted(
            signals.image, usable, within, center, planes, accepted, limit, a, b, plain
        ),
    )
    seeds, areas = cv2.connectedComponentsWithStats(plain, connectivity=4)[1:3]
    large = areas[:, cv2.CC_STAT_AREA] >= LEAST_PART
    large[0] = False
    found = int(np.count_nonzero(large))
    number = np.where(large, np.cumsum(large), 0).astype(np.int32)
    _number(seeds, number, plain)
    return seeds, found
