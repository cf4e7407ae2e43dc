"""rcseg_core: range and colour images into regions with Bezier models of shape and colour. Knows no ROS."""

from rcseg_core.config import SegmenterConfig
from rcseg_core.errors import ConfigError, InputError, RcsegError
from rcseg_core.frame import PinholeCamera, RangeColorFrame
from rcseg_core.graph.hierarchy import Hierarchy
from rcseg_core.models.bezier import BezierPatch
from rcseg_core.pipeline import segment
from rcseg_core.result.segmentation import Region, Segmentation, Surface
from rcseg_core.shapes.local_forms import LocalCylinder, LocalSphere
from rcseg_core.shapes.plane_forms import LocalPlane
from rcseg_core.shapes.primitives import Primitive

__all__ = [
    "BezierPatch",
    "ConfigError",
    "Hierarchy",
    "InputError",
    "LocalCylinder",
    "LocalPlane",
    "LocalSphere",
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
