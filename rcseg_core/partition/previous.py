"""What the last frame decided, as this one shows it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rcseg_core.errors import InputError


@dataclass(frozen=True)
class Previous:
    """Label images of the last frame, carried to the pixels of this one.

    Attributes
    ----------
    surface_labels, labels : (H, W) int32, surfaces and regions of the last frame; 0: not known; None: none is
    """

    surface_labels: NDArray[np.int32] | None
    labels: NDArray[np.int32] | None

    def check(self, shape: tuple[int, ...]) -> None:
        """That both are label images of a frame of this shape.

        Raises
        ------
        InputError
        """
        for name, image in (("surface_labels", self.surface_labels), ("labels", self.labels)):
            if image is not None and (image.shape != shape or image.dtype != np.int32 or image.min() < 0):
                raise InputError(
                    f"previous.{name}: expected labels of 0 and more, int32 of shape {shape} as the "
                    f"frame, got {image.dtype} of shape {image.shape}"
                )

    def moved(self, move: Callable[[NDArray[np.int32]], NDArray[np.int32]]) -> Previous:
        """The same on the pixels of another image of the scene."""
        surfaces, regions = self.surface_labels, self.labels
        return Previous(
            None if surfaces is None else move(surfaces), None if regions is None else move(regions)
        )
