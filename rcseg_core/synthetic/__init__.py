"""Analytic scenes with exact truth for tuning, tests and reports; nothing in the pipeline imports them."""

from .paint import LEAST_DIFFERENCE
from .scene import FAMILIES, SCANNER_FAMILIES, SyntheticScene, default_camera, make_scene
from .sensor import SensorOptions
from .sequence import make_tabletop_sequence

__all__ = [
    "FAMILIES",
    "LEAST_DIFFERENCE",
    "SCANNER_FAMILIES",
    "SensorOptions",
    "SyntheticScene",
    "default_camera",
    "make_scene",
    "make_tabletop_sequence",
]
