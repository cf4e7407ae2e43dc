"""Every output message of one frame, made on demand and once: the node publishes them, bags hold them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_core import RangeColorFrame, Segmentation, Surface
from rcseg_core.result.drawing import overlay
from rcseg_core.tracking import Tracks
from rcseg_core.world import GROUND, OBSTACLE, World
from rcseg_ros.frames.conversions import Header
from rcseg_ros.frames.up import NOTHING_TOLD, Told
from rcseg_ros.results.cdr import Serialized
from rcseg_ros.results.clouds import labelled_cloud, part_cloud
from rcseg_ros.results.marker_bytes import marker_array
from rcseg_ros.results.markers import draw
from rcseg_ros.results.messages import region_array
from rcseg_ros.results.outputs import (
    Make,
    class_message,
    cloud_message,
    edges_message,
    header_message,
    labels_message,
    picture_message,
)
from rcseg_ros.results.tracks import track_array, track_image
from rcseg_ros.results.world import object_array, polygon_instances


@dataclass(frozen=True)
class Named:
    """The tracks of a frame.

    fixed_frame : frame_id that poses are given in
    images : whether label images show track ids in place of labels
    """

    tracks: Tracks
    fixed_frame: str = ""
    images: bool = False


class ResultMessages:
    """Results of one frame as messages of the library that `make` builds for; an attribute for each topic.

    What needs to know where up is, is None where that is unknown; `polygons` is a list of messages; markers
    and the clouds of points are serialised already.
    """

    def __init__(
        self,
        header: Header,
        frame: RangeColorFrame,
        result: Segmentation,
        make: Make,
        geometry: str = "",
        told: Told = NOTHING_TOLD,
    ) -> None:
        self.stamp_ns = header.stamp_ns
        self.named: Named | None = None  # set before a message that holds names is asked for
        self._input = header
        self._header = header_message(header, make)
        self._frame = frame
        self._result = result
        self._make = make
        self._geometry = geometry
        self.told = told

    @property
    def header(self) -> Any:
        """std_msgs/Header of all messages."""
        return self._header

    @property
    def surfaces(self) -> Sequence[Surface]:
        """The surfaces of the result."""
        return self._result.surfaces

    @cached_property
    def world(self) -> World:
        """What a robot takes from the result."""
        if self.told.vector is None:
            return self._result.world()
        return self._result.world(self.told.vector, source=self.told.source)

    @property
    def known_world(self) -> World | None:
        """The world, if some message needed it."""
        return self.__dict__.get("world")

    @property
    def label_array(self) -> Any:
        """(H, W) int32 labels themselves."""
        return self._result.labels

    @cached_property
    def labels(self) -> Any:
        return self._label_image("region", self._result.labels)

    @cached_property
    def surface_labels(self) -> Any:
        return self._label_image("surface", self._result.surface_labels)

    def _label_image(self, kind: str, labels: NDArray[np.int32]) -> Any:
        named = self.named
        shown = track_image(named.tracks, kind) if named is not None and named.images else labels
        return labels_message(shown, self._header, self._make)

    def track_ids(self, kind: str) -> NDArray[np.int32] | None:
        """(N + 1,) label of a kind to the id of its track, 0: none; None where the frame is not tracked."""
        return None if self.named is None else self.named.tracks.ids(kind)

    @cached_property
    def tracks(self) -> Any:
        """None where the frame is not tracked."""
        named = self.named
        return named and track_array(named.tracks, self._input, named.fixed_frame, self._make)

    @cached_property
    def _surface_and_color(self) -> tuple[Any, Any]:
        return self._result.reconstruct()

    @cached_property
    def regions(self) -> Any:
        surface, _ = self._surface_and_color
        return region_array(
            self._frame, self._result, self._header, self._make, surface, self._geometry, self.world,
            None if self.named is None else self.named.tracks,
        )  # fmt: skip

    @cached_property
    def edges(self) -> Any:
        return edges_message(self._result.edges, self._header, self._make)

    @cached_property
    def picture(self) -> Any:
        """(H, W, 3) uint8 RGB of the overlay; a track keeps its colour from frame to frame."""
        named = self.named
        shown = self._result.labels if named is None else track_image(named.tracks, "region")
        return overlay(self._frame.color, shown)

    @cached_property
    def overlay(self) -> Any:
        return picture_message(self.picture, self._header, self._make)

    @cached_property
    def reconstruction(self) -> Any:
        points, color = self._surface_and_color
        return cloud_message(points, color, self._result.labels, self._header, self._make)

    @cached_property
    def markers(self) -> Serialized:
        return marker_array(self._header, draw(self.regions, self._result.labels, self.objects))

    @cached_property
    def class_mask(self) -> Any:
        if self.world.up is None:
            return None
        return class_message(self.world.class_mask, self._header, self._make)

    @cached_property
    def object_labels(self) -> Any:
        return self._label_image("object", self.world.object_labels)

    @cached_property
    def objects(self) -> Any:
        return object_array(self.world, self._header, self._make, self.track_ids("object"))

    @cached_property
    def polygons(self) -> list[Any]:
        surfaces, ids = self._result.surfaces, self.track_ids("surface")
        return polygon_instances(surfaces, self.world, self._header, self._make, ids)

    @cached_property
    def ground_points(self) -> Any:
        return self._part(GROUND)

    @cached_property
    def obstacle_points(self) -> Any:
        return self._part(OBSTACLE)

    def _part(self, kind: int) -> Any:
        if self.world.ground is None:
            return None
        labels, surfaces = self._result.labels, self._result.surface_labels
        chosen = self.world.ground == kind
        return part_cloud(self._frame.points, chosen, labels, surfaces, self._header)

    @cached_property
    def labelled_points(self) -> Any:
        frame, result, world = self._frame, self._result, self.world
        return labelled_cloud(
            frame.points, frame.color, result.labels, result.surface_labels, world.object_labels,
            world.class_mask, self._header,
        )  # fmt: skip
