"""Recorded frames from disk, with the truth that belongs to them where there is any.

A frame is either a folder with `meta.json`, `depth.png` (16 bit), `rgb.png` and possibly `labels.png`, or
an `.npz` file. A data set is one frame or any folder that holds some. The kind of the truth decides which
figures mean something: whole objects (a region may be a part of one) or the regions themselves.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_core.errors import InputError
from rcseg_core.frame import PinholeCamera, RangeColorFrame

OBJECTS, REGIONS = "objects", "regions"
SYNPEB_FIRST_PLANE = 10
"""SynPEB marks points that lie on no plane by labels below this."""
PLAIN_GREY = 128


@dataclass(frozen=True)
class LabelledFrame:
    """A recorded frame and its truth.

    Attributes
    ----------
    name : str
        Path within the data set, without suffix.
    frame : RangeColorFrame
    truth : (H, W) int32 or None
        0 unlabelled.
    kind : "objects" or "regions"
        What one label of the truth stands for.
    background : tuple of int
        Labels of an "objects" truth that are support or background rather than objects.
    has_color : bool
        False when the frame came without colour and is a plain grey.
    surface_truth : (H, W) int32 or None
        Truth of the surfaces where `truth` splits them by colour.
    """

    name: str
    frame: RangeColorFrame
    truth: NDArray[np.int32] | None = None
    kind: str = OBJECTS
    background: tuple[int, ...] = ()
    has_color: bool = True
    surface_truth: NDArray[np.int32] | None = None

    def truth_of(self, level: str) -> NDArray[np.int32] | None:
        """What "regions" or "surfaces" are compared with; None without truth."""
        return self.surface_truth if level == "surfaces" and self.surface_truth is not None else self.truth


def find_frames(folder: str | Path, pattern: str = "*") -> list[tuple[str, Path]]:
    """Names and paths of the frames of a data set, in the order of their names.

    Parameters
    ----------
    folder : path
        A frame folder, an .npz file, or a folder that holds such (at any depth).
    pattern : glob
        Keeps frames whose name, or whose part of the path in `folder`, matches: `mosd_*`, `synpeb/*`.

    Raises
    ------
    InputError
        No such path, or no frame in it, or none that matches; the message lists what there is.
    """
    root = Path(folder)
    frames = list_frames(root)
    if not frames:
        raise InputError(
            f"{root}: no frame here; a frame is a folder with meta.json and depth.png, or an .npz file"
        )
    chosen = [(name, path) for name, path in frames if matches(name, pattern)]
    if not chosen:
        raise no_match(root, pattern, [name for name, _ in frames])
    return chosen


def list_frames(root: Path) -> list[tuple[str, Path]]:
    """Names and paths of all frames in a folder, sorted by name; a single frame is a list of one.

    Raises
    ------
    InputError
        No such path.
    """
    if not root.exists():
        raise InputError(
            f"{root}: no such file or folder; give a frame folder, an .npz file or a folder of them"
        )
    if root.is_file() or (root / "meta.json").exists():
        return [(root.stem if root.is_file() else root.name, root)]
    paths = [path.parent for path in root.rglob("meta.json")] + list(root.rglob("*.npz"))
    return sorted((path.relative_to(root).with_suffix("").as_posix(), path) for path in paths)


def matches(name: str, pattern: str) -> bool:
    """Does a glob match a frame's name, or the last part of it?"""
    return fnmatch(name, pattern) or fnmatch(name.rpartition("/")[2], pattern)


def no_match(root: Path, pattern: str, names: Sequence[str]) -> InputError:
    """The error that tells which frames there are instead."""
    there = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
    return InputError(f"{root}: no frame matches {pattern!r}; there are {there}")


def load_frames(folder: str | Path, pattern: str = "*") -> Iterator[LabelledFrame]:
    """Read the frames of a data set one by one; parameters and errors as `find_frames` and `load_frame`."""
    for name, path in find_frames(folder, pattern):
        yield load_frame(path, name=name)


def load_frame(path: str | Path, *, name: str | None = None, depth_unit_m: float = 0.0) -> LabelledFrame:
    """Read one frame: a folder with meta.json, or an .npz file.

    Parameters
    ----------
    depth_unit_m : float
        Metres of one unit of depth or points; 0: what meta.json says, else millimetres of depth in whole
        numbers (its largest value and 0: none), and metres.

    Raises
    ------
    InputError
        A file is missing or cannot be read, or its contents do not fit together.
    """
    path = Path(path)
    name = name or (path.stem if path.is_file() else path.name)
    if path.is_dir():
        return _read_folder(path, name, depth_unit_m)
    if path.suffix != ".npz":
        raise InputError(f"{path}: expected a frame folder (meta.json, depth.png, rgb.png) or an .npz file")
    return _read_npz(path, name, depth_unit_m)


def _read_folder(folder: Path, name: str, depth_unit_m: float) -> LabelledFrame:
    meta = _read_meta(folder / "meta.json")
    intrinsics = [_number(meta, key, folder) for key in ("fx", "fy", "cx", "cy")]
    raw = _read_image(folder / "depth.png")
    if raw.ndim != 2 or raw.dtype != np.uint16:
        raise InputError(f"{folder / 'depth.png'}: expected a 16-bit image of one channel, got {_what(raw)}")
    unit_m = depth_unit_m or _number(meta, "depth_unit_m", folder, 0.001)
    depth_m = raw.astype(np.float32) * np.float32(unit_m)
    depth_m[raw == meta.get("depth_invalid", 0)] = np.nan
    color_path = folder / "rgb.png"
    has_color = color_path.exists()
    color = _read_color(color_path) if has_color else np.full((*raw.shape, 3), PLAIN_GREY, np.uint8)
    if color.shape[:2] != raw.shape:
        raise InputError(
            f"{folder}: depth.png is {raw.shape} and rgb.png is {color.shape[:2]} (rows, columns)"
        )
    truth = _read_truth(folder / "labels.png", raw.shape)
    with named(folder):
        frame = RangeColorFrame.from_depth(depth_m, color, PinholeCamera(*intrinsics))
    return LabelledFrame(name, frame, truth, _kind(meta, folder), _background(meta, truth), has_color)


def _read_npz(path: Path, name: str, depth_unit_m: float) -> LabelledFrame:
    """`points` (H, W, 3), or `depth` (H, W) with `K` (3, 3); perhaps `color` (H, W, 3) and `labels` (H, W).

    A file with `xyz` instead is SynPEB's: axes x ahead, y left, z up, a spherical grid, labels of planes.
    """
    arrays = read_arrays(path)
    synpeb = "xyz" in arrays
    camera = _camera(arrays["K"], path) if "K" in arrays else None
    points = _points(arrays, camera, path, depth_unit_m)
    has_color = "color" in arrays
    color = arrays["color"] if has_color else np.full(points.shape, PLAIN_GREY, np.uint8)
    truth = arrays.get("labels")
    if truth is not None:
        if truth.shape != points.shape[:2] or not np.issubdtype(truth.dtype, np.integer):
            wanted = f"integer labels of shape {points.shape[:2]}"
            raise InputError(f"{path}: expected {wanted}, got {_what(truth)}")
        truth = np.where(truth >= SYNPEB_FIRST_PLANE, truth, 0) if synpeb else truth
        truth = truth.astype(np.int32)
    with named(path):
        return LabelledFrame(name, RangeColorFrame(points, color, camera), truth, REGIONS, (), has_color)


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of an .npz.

    Raises
    ------
    InputError
        If it cannot be read, is another kind of file or is cut off.
    """
    try:
        data = np.load(path, allow_pickle=False)
        if not isinstance(data, np.lib.npyio.NpzFile):
            raise ValueError("a single array, saved by np.save instead of np.savez")
        with data:
            return {key: data[key] for key in data.files}
    except FileNotFoundError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    except Exception as error:  # whatever zipfile, zlib or numpy's own parser stumble over
        raise InputError(f"{path}: not an .npz archive of arrays ({_first_line(error)})") from error


def _points(
    arrays: dict[str, NDArray[Any]], camera: PinholeCamera | None, path: Path, unit_m: float
) -> NDArray[Any]:
    if "depth" in arrays and "points" not in arrays:
        depth = arrays["depth"]
        if depth.ndim != 2 or depth.dtype.kind not in "fiu" or depth.dtype.itemsize < 2:
            raise InputError(f"{path}: depth: expected (H, W) of floats or 16-bit steps, got {_what(depth)}")
        if camera is None:
            raise InputError(f"{path}: depth needs the camera matrix K, shape (3, 3)")
        return camera.rays(*depth.shape) * _in_metres(depth, unit_m)[..., None]
    points = arrays.get("points", arrays.get("xyz"))
    if points is None:
        found = ", ".join(arrays) or "nothing"
        raise InputError(f"{path}: expected an array 'points' (H, W, 3), or 'depth' and 'K', found {found}")
    if points.ndim != 3 or points.shape[2] != 3:
        raise InputError(f"{path}: expected points of shape (H, W, 3), got {points.shape}")
    if unit_m and points.dtype.kind in "fiu":
        points = points * np.asarray(unit_m, np.result_type(points, np.float32))
    if "points" in arrays:
        return points
    return np.stack([-points[..., 1], -points[..., 2], points[..., 0]], axis=-1)


def _in_metres(depth: NDArray[Any], unit_m: float) -> NDArray[np.float32]:
    """Depth in whole numbers is millimetres, as in depth images, where nothing else is said."""
    whole = depth.dtype.kind in "iu"
    depth_m: NDArray[np.float32] = depth.astype(np.float32) * np.float32(unit_m or (0.001 if whole else 1.0))
    if whole:
        depth_m[(depth <= 0) | (depth == np.iinfo(depth.dtype).max)] = np.nan
    return depth_m


@contextmanager
def named(path: Path) -> Iterator[None]:
    """Put the path before the message of an error that knows only the arrays."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _read_meta(path: Path) -> dict[str, Any]:
    try:
        meta = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise InputError(f"{path}: is no valid JSON ({_first_line(error)})") from error
    if not isinstance(meta, dict):
        raise InputError(f"{path}: expected an object with fx, fy, cx, cy, depth_unit_m")
    return meta


def _number(meta: dict[str, Any], key: str, folder: Path, default: float | None = None) -> float:
    value = meta.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InputError(f"{folder / 'meta.json'}: {key} must be a number, got {value!r}")
    return float(value)


def _read_image(path: Path) -> NDArray[Any]:
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
    if image is None:
        raise InputError(f"{path}: is no readable image; the file may be truncated")
    return np.asarray(image)


def _read_color(path: Path) -> NDArray[np.uint8]:
    image = _read_image(path)
    if image.dtype != np.uint8:
        raise InputError(f"{path}: expected 8-bit colour, got {_what(image)}")
    if image.ndim == 2:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), np.uint8)
    return np.asarray(cv2.cvtColor(image[..., :3], cv2.COLOR_BGR2RGB), np.uint8)


def _read_truth(path: Path, shape: tuple[int, ...]) -> NDArray[np.int32] | None:
    if not path.exists():
        return None
    labels = _read_image(path)
    if labels.shape != shape:
        raise InputError(f"{path}: expected labels of shape {shape} like depth.png, got {labels.shape}")
    return labels.astype(np.int32)


def _kind(meta: dict[str, Any], folder: Path) -> str:
    """What a label stands for: `truth_kind` of the meta data, or `truth` for short."""
    kind = meta.get("truth_kind", meta.get("truth", OBJECTS))
    if kind not in (OBJECTS, REGIONS):
        raise InputError(
            f"{folder / 'meta.json'}: truth_kind must be {OBJECTS!r} or {REGIONS!r}, got {kind!r}"
        )
    return str(kind)


def _background(meta: dict[str, Any], truth: NDArray[np.int32] | None) -> tuple[int, ...]:
    """Labels that are no objects: `background_labels` of the meta data; in mOSD the table, labels 1 to 9."""
    if truth is None:
        return ()
    if "background_labels" in meta:
        return tuple(int(label) for label in meta["background_labels"])
    return tuple(range(1, 10)) if "mOSD" in str(meta.get("source", "")) else ()


def _camera(matrix: NDArray[Any], path: Path) -> PinholeCamera:
    if matrix.shape != (3, 3) or matrix.dtype.kind not in "fiu":
        raise InputError(f"{path}: expected a camera matrix K of shape (3, 3), got {_what(matrix)}")
    with named(path):
        return PinholeCamera(
            float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])
        )


def _what(array: NDArray[Any]) -> str:
    return f"shape {array.shape}, {array.dtype}"


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
