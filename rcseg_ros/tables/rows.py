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

from rcseg_core import RangeColorFrame, Region, Surface
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
    pixels = labels.astype(">u2").view(np.uint8)
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
        self._ids = {} if named is None else {kind: named.tracks.ids(kind).tolist() for kind in KINDS}

    def of(self, kind: str, label: int) -> int | None:
        return self._ids[kind][label] if self._ids else None


class _Sums:
    """Sums over the regions of a surface, or of an object."""

    def __init__(
        self, regions: Sequence[Region], areas: NDArray[np.float64], colors: NDArray[np.float64]
    ) -> None:
        self._pixels = np.array([region.pixel_count for region in regions], float)
        self._areas, self._colors = areas, colors
        self._centroids = np.array([region.centroid for region in regions]).reshape(-1, 3)
        self._persistence = np.array([region.persistence for region in regions])

    def of(self, groups: Sequence[Sequence[int]]) -> list[dict[str, Any]]:
        """Columns of the union of some regions, for each group of labels."""
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
        columns = {
            "centroid": mean(np.nan_to_num(centers), known),
            "area_m2": total(self._areas[at]).tolist(),
            "mean_color": mean(self._colors[at], weight),
            "persistence": persistence.tolist(),
        }
        return [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]


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
    member = {label: one.label for one in world.objects for label in one.surfaces}
    sums = whole.of([surface.regions for surface in surfaces])
    rows = [
        own
        | _box(surface.box)
        | {
            "surface": surface.label,
            "track": names.of("surface", surface.label),
            "object": member.get(surface.label, 0),
            "category": category.name,
            "category_probability": category.probability,
            "pixel_count": surface.pixel_count,
            "regions": surface.regions,
            "polygon": _well_known_binary(boundary.polygons),
        }
        | _primitive(surface)
        for surface, category, boundary, own in zip(
            surfaces, world.categories, world.boundaries, sums, strict=True
        )
    ]
    return _batch("surfaces", rows)


def _primitive(surface: Surface) -> dict[str, Any]:
    found, local = surface.primitive, surface.local
    known = found.kind != "none"
    columns = {name: getattr(found, name) for name in ("rms_m", "rms_sigma", "misfit_m", "p_value")}
    if not known:
        return {"kind": found.kind}
    return columns | {
        "kind": found.kind,
        "convex": found.convex,
        "parameters": np.concatenate([np.ravel(value) for value in found.parameters.values()]),
        "parameter_covariance": np.ravel(found.covariance),
        "pose": None if getattr(local, "pose", None) is None else np.ravel(local.pose),
        "covariance": None if local is None else np.ravel(local.covariance),
        "systematic": None if local is None else np.ravel(local.systematic),
    }


def _well_known_binary(parts: Sequence[shapely.Polygon]) -> bytes | None:
    """The outline of a plane: a Polygon, or a MultiPolygon where it has several parts."""
    if not parts:
        return None
    return bytes(shapely.to_wkb(parts[0] if len(parts) == 1 else shapely.MultiPolygon(parts)))


def _objects(
    objects: Sequence[Object], surfaces: Sequence[Surface], whole: _Sums, names: _Names
) -> pa.RecordBatch:
    sums = whole.of(
        [[label for surface in one.surfaces for label in surfaces[surface - 1].regions] for one in objects]
    )
    rows = [
        own
        | {
            "object": one.label,
            "track": names.of("object", one.label),
            "surfaces": one.surfaces,
            "pixel_count": one.pixel_count,
            "pose": np.ravel(one.box3d.pose),
            "size": np.ravel(one.box3d.size),
            "stands_on": one.stands_on,
        }
        for one, own in zip(objects, sums, strict=True)
    ]
    return _batch("objects", rows)


def _regions(
    regions: Sequence[Region], areas: NDArray[np.float64], colors: NDArray[np.float64], names: _Names
) -> pa.RecordBatch:
    rows = [
        {
            "region": region.label,
            "track": names.of("region", region.label),
            "surface": region.surface,
            "pixel_count": region.pixel_count,
            "neighbors": region.neighbors,
            "centroid": region.centroid,
            "normal": region.normal,
            "area_m2": area,
            "mean_color": color,
            "persistence": region.persistence,
        }
        | _box(region.box)
        | _patch("range", region.range_patch)
        | _patch("color", region.color_patch)
        for region, area, color in zip(regions, areas.tolist(), colors, strict=True)
    ]
    return _batch("regions", rows)


def _patch(which: str, patch: Any) -> dict[str, Any]:
    return {
        f"{which}_kind": patch.kind,
        f"{which}_degree": patch.degree,
        f"{which}_control_points": patch.control_points.ravel(),
        f"{which}_standard_errors": patch.standard_errors.ravel(),
        f"{which}_covariance": patch.covariance.ravel(),
    }


def _label_images(images: Mapping[str, NDArray[np.int32]]) -> pa.RecordBatch:
    rows = [
        {
            "kind": kind,
            "height": labels.shape[0],
            "width": labels.shape[1],
            "png": encode_label_image(labels),
        }
        for kind, labels in images.items()
    ]
    return _batch("labels", rows)


def _box(box: tuple[int, int, int, int]) -> dict[str, int]:
    return dict(zip(("row_min", "col_min", "row_max", "col_max"), box, strict=True))


def _one_row(table: str, values: Mapping[str, Any]) -> pa.RecordBatch:
    return _batch(table, [values])


def _batch(table: str, rows: Sequence[Mapping[str, Any]]) -> pa.RecordBatch:
    """Rows as a record batch; what a row does not name is null."""
    schema, builders = _schema(table)
    arrays = [
        build([row.get(field.name) for row in rows], field.type)
        for field, build in zip(schema, builders, strict=True)
    ]
    return pa.RecordBatch.from_arrays(arrays, schema=schema)


@cache
def _schema(table: str) -> tuple[pa.Schema, list[Callable[[list[Any], pa.DataType], pa.Array]]]:
    schema = arrow_schema(table, keys=False)
    flat = [pa.types.is_list(field.type) and pa.types.is_primitive(field.type.value_type) for field in schema]
    return schema, [_lists if one else pa.array for one in flat]


def _lists(values: list[Any], kind: pa.DataType) -> pa.Array:
    """Lists of numbers: one array of them all, which is many times quicker than number by number."""
    sizes = [0 if value is None else len(value) for value in values]
    numbers = [value for value in values if value is not None and len(value)]
    flat = np.concatenate(numbers) if numbers else np.empty(0)
    offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int32)
    missing = np.array([value is None for value in values], bool)
    content = pa.array(flat.astype(kind.value_type.to_pandas_dtype(), copy=False))
    if not len(values):
        return pa.array([], kind)
    return pa.ListArray.from_arrays(
        pa.array(offsets), content, type=kind, mask=pa.array(missing) if missing.any() else None
    )
