"""One frame's result as rows of the tables: an Arrow record batch each, without the keys of the frame.

Columns are built for all rows of a frame at once; the keys are the same in all of them and are added where
the batches of many frames are put together.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import shapely
from numpy.typing import NDArray

from rcseg_core import BezierPatch, RangeColorFrame, Region, Surface
from rcseg_core.errors import InputError
from rcseg_core.result.seen import region_areas
from rcseg_core.tracking import KINDS
from rcseg_core.world import Object, World
from rcseg_ros.recordings.segmenting import Segmented
from rcseg_ros.results.made import Named
from rcseg_ros.tables.schema import arrow_schema

#: What a PNG starts with, and its last chunk.
_PNG_START, _PNG_END = b"\x89PNG\r\n\x1a\n", b"\0\0\0\0IEND\xaeB`\x82"
#: Number of the filter that takes from each row the one above.
_UP = 2

Rows = Mapping[str, pa.RecordBatch]


def frame_tables(made: Segmented) -> Rows:
    """The rows of all tables that one segmented frame gives; with tracks, where it was named."""
    frame, result, world = made.frame, made.result, made.messages.world
    names = _Names(made.messages.named)
    regions, surfaces = result.regions, result.surfaces
    areas, colors = region_areas(frame, result.labels, regions)
    whole = _Sums(regions, areas, colors)
    return {
        "frames": _frame(frame, world, made.row, made.raw.log_ns),
        "surfaces": _surfaces(surfaces, world, whole, names),
        "objects": _objects(world.objects, surfaces, whole, names),
        "regions": _regions(regions, areas, colors, names),
        "labels": _label_images(
            {
                "labels": result.labels,
                "surface_labels": result.surface_labels,
                "object_labels": world.object_labels,
            }
        ),
    }


def rejected_frame(log_ns: int, reason: str, error: str) -> Rows:
    """The row of a range message that gave no result."""
    values = {"log_ns": log_ns, "rejected": reason, "error": error or None}
    return {"frames": _one_row("frames", values)}


def decode_label_image(png: bytes) -> NDArray[np.uint16]:
    """(H, W) uint16 labels of a value of the column png; 0 unlabelled.

    Raises
    ------
    InputError
        If it is not a label image.
    """
    try:
        labels = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED) if png else None
    except cv2.error:  # as where it claims to be larger than OpenCV takes
        labels = None
    if labels is None or labels.dtype != np.uint16 or labels.ndim != 2:
        raise InputError("png: expected a PNG of 16 bits and one channel, as the table labels holds them")
    return np.asarray(labels)


def encode_label_image(labels: NDArray[np.int32]) -> bytes:
    """A label image as PNG of 16 bits.

    Written here, as label images are runs: less the row above, and by zlib's runs of bytes, they take a third
    less time than in OpenCV, whose releases differ in what may be asked of them.
    """
    if labels.max(initial=0) > 0xFFFF:
        raise InputError(f"{labels.max()} labels do not fit into 16 bits; coarsen the segmentation")
    height, width = labels.shape
    pixels = labels.astype(">u2", order="C").view(np.uint8)
    rows = np.empty((height, 1 + 2 * width), np.uint8)
    rows[:, 0], rows[0, 1:] = _UP, pixels[0]
    np.subtract(pixels[1:], pixels[:-1], out=rows[1:, 1:])
    zlib_runs = zlib.compressobj(1, strategy=zlib.Z_RLE)
    packed = zlib_runs.compress(rows) + zlib_runs.flush()
    head = struct.pack(">2I5B", width, height, 16, 0, 0, 0, 0)  # 16 bits of grey
    return b"".join([_PNG_START, *_png_chunk(b"IHDR", head), *_png_chunk(b"IDAT", packed), _PNG_END])


def _png_chunk(kind: bytes, data: bytes) -> tuple[bytes, ...]:
    return struct.pack(">I", len(data)), kind, data, struct.pack(">I", zlib.crc32(data, zlib.crc32(kind)))


class _Names:
    """Track ids of labels; None where the frame was not named."""

    def __init__(self, named: Named | None) -> None:
        self._ids = {} if named is None else {kind: named.tracks.ids(kind) for kind in KINDS}

    def of(self, kind: str, count: int) -> NDArray[np.int32] | None:
        """(count,) of the labels 1..count."""
        return self._ids[kind][1 : count + 1] if self._ids else None


class _Sums:
    """Sums over the regions of a surface, or of an object."""

    def __init__(
        self, regions: Sequence[Region], areas: NDArray[np.float64], colors: NDArray[np.float64]
    ) -> None:
        self._pixels = np.array([region.pixel_count for region in regions], float)
        self._areas, self._colors = areas, colors
        self._centroids = np.array([region.centroid for region in regions]).reshape(-1, 3)
        self._persistence = np.array([region.persistence for region in regions])

    def columns(self, groups: Sequence[Sequence[int]]) -> dict[str, NDArray[np.float64]]:
        """Of the union of some regions, for each group of labels."""
        group = np.repeat(np.arange(len(groups)), [len(labels) for labels in groups])
        at = np.array([label for labels in groups for label in labels], int) - 1

        def total(values: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.bincount(group, values, len(groups))

        def mean(values: NDArray[np.float64], weight: NDArray[np.float64]) -> NDArray[np.float64]:
            with np.errstate(invalid="ignore"):  # none: NaN
                return np.stack([total(weight * column) for column in values.T], 1) / total(weight)[:, None]

        weight, centers = self._pixels[at], self._centroids[at]
        known = weight * np.isfinite(centers[:, 0])
        persistence = np.zeros(len(groups))
        np.maximum.at(persistence, group, self._persistence[at])
        return {
            "centroid": mean(np.nan_to_num(centers), known),
            "area_m2": total(self._areas[at]),
            "mean_color": mean(self._colors[at], weight),
            "persistence": persistence,
        }


def _frame(frame: RangeColorFrame, world: World, row: Mapping[str, Any], log_ns: int) -> pa.RecordBatch:
    noise, camera = row["noise"], row["camera"]
    kept = ("frame_id", "height", "width", "color_offset_ns", "valid_share", "labelled_share", "regions",
            "surfaces", "segment_ms", "segment_cpu_ms")  # fmt: skip
    named = ("range_unit", "range_law", "range_correlation", "color_correlation", "median_depth_m",
             "sigma_m", "tolerance_m")  # fmt: skip
    values = {name: row[name] for name in kept} | {name: noise[name] for name in named}
    values |= {
        "log_ns": log_ns,
        "objects": len(world.objects),
        "floor": world.floor,
        "up": None if world.up is None else world.up.vector,
        "up_source": None if world.up is None else world.up.source,
        "camera_matrix": None if frame.camera is None else frame.camera.matrix().ravel(),
        "camera": f"{camera['matrix']} ({camera['why']}); {camera['registration']}",
        "noise_source": noise["source"],
        "color_sigma": noise["color"],
        "stages_ms": list(row["stages_ms"].items()),
    }
    return _one_row("frames", values)


def _surfaces(surfaces: Sequence[Surface], world: World, whole: _Sums, names: _Names) -> pa.RecordBatch:
    member = np.zeros(len(surfaces) + 1, np.int32)
    for one in world.objects:
        member[list(one.surfaces)] = one.label
    categories = world.categories
    return _batch(
        "surfaces",
        len(surfaces),
        whole.columns([surface.regions for surface in surfaces])
        | _boxes([surface.box for surface in surfaces])
        | {
            "surface": [surface.label for surface in surfaces],
            "track": names.of("surface", len(surfaces)),
            "object": member[1:],
            "category": [category.name for category in categories],
            "category_probability": [category.probability for category in categories],
            "pixel_count": [surface.pixel_count for surface in surfaces],
            "regions": [surface.regions for surface in surfaces],
            "polygon": _well_known_binary([boundary.polygons for boundary in world.boundaries]),
        }
        | _primitives(surfaces),
    )


def _primitives(surfaces: Sequence[Surface]) -> dict[str, list[Any]]:
    shapes = [None if s.primitive.kind == "none" else s.primitive for s in surfaces]
    numbers = ("convex", "rms_m", "rms_sigma", "misfit_m", "p_value")
    columns = {name: [None if one is None else getattr(one, name) for one in shapes] for name in numbers}
    forms = [surface.local for surface in surfaces]
    return columns | {
        "kind": [surface.primitive.kind for surface in surfaces],
        "parameters": [
            None if one is None else np.concatenate([np.ravel(value) for value in one.parameters.values()])
            for one in shapes
        ],
        "parameter_covariance": [None if one is None else one.covariance for one in shapes],
        "pose": [getattr(form, "pose", None) for form in forms],
        "covariance": [None if form is None else form.covariance for form in forms],
        "systematic": [None if form is None else form.systematic for form in forms],
    }


def _well_known_binary(outlines: Sequence[Sequence[shapely.Polygon]]) -> list[bytes | None]:
    """Outlines of planes: Polygons, or MultiPolygons where they have several parts; None of no part."""
    shapes = [
        parts[0] if len(parts) == 1 else shapely.MultiPolygon(parts) if parts else None for parts in outlines
    ]
    return list(shapely.to_wkb(np.array(shapes, object)))


def _objects(
    objects: Sequence[Object], surfaces: Sequence[Surface], whole: _Sums, names: _Names
) -> pa.RecordBatch:
    sums = whole.columns(
        [[label for surface in one.surfaces for label in surfaces[surface - 1].regions] for one in objects]
    )
    return _batch(
        "objects",
        len(objects),
        sums
        | {
            "object": [one.label for one in objects],
            "track": names.of("object", len(objects)),
            "surfaces": [one.surfaces for one in objects],
            "pixel_count": [one.pixel_count for one in objects],
            "pose": [one.box3d.pose for one in objects],
            "size": [one.box3d.size for one in objects],
            "stands_on": [one.stands_on for one in objects],
        },
    )


def _regions(
    regions: Sequence[Region], areas: NDArray[np.float64], colors: NDArray[np.float64], names: _Names
) -> pa.RecordBatch:
    return _batch(
        "regions",
        len(regions),
        {
            "region": [region.label for region in regions],
            "track": names.of("region", len(regions)),
            "surface": [region.surface for region in regions],
            "pixel_count": [region.pixel_count for region in regions],
            "neighbors": [region.neighbors for region in regions],
            "centroid": [region.centroid for region in regions],
            "normal": [region.normal for region in regions],
            "area_m2": areas,
            "mean_color": colors,
            "persistence": [region.persistence for region in regions],
        }
        | _boxes([region.box for region in regions])
        | _patches("range", [region.range_patch for region in regions])
        | _patches("color", [region.color_patch for region in regions]),
    )


def _patches(which: str, patches: Sequence[BezierPatch]) -> dict[str, list[Any]]:
    names = ("kind", "degree", "control_points", "standard_errors", "covariance")
    return {f"{which}_{name}": [getattr(patch, name) for patch in patches] for name in names}


def _label_images(images: Mapping[str, NDArray[np.int32]]) -> pa.RecordBatch:
    labels = images.values()
    return _batch(
        "labels",
        len(images),
        {
            "kind": list(images),
            "height": [image.shape[0] for image in labels],
            "width": [image.shape[1] for image in labels],
            "png": [encode_label_image(image) for image in labels],
        },
    )


def _boxes(boxes: Sequence[tuple[int, int, int, int]]) -> dict[str, NDArray[np.int64]]:
    columns = np.array(boxes, np.int64).reshape(-1, 4).T
    return dict(zip(("row_min", "col_min", "row_max", "col_max"), columns, strict=True))


def _one_row(table: str, values: Mapping[str, Any]) -> pa.RecordBatch:
    return _batch(table, 1, {name: [value] for name, value in values.items()})


def _batch(table: str, count: int, columns: Mapping[str, Any]) -> pa.RecordBatch:
    """Columns of some rows as a record batch; a column that is not named, or None, is null.

    columns : sequences or arrays (count, ...), of lists of numbers: arrays of any shape, row by row
    """
    schema, builders = _schema(table)
    given = [columns.get(field.name) for field in schema]
    arrays = [
        pa.nulls(count, field.type) if column is None else build(column, field.type)
        for field, build, column in zip(schema, builders, given, strict=True)
    ]
    return pa.RecordBatch.from_arrays(arrays, schema=schema)


@cache
def _schema(table: str) -> tuple[pa.Schema, list[Callable[[Any, pa.DataType], pa.Array]]]:
    schema = arrow_schema(table, keys=False)
    flat = [pa.types.is_list(field.type) and pa.types.is_primitive(field.type.value_type) for field in schema]
    return schema, [_lists if one else pa.array for one in flat]


def _lists(values: Sequence[Any], kind: pa.DataType) -> pa.Array:
    """Lists of numbers: one array of them all, which is many times quicker than number by number."""
    if not len(values):
        return pa.array([], kind)
    number = kind.value_type.to_pandas_dtype()
    each = [np.empty(0) if value is None else np.ravel(value) for value in values]
    offsets = np.zeros(len(each) + 1, np.int32)
    np.cumsum([one.size for one in each], out=offsets[1:])
    missing = [value is None for value in values]
    return pa.ListArray.from_arrays(
        pa.array(offsets),
        pa.array(np.concatenate(each).astype(number, copy=False)),
        type=kind,
        mask=pa.array(missing) if any(missing) else None,
    )
