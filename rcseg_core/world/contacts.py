"""Where surfaces border on each other in the image, and what their models are there.

A link is a pair of pixels of two surfaces, next to each other along a row or a column or with a small gap
between. Both models are evaluated half-way (do they meet?) and a little way inside (how do they bend?), in
3-D; measured points play no part.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.models.polynomials import predict
from rcseg_core.world.scene import Scene

Array = NDArray[np.float64]

#: Pixels without a label that a link may cross.
GAP_PX = 3
#: Pixels from the border at which a model tells how it bends, and half the step of its derivatives.
INSIDE_PX = 3.0
STEP_PX = 1.5


class Links(NamedTuple):
    """Links of a frame, ordered by row and column.

    Attributes
    ----------
    surfaces : (n, 2) int64, labels of the two
    pixels : (n, 4) int64, row and column of both
    edge : (n, 2, 3) float64, m: both models half-way between the pixels; NaN behind the camera
    inner : (n, 2, 3) float64, m: each model inside its own surface
    normals : (n, 2, 3) float64: its unit normal there, towards the sensor
    angle : (n,) float64, rad: between the normals; positive at a convex crease, negative at a concave one
    apart : (n,) float64, m: distance of both models half-way
    slant : (n,) float64, m: what a pixel is on both surfaces together
    """

    surfaces: NDArray[np.int64]
    pixels: NDArray[np.int64]
    edge: Array
    inner: Array
    normals: Array
    angle: Array
    apart: Array
    slant: Array


@bare
def _find(surfaces, gap, out):  # type: ignore[no-untyped-def]
    """Links along rows, then columns: out (n, 4) row, column of both pixels. Returns their number, which may
    be more than there is room for."""
    height, width = surfaces.shape
    found = 0
    for row in range(height):
        last = -1
        for col in range(width):
            s = surfaces[row, col]
            if s <= 0:
                continue
            if last >= 0 and surfaces[row, last] != s and col - last <= gap + 1:
                if found < out.shape[0]:
                    out[found, 0] = row
                    out[found, 1] = last
                    out[found, 2] = row
                    out[found, 3] = col
                found += 1
            last = col
    for row in range(height - 1):
        for col in range(width):
            s = surfaces[row, col]
            if s <= 0 or surfaces[row + 1, col] == s:
                continue
            for below in range(row + 1, min(row + gap + 2, height)):
                other = surfaces[below, col]
                if other <= 0:
                    continue
                if other != s:
                    if found < out.shape[0]:
                        out[found, 0] = row
                        out[found, 1] = col
                        out[found, 2] = below
                        out[found, 3] = col
                    found += 1
                break
    return found


@bare
def _point(models, k, row, col, n_range, scale, offset, lens, out):  # type: ignore[no-untyped-def]
    """The model of region k at a pixel, m; lens : (fx, fy, cx, cy), fx = 0 where channels are x, y, z."""
    if lens[0] == 0.0:
        for c in range(n_range):
            out[c] = predict(models, k, row, col, 0, c) * scale[c] + offset[c]
        return
    inverse = predict(models, k, row, col, 0, 0) * scale[0] + offset[0]
    depth = 1.0 / inverse if inverse > 0.0 else np.nan
    out[0] = (col - lens[2]) / lens[0] * depth
    out[1] = (row - lens[3]) / lens[1] * depth
    out[2] = depth


@bare
def _normal(models, k, row, col, n_range, scale, offset, lens, scratch, out):  # type: ignore[no-untyped-def]
    """Unit normal of the model of region k at a pixel, towards the sensor."""
    _point(models, k, row, col - STEP_PX, n_range, scale, offset, lens, scratch[0])
    _point(models, k, row, col + STEP_PX, n_range, scale, offset, lens, scratch[1])
    _point(models, k, row - STEP_PX, col, n_range, scale, offset, lens, scratch[2])
    _point(models, k, row + STEP_PX, col, n_range, scale, offset, lens, scratch[3])
    length = 0.0
    toward = 0.0
    for i in range(3):
        a = (i + 1) % 3
        b = (i + 2) % 3
        out[i] = (scratch[1, a] - scratch[0, a]) * (scratch[3, b] - scratch[2, b]) - (
            scratch[1, b] - scratch[0, b]
        ) * (scratch[3, a] - scratch[2, a])
        length += out[i] * out[i]
        toward -= out[i] * scratch[0, i]
    if lens[0] == 0.0:
        toward = -out[2]
    length = np.sqrt(length)
    for i in range(3):
        out[i] /= length if toward >= 0.0 else -length


@bare
def _evaluate(labels, pixels, models, n_range, scale, offset, lens, scratch, edge, inner, normals):  # type: ignore[no-untyped-def]
    for i in range(pixels.shape[0]):
        row = 0.5 * (pixels[i, 0] + pixels[i, 2])
        col = 0.5 * (pixels[i, 1] + pixels[i, 3])
        down = 1.0 if pixels[i, 2] > pixels[i, 0] else 0.0
        for side in range(2):
            k = labels[pixels[i, 2 * side], pixels[i, 2 * side + 1]]
            way = INSIDE_PX if side == 1 else -INSIDE_PX
            r = pixels[i, 2 * side] + way * down
            c = pixels[i, 2 * side + 1] + way * (1.0 - down)
            _point(models, k, row, col, n_range, scale, offset, lens, edge[i, side])
            _point(models, k, r, c, n_range, scale, offset, lens, inner[i, side])
            _normal(models, k, r, c, n_range, scale, offset, lens, scratch, normals[i, side])


@bare
def _compare(edge, inner, normals, angle, apart, slant):  # type: ignore[no-untyped-def]
    """The last three of `Links`."""
    for i in range(edge.shape[0]):
        cosine = bend = across = gap = first = second = 0.0
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            cosine += normals[i, 0, a] * normals[i, 1, a]
            bend += (inner[i, 0, a] - inner[i, 1, a]) * (normals[i, 0, a] - normals[i, 1, a])
            across += (normals[i, 0, b] * normals[i, 1, c] - normals[i, 0, c] * normals[i, 1, b]) ** 2
            gap += (edge[i, 0, a] - edge[i, 1, a]) ** 2
            first += (edge[i, 0, a] - inner[i, 0, a]) ** 2
            second += (edge[i, 1, a] - inner[i, 1, a]) ** 2
        angle[i] = np.arctan2(np.sqrt(across), cosine)
        if bend < 0.0:
            angle[i] = -angle[i]
        apart[i] = np.sqrt(gap)
        slant[i] = (np.sqrt(first) + np.sqrt(second)) / (INSIDE_PX + 0.5)


def find_links(scene: Scene) -> Links:
    """All links of a frame."""
    room = np.empty((4 * sum(scene.surface_labels.shape), 4), np.int64)
    found = _find(scene.surface_labels, GAP_PX, room)
    if found > len(room):
        room = np.empty((found, 4), np.int64)
        _find(scene.surface_labels, GAP_PX, room)
    pixels = room[:found]
    signals, n = scene.signals, scene.signals.n_range
    lens = np.zeros(4)
    if signals.inverse_depth:
        assert scene.camera is not None
        lens[:] = scene.camera.fx, scene.camera.fy, scene.camera.cx, scene.camera.cy
    edge, inner, normals = (np.empty((found, 2, 3)) for _ in range(3))
    _evaluate(
        scene.labels, pixels, scene.models, n, signals.scale, signals.offset, lens, np.empty((4, 3)), edge,
        inner, normals,
    )  # fmt: skip
    angle, apart, slant = (np.empty(found) for _ in range(3))
    _compare(edge, inner, normals, angle, apart, slant)
    both = scene.surface_labels[pixels[:, ::2], pixels[:, 1::2]].astype(np.int64)
    return Links(both, pixels, edge, inner, normals, angle, apart, slant)
