"""`rcseg segment`: one frame from pictures or an .npz; labels, overlay and regions into a folder."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_core import PinholeCamera, RangeColorFrame, Segmentation, SegmenterConfig, segment
from rcseg_core.datasets import named, read_arrays
from rcseg_core.errors import InputError
from rcseg_core.result.drawing import overlay, write_png
from rcseg_ros.frames.depth_images import depth_in_metres
from rcseg_ros.frames.point_clouds import check_unit
from rcseg_ros.frames.reading import DEFAULT_READING, Reading
from rcseg_ros.recordings.segmenting import noise_document, plain
from rcseg_ros.recordings.staging import StagedFolder
from rcseg_ros.results.world import ring_of

REGIONS = "regions.json"


def read_images(
    color: Path, depth: Path, intrinsics: str, reading: Reading = DEFAULT_READING
) -> RangeColorFrame:
    """Frame from a colour picture, a depth picture and ``fx,fy,cx,cy``.

    The depth has 16 bits, ``reading.depth_unit_m`` a step (0: a millimetre), or float32 (0: metres).
    """
    bgr = _read_picture(color, cv2.IMREAD_COLOR)
    raw = _read_picture(depth, cv2.IMREAD_UNCHANGED)
    if raw.ndim != 2 or raw.dtype.itemsize < 2:
        raise InputError(
            f"{depth}: expected one channel of 16 bits (or float32), got shape {raw.shape} of {raw.dtype}"
        )
    camera = _parse_intrinsics(intrinsics)
    with named(depth):
        depth_m = depth_in_metres(raw, reading)
        return RangeColorFrame.from_depth(depth_m, cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), camera)


def _read_picture(path: Path, flags: int) -> NDArray[Any]:
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    picture = cv2.imdecode(data, flags) if data.size else None
    if picture is None:
        raise InputError(f"{path}: not a picture that OpenCV reads; give a PNG")
    return picture


def _parse_intrinsics(text: str) -> PinholeCamera:
    try:
        fx, fy, cx, cy = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--intrinsics {text}: expected four numbers fx,fy,cx,cy in pixels") from None
    return PinholeCamera(fx, fy, cx, cy)


def read_npz(path: Path, reading: Reading = DEFAULT_READING) -> RangeColorFrame:
    """Frame from an .npz: ``color`` and ``points`` (``K`` too, of a camera), or ``depth`` and ``K``.

    Metres, but for depth in whole numbers, which is millimetres, unless ``reading`` says something else.
    """
    arrays = read_arrays(path)
    with named(path):
        return _frame_of(arrays, reading)


def _frame_of(arrays: dict[str, NDArray[Any]], reading: Reading) -> RangeColorFrame:
    if "color" not in arrays or not {"points", "depth"} & set(arrays):
        raise InputError(
            f"expected arrays color and points (or depth and K), found {', '.join(arrays) or 'none'}"
        )
    camera = None
    if "K" in arrays:
        k = np.asarray(arrays["K"])
        if k.shape != (3, 3) or k.dtype.kind not in "fiu":
            raise InputError(f"K: expected a (3, 3) camera matrix, got {k.shape} of {k.dtype}")
        camera = PinholeCamera(float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]))
    if "points" in arrays:
        points = arrays["points"]
        if reading.depth_unit_m and points.dtype.kind in "fiu":
            points = points * np.asarray(reading.depth_unit_m, np.result_type(points, np.float32))
        frame = RangeColorFrame(points, arrays["color"], camera)
        check_unit(points, reading)
        return frame
    if camera is None:
        raise InputError("depth needs the camera matrix K, shape (3, 3)")
    depth = arrays["depth"]
    if depth.ndim == 2 and depth.dtype.kind in "fiu" and depth.dtype.itemsize > 1:
        depth = depth_in_metres(depth, reading)
    return RangeColorFrame.from_depth(depth, arrays["color"], camera)


def segment_to_folder(
    frame: RangeColorFrame,
    config: SegmenterConfig,
    folder: Path,
    force: bool,
    prepare: Callable[[SegmenterConfig], object] = lambda config: None,
) -> Segmentation:
    """Segment a frame; write label images of regions, surfaces, objects (16 bit) and classes (8 bit), the
    overlay and regions.json. `prepare` is called when the folder is known to be free."""
    with StagedFolder(folder, force, REGIONS) as stage:
        prepare(config)
        result = segment(frame, config)
        stage.path.mkdir()
        write_png(stage.path / "labels.png", result.labels.astype(np.uint16))
        write_png(stage.path / "surface_labels.png", result.surface_labels.astype(np.uint16))
        write_png(stage.path / "object_labels.png", result.object_labels.astype(np.uint16))
        write_png(stage.path / "class_mask.png", result.world().class_mask)
        write_png(stage.path / "overlay.png", overlay(frame.color, result.labels))
        document = regions_document(frame, result)
        (stage.path / REGIONS).write_text(json.dumps(document, indent=1) + "\n", "utf-8")
        stage.commit()
    return result


def regions_document(frame: RangeColorFrame, result: Segmentation) -> dict[str, Any]:
    """All that is known of the regions as plain values; pixels, metres, grey levels.

    null where unknown; a persistence of null is infinite: the region merges into no other.
    """
    world = result.world()
    of_surface = {label: one.label for one in world.objects for label in one.surfaces}
    return {
        "height": frame.height,
        "width": frame.width,
        "camera_matrix": None if frame.camera is None else plain(frame.camera.matrix()),
        "noise": noise_document(result),
        "timings_s": plain(result.timings),
        "regions": [
            {
                "label": region.label,
                "surface": region.surface,
                "pixel_count": region.pixel_count,
                "box": plain(region.box),
                "centroid_m": plain(region.centroid),
                "normal": plain(region.normal),
                "neighbors": plain(region.neighbors),
                "persistence": plain(region.persistence),
                "range_patch": _patch(region.range_patch),
                "color_patch": _patch(region.color_patch),
            }
            for region in result.regions
        ],
        "surfaces": [
            {
                "label": surface.label,
                "pixel_count": surface.pixel_count,
                "box": plain(surface.box),
                "regions": plain(surface.regions),
                "primitive": _primitive(surface.primitive),
                "local": _local(surface.local),
                "category": surface.category,
                "category_probability": plain(surface.category_probability),
                "object": of_surface.get(surface.label, 0),
                "polygons": [_polygon(polygon) for polygon in surface.polygons],
            }
            for surface in result.surfaces
        ],
        "up": None if world.up is None else plain(world.up),
        "objects": [
            {
                "label": one.label,
                "surfaces": plain(one.surfaces),
                "pixel_count": one.pixel_count,
                "box": {"pose": plain(one.box3d.pose), "size_m": plain(one.box3d.size)},
                "stands_on": one.stands_on,
            }
            for one in world.objects
        ],
    }


def _primitive(found: Any) -> dict[str, Any]:
    """A recognised shape; the covariance is of its parameters in their order, null values are unknown."""
    names = (
        "parameters",
        "standard_errors",
        "covariance",
        "convex",
        "rms_m",
        "rms_sigma",
        "misfit_m",
        "p_value",
    )
    return {"kind": found.kind} | {name: plain(getattr(found, name)) for name in names}


def _local(form: Any) -> dict[str, Any] | None:
    """The shape in minimal local form, its fields by name; null where none was recognised."""
    return None if form is None else {name: plain(value) for name, value in vars(form).items()}


def _polygon(polygon: Any) -> dict[str, Any]:
    """A part of a plane, in x and y of its local pose; the first vertex of a ring is not repeated. Metres."""
    outer = ring_of(polygon.exterior, counter_clockwise=True)
    holes = [plain(ring_of(hole, counter_clockwise=False)) for hole in polygon.interiors]
    return {"outer": plain(outer), "holes": holes, "area_m2": polygon.area}


def _patch(patch: Any) -> dict[str, Any]:
    names = ("kind", "degree", "domain", "control_points", "standard_errors", "covariance")
    return {name: plain(getattr(patch, name)) for name in names}
