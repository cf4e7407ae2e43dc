"""Analytic scenes with exact truth for tuning, tests and reports; nothing in the pipeline imports them."""

from .journey import JourneyFrame, make_journey
from .paint import LEAST_DIFFERENCE
from .scene import FAMILIES, SCANNER_FAMILIES, SyntheticScene, default_camera, make_scene
from .sensor import SensorOptions
from .sequence import make_tabletop_sequence
from .terrain import Terrain, make_terrain

__all__ = [
    "FAMILIES",
    "LEAST_DIFFERENCE",
    "SCANNER_FAMILIES",
    "JourneyFrame",
    "SensorOptions",
    "SyntheticScene",
    "Terrain",
    "default_camera",
    "make_journey",
    "make_scene",
    "make_tabletop_sequence",
    "make_terrain",
]
