"""Pictures of frames and segmentations: RGB uint8 arrays, made with numpy and OpenCV alone.

The node publishes `overlay` and `edges_picture` at frame rate, so both look colours up in one packed table
and blend with OpenCV: a few milliseconds at 640 x 480.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_core.errors import InputError

Image = NDArray[np.uint8]

EDGE_COLORS: dict[int, tuple[int, int, int]] = {1: (255, 70, 70), 2: (80, 230, 80), 4: (90, 130, 255)}
"""Bits of the edge image: depth 1 red, orientation 2 green, colour 4 blue; together they add up."""
BOUNDARY_COLOR = (255, 255, 255)
KIND_COLORS: dict[str, tuple[int, int, int]] = {
    "plane": (90, 130, 255),
    "sphere": (80, 230, 80),
    "cylinder": (255, 160, 40),
    "none": (90, 90, 90),
}
"""Surfaces by the primitive that they are."""
TITLE_HEIGHT_PX = 22


def label_colors(count: int) -> Image:
    """Colours of the labels 0 to `count`: (count + 1, 3) uint8 RGB; 0 is black.

    A label has the same colour in every picture. Hues step by the golden angle, so that labels close in
    number (regions close in the image, mostly) are far apart in hue; lightness and saturation change with
    other periods.
    """
    label = np.arange(1, count + 1)
    hue = (label * 0.61803398875) % 1.0
    saturation = np.take([0.78, 0.55, 0.92], label % 3)
    value = np.take([255, 190, 225, 160], (label // 3) % 4)
    # From hue to RGB by formula: OpenCV's conversion rounds differently at the end of an array.
    sector = (np.array([5, 3, 1]) + 6 * hue[:, None]) % 6
    weight = np.clip(np.minimum(sector, 4 - sector), 0, 1)
    colors = np.zeros((count + 1, 3), np.uint8)
    colors[1:] = np.round(value[:, None] * (1 - saturation[:, None] * weight))
    return colors


def labels_picture(labels: NDArray[Any]) -> Image:
    """Every label in its colour, unlabelled pixels black: (H, W, 3) uint8."""
    table = label_colors(int(labels.max(initial=0)))
    # One 32-bit look-up a pixel instead of three 8-bit ones.
    packed = np.zeros((len(table), 4), np.uint8)
    packed[:, :3] = table
    rgba = np.take(packed.view(np.uint32), labels).view(np.uint8).reshape(*labels.shape, 4)
    return np.asarray(cv2.cvtColor(rgba, cv2.COLOR_RGBA2RGB), np.uint8)


def boundaries(labels: NDArray[Any]) -> NDArray[np.bool_]:
    """Pixels (H, W) whose right or lower neighbour has another label: lines one pixel wide.

    Unlabelled pixels (0) have no border, else every missing one were outlined; across a single one the next
    pixel counts as the neighbour, so that lines do not break.
    """
    edge = np.zeros(labels.shape, bool)
    known = labels != 0
    edge[:, :-1] = (labels[:, 1:] != labels[:, :-1]) & known[:, 1:]
    edge[:-1] |= (labels[1:] != labels[:-1]) & known[1:]
    if not known.all():
        hole = ~known
        edge[:, :-2] |= (labels[:, 2:] != labels[:, :-2]) & hole[:, 1:-1] & known[:, 2:]
        edge[:-2] |= (labels[2:] != labels[:-2]) & hole[1:-1] & known[2:]
        edge &= known
    return edge


def overlay(color: Image, labels: NDArray[Any], *, opacity: float = 0.55) -> Image:
    """The colour image under its labels, with white boundaries.

    Parameters
    ----------
    color : (H, W, 3) uint8 RGB
    labels : (H, W) integer; 0 shows the image, darkened
    opacity : share of the label's colour, 0 to 1

    Raises
    ------
    InputError
        Image and labels differ in size.
    """
    if color.shape[:2] != labels.shape:
        raise InputError(
            f"overlay: the image is {color.shape[:2]} and the labels are {labels.shape} (rows, columns)"
        )
    picture = cv2.addWeighted(labels_picture(labels), opacity, color, 1 - opacity, 0.0)
    return _paint(picture, boundaries(labels), BOUNDARY_COLOR)


def edges_picture(edges: NDArray[np.uint8]) -> Image:
    """The three edge bits in their colours on black: (H, W, 3) uint8."""
    table = np.zeros((256, 1, 3), np.uint8)
    for value in range(8):
        mixed = sum((np.array(c) for bit, c in EDGE_COLORS.items() if value & bit), np.zeros(3, int))
        table[value, 0] = np.minimum(mixed, 255)
    return np.asarray(cv2.LUT(cv2.merge([edges] * 3), table), np.uint8)


def kinds_picture(surface_labels: NDArray[Any], kinds: Sequence[str]) -> Image:
    """Surfaces in the colours of `KIND_COLORS` with white boundaries, unlabelled black: (H, W, 3) uint8.

    Parameters
    ----------
    surface_labels : (H, W) integer
    kinds : kind of the surfaces 1 to M, in order
    """
    table = np.zeros((len(kinds) + 1, 3), np.uint8)
    for label, kind in enumerate(kinds, start=1):
        table[label] = KIND_COLORS[kind]
    return _paint(table[surface_labels], boundaries(surface_labels), BOUNDARY_COLOR)


def depth_picture(depth_m: NDArray[Any], *, low_m: float | None = None, high_m: float | None = None) -> Image:
    """Depth from near (red) to far (blue): (H, W, 3) uint8; invalid pixels (NaN or not above 0) black.

    By default the colours span the 2nd to the 98th percentile.
    """
    valid = np.isfinite(depth_m) & (depth_m > 0)
    if not valid.any():
        return np.zeros((*depth_m.shape, 3), np.uint8)
    low, high = np.percentile(depth_m[valid], [2, 98])
    low, high = low if low_m is None else low_m, high if high_m is None else high_m
    scaled = 255 * (high - np.where(valid, depth_m, high)) / max(high - low, 1e-9)
    picture = cv2.applyColorMap(np.clip(scaled, 0, 255).astype(np.uint8), cv2.COLORMAP_TURBO)
    return _paint(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), ~valid, (0, 0, 0))


def contact_sheet(panels: Sequence[tuple[str, Image]], *, columns: int = 4, panel_width: int = 480) -> Image:
    """Pictures side by side, each under its title: (H, W, 3) uint8.

    Parameters
    ----------
    panels : sequence of (title, (h, w, 3) uint8)
        All are scaled to `panel_width`; rows are filled from the left.

    Raises
    ------
    InputError
        No panel.
    """
    if not panels:
        raise InputError("contact_sheet: no pictures were given; pass at least one (title, image) pair")
    tiles = [_titled(title, image, panel_width) for title, image in panels]
    height = max(tile.shape[0] for tile in tiles)
    columns = min(columns, len(tiles))
    rows = -(-len(tiles) // columns)
    sheet = np.full((rows * height, columns * panel_width, 3), 24, np.uint8)
    for number, tile in enumerate(tiles):
        top, left = number // columns * height, number % columns * panel_width
        sheet[top : top + tile.shape[0], left : left + panel_width] = tile
    return sheet


def write_png(path: Path, picture: NDArray[Any]) -> None:
    """Write an RGB picture (H, W, 3) uint8, or a label image (H, W) uint8 or uint16.

    Raises
    ------
    InputError
        When the file cannot be written.
    """
    data = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR) if picture.ndim == 3 else picture
    done, buffer = cv2.imencode(".png", data)
    if not done:
        raise InputError(f"{path}: an array of {picture.shape} {picture.dtype} does not fit a PNG file")
    try:
        path.write_bytes(buffer.tobytes())
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror}); choose another output folder"
        ) from error


def _titled(title: str, image: Image, width: int) -> Image:
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    shrinks = width < image.shape[1]
    tile = np.full((height + TITLE_HEIGHT_PX, width, 3), 24, np.uint8)
    tile[TITLE_HEIGHT_PX:] = cv2.resize(
        image, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_NEAREST
    )
    origin, white = (6, TITLE_HEIGHT_PX - 7), (240, 240, 240)
    cv2.putText(tile, title, origin, cv2.FONT_HERSHEY_SIMPLEX, 0.45, white, 1, cv2.LINE_AA)
    return tile


def _paint(picture: NDArray[Any], mask: NDArray[np.bool_], color: tuple[int, int, int]) -> Image:
    """Set the pixels of a mask in place: they are few, and by number they are found many times sooner."""
    flat = np.ascontiguousarray(picture).reshape(-1, 3)
    flat[np.flatnonzero(mask)] = color
    return np.asarray(flat.reshape(picture.shape), np.uint8)
