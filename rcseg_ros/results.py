"""Every output message of one frame, made on demand and once: the node publishes them, bags hold them."""

from __future__ import annotations

from functools import cached_property
from typing import Any

from rcseg_core import RangeColorFrame, Segmentation
from rcseg_core.drawing import overlay
from rcseg_ros.conversions import Header
from rcseg_ros.messages import region_array
from rcseg_ros.outputs import (
    Make,
    cloud_message,
    edges_message,
    header_message,
    labels_message,
    picture_message,
)


class ResultMessages:
    """Results of one frame as messages of the library that `make` builds for; an attribute for each topic."""

    def __init__(self, header: Header, frame: RangeColorFrame, result: Segmentation, make: Make) -> None:
        self._header = header_message(header, make)
        self._frame = frame
        self._result = result
        self._make = make

    @cached_property
    def labels(self) -> Any:
        return labels_message(self._result.labels, self._header, self._make)

    @cached_property
    def surface_labels(self) -> Any:
        return labels_message(self._result.surface_labels, self._header, self._make)

    @cached_property
    def _surface_and_color(self) -> tuple[Any, Any]:
        return self._result.reconstruct()

    @cached_property
    def regions(self) -> Any:
        surface, _ = self._surface_and_color
        return region_array(self._frame, self._result, self._header, self._make, surface)

    @cached_property
    def edges(self) -> Any:
        return edges_message(self._result.edges, self._header, self._make)

    @cached_property
    def picture(self) -> Any:
        """(H, W, 3) uint8 RGB of the overlay, for files."""
        return overlay(self._frame.color, self._result.labels)

    @cached_property
    def overlay(self) -> Any:
        return picture_message(self.picture, self._header, self._make)

    @cached_property
    def reconstruction(self) -> Any:
        points, color = self._surface_and_color
        return cloud_message(points, color, self._result.labels, self._header, self._make)
