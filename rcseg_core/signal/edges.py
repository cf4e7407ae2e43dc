"""Depth, orientation and colour discontinuities by mathematical morphology (section 8).

Boulanger, Blais & Cohen 1990. The morphological Laplacian |dilation + erosion - 2 s| is zero on any plane of
the signal, however oblique; it fires on creases, and an order of magnitude more on steps. In a small window
it tells steps, in a wider one and on a smoothed signal creases, where only its ridge is kept: thick bands
would kill slivers. Colour edges are the morphological gradient of the strongest channel.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.compute.parallel import over_bands, together
from rcseg_core.config import EdgesConfig
from rcseg_core.signal.signals import INVALID, Signals, local_scales

DEPTH, ORIENTATION, COLOR = 1, 2, 4
RANGE_EDGES = np.uint8(DEPTH | ORIENTATION)

#: Box that smooths the range before creases are looked for.
SMOOTH_PX = 5
#: How far smoothing lowers white noise in the Laplacian: 0.15 at its 99 % point; at this value, and five
#: sigmas, fewer than one pixel in a million fires on noise.
SMOOTH_GAIN = 0.26
#: A crease pixel is kept where its Laplacian is at least this share of the strongest within RIDGE_PX.
RIDGE_SHARE, RIDGE_PX = 0.75, 5
#: Wider than the response to one crease (orientation window plus smoothing).
TOPHAT_PX = 13


def _extremes(image: NDArray[Any], size: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Dilation and erosion with a flat square window."""
    window = np.ones((size, size), np.uint8)
    return cv2.dilate(image, window), cv2.erode(image, window)


@bare
def _widen(high, low, image, first, last, laplacian):  # type: ignore[no-untyped-def]
    """laplacian = max(laplacian, |high + low - 2 image|), the morphological Laplacian of one channel."""
    for row in range(first, last):
        for col in range(image.shape[1]):
            value = abs(high[row, col] + low[row, col] - 2 * image[row, col])
            laplacian[row, col] = max(laplacian[row, col], value)


@bare
def _tell_steps(step, cleaned, law, whole, threshold, share, first, last, out):  # type: ignore[no-untyped-def]
    """Where a Laplacian exceeds both the noise and the share of depth (whole: depth 0 in whitened units)."""
    for row in range(first, last):
        for col in range(step.shape[1]):
            value = np.float64(cleaned[row, col, 0])
            sigma = np.sqrt(local_scales(law, value)[0])
            out[row, col] = step[row, col] > max(threshold * sigma, share * (whole + value))


@bare
def _subtract(image, other, first, last):  # type: ignore[no-untyped-def]
    for row in range(first, last):
        for col in range(image.shape[1]):
            image[row, col] -= other[row, col]


@bare
def _write(  # type: ignore[no-untyped-def]
    is_step, near_step, crease, ridge, cleaned, law, crease_threshold, high, low, color_threshold, flags,
    first, last, edges,
):  # fmt: skip
    """The bits of rows first..last-1; a crease counts on the ridge of its response only."""
    for row in range(first, last):
        for col in range(edges.shape[1]):
            bits = 0
            if flags[row, col] & INVALID == 0:
                if is_step[row, col]:
                    bits |= DEPTH
                response = crease[row, col]
                # a step leaves creases in the whole smoothed neighbourhood: they belong to the step
                if response > 0 and not near_step[row, col] and response >= RIDGE_SHARE * ridge[row, col]:
                    var, _ = local_scales(law, np.float64(cleaned[row, col, 0]))
                    if response > crease_threshold * np.sqrt(var):
                        bits |= ORIENTATION
            for c in range(high.shape[2]):
                if np.float64(high[row, col, c]) - low[row, col, c] > color_threshold:
                    bits |= COLOR
            edges[row, col] = bits


def detect_edges(signals: Signals, config: EdgesConfig) -> NDArray[np.uint8]:
    """The edge map.

    Returns
    -------
    (H, W) uint8 bit mask: 1 depth, 2 orientation, 4 colour. Invalid pixels carry no range edge.
    """
    shape, law = signals.flags.shape, signals.law
    responses: list[Any] = [None, None]

    def of_range() -> None:
        responses[0] = _range_responses(signals, config)

    def of_color() -> None:
        responses[1] = _extremes(signals.cleaned_color, 3)

    together(of_range, of_color)
    is_step, near_step, crease, ridge = responses[0]
    high, low = responses[1]
    # smoothing lowers correlated noise less
    gain = SMOOTH_GAIN * float(np.sqrt(signals.noise.range_correlation))
    edges = np.empty(shape, np.uint8)
    over_bands(
        shape[0],
        lambda _, first, last: _write(
            is_step, near_step, crease, ridge, signals.cleaned, law, config.orientation_threshold * gain,
            high, low, config.color_threshold, signals.flags, first, last, edges,
        ),
    )  # fmt: skip
    return edges


def _range_responses(signals: Signals, config: EdgesConfig) -> tuple[NDArray[Any], ...]:
    """Where steps are and what is near them; the response to creases, and its largest value around."""
    shape = signals.flags.shape
    step, crease = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    for c in range(signals.n_range):
        channel = np.ascontiguousarray(signals.cleaned[..., c])
        _widen(*_extremes(channel, 3), channel, 0, shape[0], step)
        smooth = cv2.blur(channel, (SMOOTH_PX, SMOOTH_PX))
        _widen(*_extremes(smooth, config.orientation_window), smooth, 0, shape[0], crease)
    # a grid has no depth that a step could be a share of
    whole = float(signals.offset[0] / signals.scale[0]) if signals.inverse_depth else 0.0
    share = config.depth_step if signals.inverse_depth else 0.0
    is_step = np.empty(shape, np.uint8)
    _tell_steps(
        step, signals.cleaned, signals.law, whole, config.depth_threshold, share, 0, shape[0], is_step
    )
    # the filters see a mirrored image beyond the border: no crease there
    rim = config.orientation_window // 2 + SMOOTH_PX // 2
    crease[:rim] = crease[-rim:] = 0
    crease[:, :rim] = crease[:, -rim:] = 0
    # top-hat: a curved surface has a second difference everywhere, a crease only along a line
    opened = cv2.morphologyEx(crease, cv2.MORPH_OPEN, np.ones((TOPHAT_PX, TOPHAT_PX), np.uint8))
    _subtract(crease, opened, 0, shape[0])
    ridge = cv2.dilate(crease, np.ones((RIDGE_PX, RIDGE_PX), np.uint8))
    reach = config.orientation_window + SMOOTH_PX - 1
    near_step = cv2.dilate(is_step, np.ones((reach, reach), np.uint8))
    return is_step, near_step, crease, ridge
