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

from rcseg_core.config import EdgesConfig
from rcseg_core.signals import INVALID, Signals

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


def _laplacian(image: NDArray[np.float32], size: int) -> NDArray[np.float32]:
    """|dilate + erode - 2 image| with a flat square window."""
    window = np.ones((size, size), np.uint8)
    out: NDArray[Any] = np.abs(cv2.dilate(image, window) + cv2.erode(image, window) - 2 * image)
    return out


def detect_edges(signals: Signals, config: EdgesConfig) -> NDArray[np.uint8]:
    """The edge map.

    Returns
    -------
    (H, W) uint8 bit mask: 1 depth, 2 orientation, 4 colour. Invalid pixels carry no range edge.
    """
    n_range = signals.n_range
    step = np.zeros(signals.flags.shape, np.float32)
    crease = np.zeros(signals.flags.shape, np.float32)
    for c in range(n_range):
        channel = np.ascontiguousarray(signals.cleaned[..., c])
        np.maximum(step, _laplacian(channel, 3), out=step)
        smooth = cv2.blur(channel, (SMOOTH_PX, SMOOTH_PX))
        np.maximum(crease, _laplacian(smooth, config.orientation_window), out=crease)
    sigma, depth_share = _local_sigma(signals)
    is_step = step > np.maximum(config.depth_threshold * sigma, config.depth_step * depth_share)

    # the filters see a mirrored image beyond the border: no crease there
    rim = config.orientation_window // 2 + SMOOTH_PX // 2
    crease[:rim] = crease[-rim:] = 0
    crease[:, :rim] = crease[:, -rim:] = 0
    # top-hat: a curved surface has a second difference everywhere, a crease only along a line
    crease -= cv2.morphologyEx(crease, cv2.MORPH_OPEN, np.ones((TOPHAT_PX, TOPHAT_PX), np.uint8))
    ridge = crease >= RIDGE_SHARE * cv2.dilate(crease, np.ones((RIDGE_PX, RIDGE_PX), np.uint8))
    # smoothing lowers correlated noise less
    gain = SMOOTH_GAIN * np.sqrt(signals.noise.range_correlation)
    is_crease = ridge & (crease > config.orientation_threshold * gain * sigma)
    # a step leaves creases in the whole smoothed neighbourhood: they belong to the step
    reach = config.orientation_window + SMOOTH_PX - 1
    near_step = cv2.dilate(is_step.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0
    is_crease &= ~near_step

    color = np.zeros(signals.flags.shape, np.float32)
    window = np.ones((3, 3), np.uint8)
    for c in range(n_range, signals.image.shape[2]):
        channel = np.ascontiguousarray(signals.cleaned[..., c])
        gradient = cv2.dilate(channel, window) - cv2.erode(channel, window)
        np.maximum(color, gradient * np.float32(signals.scale[c]), out=color)
    edges = np.zeros(signals.flags.shape, np.uint8)
    measured = signals.flags & INVALID == 0
    edges[is_step & measured] |= DEPTH
    edges[is_crease & measured] |= ORIENTATION
    edges[color > config.color_threshold] |= COLOR
    return edges


def _local_sigma(signals: Signals) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Noise, and the size of a step of 100 % of depth (of the extent for grids), in whitened units."""
    law = signals.law
    value = signals.cleaned[..., 0]
    sigma = np.maximum(law[0] + value * (law[1] + value * law[2]), 0.2)
    if not signals.inverse_depth:
        return sigma.astype(np.float32), np.zeros_like(value)
    whole = signals.offset[0] / signals.scale[0] + value
    return sigma.astype(np.float32), whole.astype(np.float32)
