"""Colours of the categories: the same in markers, pictures and the page."""

from __future__ import annotations

import numpy as np

#: RGB, 0 to 255, by the names of `rcseg_core.world.CATEGORIES`.
CATEGORY_COLORS = {
    "unlabelled": np.array([0, 0, 0]),
    "floor": np.array([88, 160, 88]),
    "horizontal": np.array([80, 140, 230]),
    "ceiling": np.array([170, 170, 190]),
    "vertical": np.array([225, 150, 70]),
    "inclined": np.array([235, 215, 80]),
    "sphere": np.array([220, 80, 140]),
    "cylinder": np.array([150, 100, 220]),
    "other": np.array([130, 120, 110]),
}
