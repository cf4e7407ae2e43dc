"""Whitened signals made by hand, for tests of the stages behind `build_signals`."""

import numpy as np

from rcseg_core.signal.noise import NoiseModel
from rcseg_core.signal.signals import Signals


def crafted_signals(
    image,
    n_range=1,
    *,
    flags=None,
    eps=0.0,
    color_eps=0.0,
    inverse_depth=True,
    correlation=1.0,
    systematic=0.0,
):
    """Signals of a whitened (H, W, C) image: unit noise everywhere, tolerances in sigmas, unit scales."""
    image = np.ascontiguousarray(image, np.float32)
    channels = image.shape[2]
    flags = np.zeros(image.shape[:2], np.uint8) if flags is None else flags.astype(np.uint8)
    noise = NoiseModel(
        np.array([[1.0, 0.0, 0.0]] * max(n_range, 1)),
        np.ones(3),
        correlation,
        correlation,
        "by hand",
        systematic,
    )
    return Signals(
        image=image,
        cleaned=image[..., :n_range].copy(),
        cleaned_color=np.zeros((*image.shape[:2], 3), np.uint8),
        flags=flags,
        n_range=n_range,
        scale=np.ones(channels),
        offset=np.zeros(channels),
        law=np.array([1.0, 0.0, 0.0, eps, 0.0]),
        color_eps2=color_eps**2,
        slope=(10.0, 0.0),
        noise=noise,
        inverse_depth=inverse_depth,
    )
