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
def _point(models, k, row, col, scale, offset, lens):  # type: ignore[no-untyped-def]
    """x, y, z of the model of region k at a pixel, m: numbers, since those of an array would leave registers.

    lens : (fx, fy, cx, cy), fx = 0 where channels are x, y, z
    """
    first = predict(models, k, row, col, 0, 0) * scale[0] + offset[0]
    if lens[0] == 0.0:
        second = predict(models, k, row, col, 0, 1) * scale[1] + offset[1]
        return first, second, predict(models, k, row, col, 0, 2) * scale[2] + offset[2]
    depth = 1.0 / first if first > 0.0 else np.nan
    return (col - lens[2]) / lens[0] * depth, (row - lens[3]) / lens[1] * depth, depth


@bare
def _normal(models, k, row, col, scale, offset, lens, out):  # type: ignore[no-untyped-def]
    """Unit normal of the model of region k at a pixel, towards the sensor."""
    left_x, left_y, left_z = _point(models, k, row, col - STEP_PX, scale, offset, lens)
    x, y, z = _point(models, k, row, col + STEP_PX, scale, offset, lens)
    ux, uy, uz = x - left_x, y - left_y, z - left_z
    top_x, top_y, top_z = _point(models, k, row - STEP_PX, col, scale, offset, lens)
    x, y, z = _point(models, k, row + STEP_PX, col, scale, offset, lens)
    vx, vy, vz = x - top_x, y - top_y, z - top_z
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    toward = -nz if lens[0] == 0.0 else -(nx * left_x + ny * left_y + nz * left_z)
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    if not toward >= 0.0:
        length = -length
    out[0], out[1], out[2] = nx / length, ny / length, nz / length


@bare
def _evaluate(labels, pixels, models, scale, offset, lens, edge, inner, normals):  # type: ignore[no-untyped-def]
    for i in range(pixels.shape[0]):
        row = 0.5 * (pixels[i, 0] + pixels[i, 2])
        col = 0.5 * (pixels[i, 1] + pixels[i, 3])
        down = 1.0 if pixels[i, 2] > pixels[i, 0] else 0.0
        for side in range(2):
            k = labels[pixels[i, 2 * side], pixels[i, 2 * side + 1]]
            way = INSIDE_PX if side == 1 else -INSIDE_PX
            r = pixels[i, 2 * side] + way * down
            c = pixels[i, 2 * side + 1] + way * (1.0 - down)
            x, y, z = _point(models, k, row, col, scale, offset, lens)
            edge[i, side, 0], edge[i, side, 1], edge[i, side, 2] = x, y, z
            x, y, z = _point(models, k, r, c, scale, offset, lens)
            inner[i, side, 0], inner[i, side, 1], inner[i, side, 2] = x, y, z
            _normal(models, k, r, c, scale, offset, lens, normals[i, side])


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
    signals, lens = scene.signals, np.zeros(4)
    if signals.inverse_depth:
        assert scene.camera is not None
        lens[:] = scene.camera.fx, scene.camera.fy, scene.camera.cx, scene.camera.cy
    edge, inner, normals = (np.empty((found, 2, 3)) for _ in range(3))
    _evaluate(scene.labels, pixels, scene.models, signals.scale, signals.offset, lens, edge, inner, normals)
    angle, apart, slant = (np.empty(found) for _ in range(3))
    _compare(edge, inner, normals, angle, apart, slant)
    both = scene.surface_labels[pixels[:, ::2], pixels[:, 1::2]].astype(np.int64)
    return Links(both, pixels, edge, inner, normals, angle, apart, slant)
