"""The result: label images, regions with their Bezier patches, the merge tree, the image they stand for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rcseg_core.config import WorldConfig
from rcseg_core.errors import InputError
from rcseg_core.frame import PinholeCamera
from rcseg_core.graph.components import by_size
from rcseg_core.graph.grouping import Grouped
from rcseg_core.graph.hierarchy import Hierarchy, Scale, TreeBuilder, join_heights
from rcseg_core.models.bezier import BezierPatch
from rcseg_core.models.polynomials import Models
from rcseg_core.result.rendering import render
from rcseg_core.shapes.cells import gather_cells
from rcseg_core.shapes.local_forms import LocalCylinder, LocalSphere, local_forms
from rcseg_core.shapes.plane_forms import LocalPlane
from rcseg_core.shapes.primitives import Primitive, recognise
from rcseg_core.signal.noise import NoiseModel
from rcseg_core.signal.signals import Signals
from rcseg_core.world import Boundary, Object, World
from rcseg_core.world.outlines import inset
from rcseg_core.world.scene import Scene
from rcseg_core.world.up import told_up

if TYPE_CHECKING:
    from shapely import MultiPolygon, Polygon


@dataclass(frozen=True)
class Region:
    """One region of the partition.

    Attributes
    ----------
    label : value in `Segmentation.labels`
    surface : value in `Segmentation.surface_labels`
    pixel_count : assigned pixels
    box : (row_min, col_min, row_max, col_max), inclusive
    centroid : (3,) float64, mean of the measured points, m; NaN without any
    normal : (3,) float64, unit normal of the range patch at the middle of the region, towards the sensor
    neighbors : labels of the regions that touch this one, ascending
    range_patch, color_patch : BezierPatch
    persistence : how long it lasts along the merge tree, see there
    """

    label: int
    surface: int
    pixel_count: int
    box: tuple[int, int, int, int]
    centroid: NDArray[np.float64]
    normal: NDArray[np.float64]
    neighbors: tuple[int, ...]
    range_patch: BezierPatch
    color_patch: BezierPatch
    lifetimes: Callable[[], NDArray[np.float64]] | None = field(default=None, repr=False, compare=False)

    @property
    def persistence(self) -> float:
        """Level at which the region merges into a larger one over that at which it comes to be; 1 or more.

        inf where it never merges. A level below that of one sigma of noise counts as that of one sigma
        (`Scale.noise_level`), since there is nothing to see at it. NaN for a region of no segmentation.
        """
        return float("nan") if self.lifetimes is None else float(self.lifetimes()[self.label])


@dataclass(frozen=True)
class Surface:
    """One continuous surface: a union of regions, and the shape that it has.

    Attributes
    ----------
    label : value in `Segmentation.surface_labels`
    pixel_count : assigned pixels
    box : (row_min, col_min, row_max, col_max), inclusive
    regions : labels of the regions that lie on it, ascending
    primitive : Primitive; its kind is "none" where no plane, sphere or cylinder is the surface, or where the
        pixels do not tell
    candidates : the primitives that were tried, as fitted, simplest first; what speaks against them is theirs
    plane, sphere, cylinder : the primitive in its minimal local form, where it is of that kind; else None
    category, boundary, polygon, ... : what a robot takes from it, by the result's own `Segmentation.world`
    """

    label: int
    pixel_count: int
    box: tuple[int, int, int, int]
    regions: tuple[int, ...]
    primitive: Primitive
    candidates: tuple[Primitive, ...]
    local: LocalPlane | LocalSphere | LocalCylinder | None = field(default=None, repr=False)
    see: Callable[[], World] | None = field(default=None, repr=False, compare=False)

    @property
    def plane(self) -> LocalPlane | None:
        return self.local if isinstance(self.local, LocalPlane) else None

    @property
    def sphere(self) -> LocalSphere | None:
        return self.local if isinstance(self.local, LocalSphere) else None

    @property
    def cylinder(self) -> LocalCylinder | None:
        return self.local if isinstance(self.local, LocalCylinder) else None

    @property
    def _world(self) -> World:
        if self.see is None:
            raise InputError("a surface of no segmentation: take it from `result.surfaces`")
        return self.see()

    @property
    def category(self) -> str:
        """ "floor", "horizontal", "ceiling", "vertical", "inclined", "sphere", "cylinder" or "other"; planes
        are "other" where up is unknown."""
        return self._world.categories[self.label - 1].name

    @property
    def category_probability(self) -> float:
        """Of `category`; NaN for planes where up is unknown."""
        return self._world.categories[self.label - 1].probability

    @property
    def boundary(self) -> Boundary:
        """Where the surface ends, in the image and in 3-D."""
        return self._world.boundaries[self.label - 1]

    @property
    def polygons(self) -> tuple[Polygon, ...]:
        """Of planes, all parts as shapely Polygons with holes, in x, y of ``plane.pose``, m, the largest
        first; () for other surfaces."""
        return self.boundary.polygons

    @property
    def polygon(self) -> Polygon | None:
        """The largest of `polygons`; None for a surface that is no plane."""
        return self.polygons[0] if self.polygons else None

    def polygon_inset(self, distance_m: float) -> Polygon | MultiPolygon | None:
        """`polygon` without what is nearer than a distance to its outline or to a hole; it may be empty.

        Raises
        ------
        InputError
            For a distance that is negative or not finite.
        """
        if not 0 <= distance_m < float("inf"):
            raise InputError(f"distance_m = {distance_m}: expected metres, 0 or more")
        return None if self.polygon is None else inset(self.polygon, distance_m)


@dataclass(frozen=True)
class Segmentation:
    """What `segment` returns.

    Attributes
    ----------
    labels : (H, W) int32; 0 unlabelled, 1..N regions of one surface and one colour model, largest first
    surface_labels : (H, W) int32; 0 unlabelled, 1..M continuous surfaces, unions of regions
    edges : (H, W) uint8 bit mask: depth 1, orientation 2, colour 4
    noise : the NoiseModel that was used
    timings : seconds by stage, in order
    camera : PinholeCamera or None, that of the frame
    """

    labels: NDArray[np.int32]
    surface_labels: NDArray[np.int32]
    edges: NDArray[np.uint8]
    timings: dict[str, float]
    camera: PinholeCamera | None
    measure: Callable[[], tuple[Signals, Models]] = field(repr=False)
    tree: Hierarchy = field(repr=False)
    range_tree: Hierarchy | None = field(repr=False)
    leaves: NDArray[np.int32] = field(repr=False)
    range_leaves: NDArray[np.int32] | None = field(repr=False)
    nodes: NDArray[np.int64] = field(repr=False)
    coarsen: Callable[[], Grouped] = field(repr=False)
    describe: Callable[[], Sequence[Region]] = field(repr=False)
    world_config: WorldConfig = field(default=WorldConfig(), repr=False)
    #: The result in the virtual camera that a scanner's grid was segmented in; None where it was not.
    view: Segmentation | None = field(default=None, repr=False)

    @cached_property
    def _measured(self) -> tuple[Signals, Models]:
        return self.measure()

    @property
    def signals(self) -> Signals:
        """The whitened signals of the frame."""
        return self._measured[0]

    @property
    def models(self) -> Models:
        """The whitened model of each region."""
        return self._measured[1]

    @property
    def noise(self) -> NoiseModel:
        """The NoiseModel of this frame."""
        return self.signals.noise

    @cached_property
    def regions(self) -> Sequence[Region]:
        """All regions, ``regions[i].label == i + 1``; described on first use."""
        return [replace(region, lifetimes=self._merging.persistence) for region in self.describe()]

    @cached_property
    def scale(self) -> Scale:
        """What the levels of the merge tree are in metres and in sigmas."""
        return _scale(self.signals, self.view)

    @cached_property
    def _merging(self) -> _Merging:
        return _Merging(
            self.tree, self.range_tree, self.labels, self.leaves, self.range_leaves, self.nodes, self.coarsen,
            self.measure, self.view,
        )  # fmt: skip

    def persistence(self) -> NDArray[np.float64]:
        """(N + 1,) persistence of regions 1..N, see `Region.persistence`; index 0 is of no meaning."""
        return self._merging.persistence()

    @cached_property
    def _shapes(self) -> Sequence[Surface]:
        """The surfaces, before anybody looks at the world."""
        cells = gather_cells(self.labels, self.surface_labels, self.signals, self.models, self.camera)
        parts: list[list[Region]] = [[] for _ in range(len(cells) + 1)]
        for region in self.regions:
            parts[region.surface].append(region)
        recognised = [recognise(part) for part in cells]
        forms = local_forms([found for found, _ in recognised], cells, self.noise)
        surfaces = []
        for s, ((found, candidates), form) in enumerate(zip(recognised, forms, strict=True), start=1):
            rows_0, cols_0, rows_1, cols_1 = zip(*(region.box for region in parts[s]), strict=True)
            box = min(rows_0), min(cols_0), max(rows_1), max(cols_1)
            pixels, labels = sum(r.pixel_count for r in parts[s]), tuple(r.label for r in parts[s])
            surfaces.append(Surface(s, pixels, box, labels, found, candidates, form))
        return surfaces

    @cached_property
    def surfaces(self) -> Sequence[Surface]:
        """All surfaces, ``surfaces[i].label == i + 1``, with the primitives they are; found on first use."""
        return [replace(surface, see=self._see) for surface in self._shapes]

    @cached_property
    def _scene(self) -> Scene:
        shapes, measured = self._shapes, self._measured  # values: with this result itself it would be a cycle
        return Scene(
            self.labels, self.surface_labels, self.camera, lambda: measured, lambda: shapes, self.world_config
        )

    @cached_property
    def _see(self) -> Callable[[], World]:
        return cache(partial(_look, self._scene))

    def world(self, up: object = None, up_covariance: object = None, source: str = "given") -> World:
        """What a robot takes from the result: classes, ground and obstacles, boundaries, objects.

        Parameters
        ----------
        up : (3,), the direction away from the ground in the sensor's frame, of any length; None: as the
            configuration has it (`world.up_from`)
        up_covariance : (3, 3) of its unit vector, rad^2; None: `world.up_sigma` for both tilts
        source : where it comes from, for whoever reads `World.up`

        Returns
        -------
        World; without an up always the same one, which `surfaces`, `objects` and `object_labels` are told by

        Raises
        ------
        InputError
            For an up or a covariance that is none.
        """
        if up is None and up_covariance is None:
            return self._see()
        return World(self._scene, told_up(up, up_covariance, source, self.world_config))

    @property
    def object_labels(self) -> NDArray[np.int32]:
        """(H, W) int32, a level above surfaces; 0 no object (floor, walls, support, unlabelled), 1..K
        objects."""
        return self._see().object_labels

    @property
    def objects(self) -> Sequence[Object]:
        """All objects, ``objects[i].label == i + 1``; found on first use."""
        return self._see().objects

    @property
    def hierarchy(self) -> Hierarchy:
        """The merge tree: seeds to regions (heights up to 1), regions to what a wider limit joins (above 1).

        `nodes` (N + 1,) holds the node of each region.
        """
        return self._merging.hierarchy

    def labels_at(
        self, level: float | None = None, *, tolerance_m: float | None = None, sigmas: float | None = None
    ) -> NDArray[np.int32]:
        """The partition at another approximation limit, without segmenting again.

        Parameters
        ----------
        level : float >= 0
            Multiple of the configured tolerances: 1 is the result itself, 0 joins only what noise explains, 2
            allows twice the tolerance. Each step up only joins regions.
        tolerance_m : float >= 0, in place of a level
            The limit as a length at the median depth (`scale`), m; at half of that depth it is half of it.
        sigmas : float >= 0, in place of a level
            The limit as a multiple of the standard deviation of the range at the median depth.

        Returns
        -------
        (H, W) int32, 0 unlabelled, numbered from the largest region down.

        Raises
        ------
        ValueError
            For a negative or NaN limit, or unless exactly one is given.
        """
        if level is None:
            level = self.scale.level(tolerance_m=tolerance_m, sigmas=sigmas)
        elif tolerance_m is not None or sigmas is not None:
            raise ValueError("give one of level, tolerance_m and sigmas")
        if not level >= 0:
            raise ValueError(
                f"level = {level}: expected a multiple of the tolerance, 0 or more (1 is the result)"
            )
        if level == 1:
            return np.array(self.labels)
        if level > 1:
            groups = self.hierarchy.cut(level)[self.nodes][self.labels]
        else:  # within each region: what the colours, and the ranges, join at this level
            groups = _paired(self.labels, self.tree.cut(level)[self.leaves])
            if self.range_tree is not None and self.range_leaves is not None:
                groups = _paired(groups, self.range_tree.cut(level)[self.range_leaves])
        groups[self.labels == 0] = 0
        return compact(groups)

    def reconstruct(self) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Range and colour from the parameters alone (eq. 1-2).

        Returns
        -------
        points : (H, W, 3) float32, m; NaN where unlabelled or behind the camera
        color : (H, W, 3) uint8; 0 where unlabelled
        """
        return render(self.models, self.labels, self.signals, self.camera)


def _look(scene: Scene) -> World:
    """The world of a scene as its configuration has it."""
    return World(scene, told_up(None, None, "", scene.config))


@dataclass(frozen=True)
class _Merging:
    """How the regions of a segmentation merge; the fields are those of `Segmentation`.

    Apart from it, since its regions refer to this: with a cycle the memory of a frame would stay for a while.
    """

    tree: Hierarchy
    range_tree: Hierarchy | None
    labels: NDArray[np.int32]
    leaves: NDArray[np.int32]
    range_leaves: NDArray[np.int32] | None
    nodes: NDArray[np.int64]
    coarsen: Callable[[], Grouped]
    measure: Callable[[], tuple[Signals, Models]]
    view: Segmentation | None

    @cached_property
    def hierarchy(self) -> Hierarchy:
        builder = TreeBuilder.resume(self.tree)
        grouped = self.coarsen()
        above = np.maximum(grouped.heights, np.nextafter(1.0, 2.0))
        builder.merge(grouped.merges, above, self.nodes.copy())
        return builder.build()

    @cached_property
    def _persistence(self) -> NDArray[np.float64]:
        count = len(self.nodes) - 1
        birth = join_heights(self.tree, self.labels, self.leaves, count)
        if self.range_tree is not None and self.range_leaves is not None:
            birth = np.maximum(birth, join_heights(self.range_tree, self.labels, self.range_leaves, count))
        parents = self.hierarchy.parents()[self.nodes]
        heights = np.concatenate([[np.inf], np.zeros(self.hierarchy.leaf_count), self.hierarchy.heights])
        least = _scale(self.measure()[0], self.view).noise_level
        # a region is one piece at level 1 whatever became of its border pixels
        return np.asarray(heights[parents] / np.clip(birth, least, 1.0))

    def persistence(self) -> NDArray[np.float64]:
        """(N + 1,) see `Segmentation.persistence`."""
        return self._persistence


def _scale(signals: Signals, view: Segmentation | None) -> Scale:
    """See `Segmentation.scale`."""
    if view is not None:
        return view.scale
    typical = float(signals.offset[0])
    if signals.inverse_depth:
        depth_m, sigma_m = 1.0 / typical, float(signals.scale[0]) / typical**2  # dz = z^2 dw
    else:
        depth_m, sigma_m = float("nan"), float(np.sqrt(np.mean(signals.scale[: signals.n_range] ** 2)))
    return Scale(depth_m, float(signals.law[3]) * sigma_m, sigma_m)


def _paired(first: NDArray[np.integer], second: NDArray[np.integer]) -> NDArray[np.int64]:
    """One positive number for each pair of values that occurs."""
    keys = first.astype(np.int64) * (int(second.max()) + 1) + second
    return np.unique(keys, return_inverse=True)[1].reshape(first.shape) + 1


def compact(groups: NDArray[np.integer]) -> NDArray[np.int32]:
    """Number the positive values of an image 1..n from the most frequent down (ties by value); 0 stays 0."""
    labels: NDArray[np.int32] = by_size(np.bincount(groups.ravel()))[1][groups]
    return labels
