"""The tables of a run: every column with its type, unit and meaning, in one place.

The columns become Arrow schemas whose fields carry unit and meaning as metadata, and the tables of
docs/batch.md. A change that breaks a reader raises `VERSION`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import pyarrow as pa

VERSION = 1


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes
    ----------
    unit : empty where there is none to tell
    doc : what it means, and what null means
    varies : it is measured anew by each run, so that two runs of the same input differ in it
    """

    name: str
    type: pa.DataType
    unit: str
    doc: str
    varies: bool = False


def _list(kind: pa.DataType) -> pa.DataType:
    return pa.list_(kind)


_TEXT, _WHOLE, _COUNT, _NUMBER = pa.string(), pa.int64(), pa.int32(), pa.float64()
_NUMBERS, _LABELS = _list(_NUMBER), _list(_COUNT)

KEYS = (
    Column("recording", _TEXT, "", "name of the recording in this run"),
    Column("episode_index", _WHOLE, "", "number of the recording in this run, as of a LeRobotDataset"),
    Column("frame_index", _WHOLE, "", "number of the range message in its recording, from 0"),
    Column("timestamp", _NUMBER, "s", "stamp of the range message after that of the recording's first"),
    Column("stamp_ns", _WHOLE, "ns", "stamp of the range message; its time of recording where it has none"),
)
_BOX = (
    Column("row_min", _COUNT, "px", "first row of the smallest box of pixels round it"),
    Column("col_min", _COUNT, "px", "first column"),
    Column("row_max", _COUNT, "px", "last row, inclusive"),
    Column("col_max", _COUNT, "px", "last column, inclusive"),
)
_COLOR = Column("mean_color", _list(pa.float32()), "grey levels", "mean red, green, blue of its pixels")
_CENTROID = Column("centroid", _NUMBERS, "m", "mean of its measured points, x y z in frame_id; NaN without")
_PIXELS = Column("pixel_count", _COUNT, "px", "number of its pixels")
_TRACK = Column("track", _WHOLE, "", "identity from frame to frame; null: not tracked")

TABLES: Mapping[str, tuple[Column, ...]] = {
    "frames": (
        Column("log_ns", _WHOLE, "ns", "time at which the range message was recorded"),
        Column("rejected", _TEXT, "", "why there is no result, one word; null: there is one"),
        Column("error", _TEXT, "", "the same in words; null where the word says all"),
        Column("frame_id", _TEXT, "", "coordinate frame of all points of this frame"),
        Column("height", _COUNT, "px", "rows of the label images"),
        Column("width", _COUNT, "px", "columns of the label images"),
        Column("camera_matrix", _NUMBERS, "px", "pinhole matrix, row by row; null: a grid without a camera"),
        Column("camera", _TEXT, "", "K or P, why that one, and how range and colour came into one grid"),
        Column("color_offset_ns", _WHOLE, "ns", "stamp of the colour image less that of the range"),
        Column("valid_share", _NUMBER, "", "share of the pixels with a range"),
        Column("labelled_share", _NUMBER, "", "share of the pixels in a region"),
        Column("regions", _COUNT, "", "number of regions"),
        Column("surfaces", _COUNT, "", "number of surfaces"),
        Column("objects", _COUNT, "", "number of objects"),
        Column("floor", _COUNT, "", "label of the surface that is the floor; 0: none is seen"),
        Column("up", _NUMBERS, "", "unit vector away from the ground, in frame_id; null: not known"),
        Column("up_source", _TEXT, "", "floor, parameter, tf or imu; null: not known"),
        Column("noise_source", _TEXT, "", "where the noise of the range is known from"),
        Column("range_unit", _TEXT, "", "unit of the range signal: 1/m or m"),
        Column("range_law", _list(_NUMBERS), "range_unit", "a, b, c of sigma = a + b s + c s^2, by channel"),
        Column("range_correlation", _NUMBER, "px", "pixels that make one independent measurement of range"),
        Column("color_sigma", _NUMBERS, "grey levels", "noise of each channel of colour"),
        Column("color_correlation", _NUMBER, "px", "the same as range_correlation, of colour"),
        Column("median_depth_m", _NUMBER, "m", "median depth; null: no camera"),
        Column("sigma_m", _NUMBER, "m", "standard deviation of the range there"),
        Column("tolerance_m", _NUMBER, "m", "approximation limit there"),
        Column("segment_ms", _NUMBER, "ms", "wall time of segment()", True),
        Column("segment_cpu_ms", _NUMBER, "ms", "processor time of segment()", True),
        Column("stages_ms", pa.map_(_TEXT, _NUMBER), "ms", "wall time by stage", True),
    ),
    "surfaces": (
        Column("surface", _COUNT, "", "label: value in the surface_labels image"),
        _TRACK,
        Column("object", _COUNT, "", "label of the object that it belongs to; 0: of none"),
        Column("category", _TEXT, "", "floor, horizontal, ceiling, vertical, inclined, sphere, cylinder "
               "or other"),
        Column("category_probability", _NUMBER, "", "of the category; NaN: of planes where up is not known"),
        _PIXELS,
        *_BOX,
        Column("regions", _LABELS, "", "labels of the regions on it"),
        _CENTROID,
        Column("area_m2", _NUMBER, "m^2", "area that is seen, of the surface itself; NaN without a camera"),
        _COLOR,
        Column("persistence", _NUMBER, "", "of its most lasting region, see regions"),
        Column("kind", _TEXT, "", "primitive: plane, sphere, cylinder or none"),
        Column("parameters", _NUMBERS, "m", "plane: normal, distance; sphere: centre, radius; "
               "cylinder: point of the axis, axis, radius"),
        Column("parameter_covariance", _NUMBERS, "m", "square matrix of the parameters, row by row"),
        Column("convex", pa.bool_(), "", "whether the outside is seen; true of a plane"),
        Column("rms_m", _NUMBER, "m", "rms distance of single pixels from the primitive"),
        Column("rms_sigma", _NUMBER, "", "the same along the ray over the sensor's noise; 1: noise alone"),
        Column("misfit_m", _NUMBER, "m", "rms distance between primitive and surface, noise taken off"),
        Column("p_value", _NUMBER, "", "probability of so much misfit if the surface is the primitive"),
        Column("pose", _NUMBERS, "m", "4 x 4 of the minimal local form, row by row: plane: origin at the "
               "centroid, x along the longest spread, z the normal; null: no plane or cylinder"),
        Column("covariance", _NUMBERS, "rad, m", "random part of the errors of the local form: plane: tilt "
               "about x, about y, offset along z; null: no primitive"),
        Column("systematic", _NUMBERS, "rad, m", "the same of what no number of pixels averages away"),
        Column("polygon", pa.binary(), "m", "outline with holes as WKB in x, y of the pose, a MultiPolygon "
               "where it is in parts; null: no plane"),
    ),
    "objects": (
        Column("object", _COUNT, "", "label: value in the object_labels image"),
        _TRACK,
        Column("surfaces", _LABELS, "", "labels of the surfaces of it"),
        _PIXELS,
        Column("pose", _NUMBERS, "m", "4 x 4 of the middle of its box, row by row"),
        Column("size", _NUMBERS, "m", "side lengths of its box along x, y, z of the pose"),
        Column("stands_on", _COUNT, "", "label of the surface that it stands on; 0: none is seen"),
        _CENTROID,
        Column("area_m2", _NUMBER, "m^2", "area that is seen of its surfaces"),
        _COLOR,
        Column("persistence", _NUMBER, "", "of its most lasting region"),
    ),
    "regions": (
        Column("region", _COUNT, "", "label: value in the labels image"),
        Column("surface", _COUNT, "", "label of the surface that it lies on; 0: none"),
        _TRACK,
        _PIXELS,
        *_BOX,
        Column("neighbors", _LABELS, "", "labels of the regions that touch it"),
        _CENTROID,
        Column("normal", _NUMBERS, "", "unit normal at the centroid, towards the sensor; NaN: unknown"),
        Column("area_m2", _NUMBER, "m^2", "area that is seen, of the surface itself; NaN without a camera"),
        _COLOR,
        Column("persistence", _NUMBER, "", "level of the merge tree at which it merges over that at which it "
               "comes to be; inf: never merges"),
        *(
            Column(f"{which}_{name}", kind, unit, doc)
            for which, of in (("range", "1/m or m"), ("color", "grey levels"))
            for name, kind, unit, doc in (
                ("kind", _TEXT, "", "inverse_depth, xyz or rgb"),
                ("degree", _COUNT, "", "degree of the Bezier patch"),
                ("control_points", _NUMBERS, of, "(channels, k + 1, k + 1), row by row, over the pixel box"),
                ("standard_errors", _NUMBERS, of, "of the control points, eq. (15)"),
                ("covariance", _NUMBERS, f"({of})^2", "residual covariance of the channels"),
            )
        ),
    ),
    "labels": (
        Column("kind", _TEXT, "", "labels (regions), surface_labels or object_labels"),
        Column("height", _COUNT, "px", "rows"),
        Column("width", _COUNT, "px", "columns"),
        Column("png", pa.binary(), "", "the label image as PNG of 16 bits; 0: unlabelled"),
    ),
}  # fmt: skip


def columns(table: str) -> tuple[Column, ...]:
    """All columns of a table, keys first."""
    return (*KEYS, *TABLES[table])


@cache
def arrow_schema(table: str, *, keys: bool = True) -> pa.Schema:
    """The Arrow schema of a table; its fields tell unit and meaning in their metadata.

    keys : False leaves out the columns that tell the frame
    """
    fields = [
        pa.field(
            column.name,
            column.type,
            metadata={"unit": column.unit, "doc": column.doc} | ({"varies": "yes"} if column.varies else {}),
        )
        for column in (columns(table) if keys else TABLES[table])
    ]
    return pa.schema(fields, metadata={"rcseg.table": table, "rcseg.schema_version": str(VERSION)})
