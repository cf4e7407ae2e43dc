"""`rcseg segment`: one frame from pictures or an .npz; labels, overlay and regions into a folder."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_core import PinholeCamera, RangeColorFrame, Segmentation, SegmenterConfig, segment
from rcseg_core.drawing import overlay, write_png
from rcseg_core.errors import InputError
from rcseg_ros.segmenting import noise_document, plain
from rcseg_ros.staging import StagedFolder

REGIONS = "regions.json"
_DEFAULT_DEPTH_UNIT_M = 0.001


def read_images(color: Path, depth: Path, intrinsics: str, depth_unit_m: float) -> RangeColorFrame:
    """Frame from a colour picture, a depth picture (16 bit, ``depth_unit_m`` a step) and ``fx,fy,cx,cy``."""
    bgr = _read_picture(color, cv2.IMREAD_COLOR)
    raw = _read_picture(depth, cv2.IMREAD_UNCHANGED)
    if raw.ndim != 2 or raw.dtype not in (np.uint16, np.float32):
        raise InputError(
            f"{depth}: expected one channel of 16 bits (or float32), got shape {raw.shape} of {raw.dtype}"
        )
    depth_m = raw if raw.dtype == np.float32 else raw.astype(np.float32) * np.float32(depth_unit_m)
    return RangeColorFrame.from_depth(
        depth_m, cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), _parse_intrinsics(intrinsics)
    )


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


def read_npz(path: Path) -> RangeColorFrame:
    """Frame from an .npz: ``color`` and ``points`` (``K`` too, of a camera), or ``depth`` and ``K``."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None
    except (ValueError, AttributeError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not an .npz archive of arrays: {error}") from None
    if "color" not in arrays or not {"points", "depth"} & set(arrays):
        raise InputError(
            f"{path}: expected arrays color and points (or depth and K), found {', '.join(arrays) or 'none'}"
        )
    camera = None
    if "K" in arrays:
        k = np.asarray(arrays["K"])
        if k.shape != (3, 3) or k.dtype.kind not in "fiu":
            raise InputError(f"{path}: K: expected a (3, 3) camera matrix, got {k.shape} of {k.dtype}")
        camera = PinholeCamera(float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]))
    if "points" in arrays:
        return RangeColorFrame(arrays["points"], arrays["color"], camera)
    if camera is None:
        raise InputError(f"{path}: depth needs the camera matrix K, shape (3, 3)")
    return RangeColorFrame.from_depth(arrays["depth"], arrays["color"], camera)


def segment_to_folder(
    frame: RangeColorFrame, config: SegmenterConfig, folder: Path, force: bool
) -> Segmentation:
    """Segment a frame; write labels.png, surface_labels.png (16 bit), overlay.png and regions.json."""
    with StagedFolder(folder, force, REGIONS) as stage:
        result = segment(frame, config)
        stage.path.mkdir()
        write_png(stage.path / "labels.png", result.labels.astype(np.uint16))
        write_png(stage.path / "surface_labels.png", result.surface_labels.astype(np.uint16))
        write_png(stage.path / "overlay.png", overlay(frame.color, result.labels))
        document = regions_document(frame, result)
        (stage.path / REGIONS).write_text(json.dumps(document, indent=1) + "\n", "utf-8")
        stage.commit()
    return result


def regions_document(frame: RangeColorFrame, result: Segmentation) -> dict[str, Any]:
    """All that is known of the regions as plain values; pixels, metres, grey levels.

    null where unknown; a persistence of null is infinite: the region merges into no other.
    """
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
            }
            for surface in result.surfaces
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


def _patch(patch: Any) -> dict[str, Any]:
    names = ("kind", "degree", "domain", "control_points", "standard_errors", "covariance")
    return {name: plain(getattr(patch, name)) for name in names}
