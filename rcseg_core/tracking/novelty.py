"""How much of the random error is new in each frame: planes that two frames show tell it.

What is random from pixel to pixel need not be from frame to frame: the steps of a disparity, and where
borders lie, are much the same while nothing moves. So a mean of frames is worth less than their number says.
Two measurements of one plane differ by what is new in both alone: over what both are stated to be off by,
that is the share of the error that averages away. The rest is systematic.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
#: Measurements for which it is held that all is new, before any tell; chi-squared by degree of freedom beyond
#: which a difference counts for no more, since something moved or was cut otherwise.
FIRST, CAP = 3.0, 4.0


class Novelty:
    """The running mean over all planes of a sensor.

    Attributes
    ----------
    share : of the variance that is stated as random, what is new in each frame; 0 to 1
    """

    def __init__(self) -> None:
        self._total = self._count = FIRST

    @property
    def share(self) -> float:
        return min(self._total / self._count, 1.0)

    def add(self, far: Array) -> None:
        """Take in two measurements of each of some planes.

        Parameters
        ----------
        far : (n,) squared differences, see `planes.misses`; NaN tells nothing
        """
        told = far[~np.isnan(far)] / 3.0
        self._total += float(np.minimum(told, CAP).sum())
        self._count += len(told)
