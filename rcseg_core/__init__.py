"""rcseg_core: range and colour images into regions with Bezier models of shape and colour. Knows no ROS."""

from rcseg_core.bezier import BezierPatch
from rcseg_core.config import SegmenterConfig
from rcseg_core.errors import ConfigError, InputError, RcsegError
from rcseg_core.frame import PinholeCamera, RangeColorFrame
from rcseg_core.hierarchy import Hierarchy
from rcseg_core.pipeline import segment
from rcseg_core.primitives import Primitive
from rcseg_core.segmentation import Region, Segmentation, Surface

__all__ = [
    "BezierPatch",
    "ConfigError",
    "Hierarchy",
    "InputError",
    "PinholeCamera",
    "Primitive",
    "RangeColorFrame",
    "RcsegError",
    "Region",
    "Segmentation",
    "SegmenterConfig",
    "Surface",
    "segment",
]
