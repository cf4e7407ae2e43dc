"""Which image of the scene is segmented: the frame, its squares, or a pinhole's view of a scanner's grid."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rcseg_core.config import SegmenterConfig
from rcseg_core.frame import RangeColorFrame
from rcseg_core.partition.previous import Previous
from rcseg_core.resampling.reduction import LEAST_SIDE_PX, at_full_size, reduced, unreduced
from rcseg_core.resampling.views import carried_back, pinhole_view
from rcseg_core.result.segmentation import Segmentation
from rcseg_core.stages.conclusion import Clock


def found_elsewhere(
    frame: RangeColorFrame, color: NDArray[np.uint8], config: SegmenterConfig, clock: Clock,
    segment: Callable[..., Segmentation], previous: Previous | None = None,
) -> Segmentation | None:  # fmt: skip
    """The result of another image of the scene, carried to the pixels of the frame; None where it has none.

    color : (H, W, 3) uint8, normalised
    segment : what segments that image
    previous : what the last frame decided, on the pixels of the frame
    """
    view = pinhole_view(frame, color, config)
    if view is not None:  # a scanner's grid, as a pinhole camera in its centre would see it
        source, plain = view.source, config.replace({"reflectance.mode": "none"})
        if previous is not None:
            previous = previous.moved(lambda image: np.where(source < 0, 0, image.ravel()[source]))
        result = segment(view.frame, plain, previous=previous)
        return carried_back(view, result, frame, color, config)
    if config.signal.reduction > 1 and min(frame.valid.shape) >= LEAST_SIDE_PX:  # coarse to fine
        step = config.signal.reduction
        squares = reduced(frame, color, step)
        clock.lap("squares")
        if previous is not None:
            previous = previous.moved(lambda image: image[::step, ::step].copy())
        result = at_full_size(frame, color, segment(squares, unreduced(config), previous=previous), config)
        return replace(result, timings=clock.seconds | result.timings)
    return None
