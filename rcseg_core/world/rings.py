"""Rings round the surfaces of a label image: one walk along all borders, every vertex between two pixels.

A vertex lies between a pixel of the surface and a neighbour that is none, at half-way or where the models
of both are equal. The walk follows the border with the surface on one hand and parts pixels that touch at
corners only. In each square of four pixels the lines of two rings stay in opposite corners, so no ring ever
meets itself or another, whatever the labels are and wherever on its way between two pixels a vertex lies.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.models.polynomials import Models, predict

Array = NDArray[np.float64]

#: A vertex is at least this far from the pixels beside it, in pixels.
CLEARANCE = 0.02
#: Directions right, down, left, up; each is the one before turned by a quarter.
DOWN, RIGHT = np.array([0, 1, 0, -1]), np.array([1, 0, -1, 0])


class Rings(NamedTuple):
    """Rings of all surfaces, one after another.

    Attributes
    ----------
    vertices : (n, 2) float64, row and column
    owners : (n, 2) int64, row and column of the surface's pixel beside each vertex
    starts : (k + 1,) int64, first vertex of each ring
    surfaces : (k,) int32, whose ring it is
    areas : (k,) float64, pixels; positive of outer rings, negative of holes
    """

    vertices: Array
    owners: NDArray[np.int64]
    starts: NDArray[np.int64]
    surfaces: NDArray[np.int32]
    areas: Array


@bare
def _is(surfaces, row, col, s):  # type: ignore[no-untyped-def]
    return 0 <= row < surfaces.shape[0] and 0 <= col < surfaces.shape[1] and surfaces[row, col] == s


@bare
def _share(labels, models, row, col, row_2, col_2):  # type: ignore[no-untyped-def]
    """Share of the way from a pixel to the next one at which both models are equal; else half."""
    if row_2 < 0 or col_2 < 0 or row_2 >= labels.shape[0] or col_2 >= labels.shape[1]:
        return 0.5
    k, other = labels[row, col], labels[row_2, col_2]
    if k <= 0 or other <= 0 or k == other:
        return 0.5
    r, c, r_2, c_2 = float(row), float(col), float(row_2), float(col_2)
    here = predict(models, k, r, c, 0, 0) - predict(models, other, r, c, 0, 0)
    there = predict(models, k, r_2, c_2, 0, 0) - predict(models, other, r_2, c_2, 0, 0)
    if here * there >= 0.0:
        return 0.5
    return min(max(here / (here - there), CLEARANCE), 1.0 - CLEARANCE)


@bare
def _mark(surfaces, edges):  # type: ignore[no-untyped-def]
    """edges (H, W) uint8: a bit for each direction in which a surface ends. Returns their number."""
    height, width = surfaces.shape
    count = 0
    for row in range(height):
        for col in range(width):
            s = surfaces[row, col]
            bits = 0
            if s > 0:
                if col + 1 >= width or surfaces[row, col + 1] != s:
                    bits |= 1
                if row + 1 >= height or surfaces[row + 1, col] != s:
                    bits |= 2
                if col == 0 or surfaces[row, col - 1] != s:
                    bits |= 4
                if row == 0 or surfaces[row - 1, col] != s:
                    bits |= 8
                count += (bits & 1) + ((bits >> 1) & 1) + ((bits >> 2) & 1) + ((bits >> 3) & 1)
            edges[row, col] = bits
    return count


@bare
def _walk(surfaces, labels, models, subpixel, edges, vertices, owners, starts, whose, areas):  # type: ignore[no-untyped-def]
    """Walk along every edge that is marked, once. Returns the number of rings."""
    height, width = surfaces.shape
    rings = 0
    at = 0
    for first_row in range(height):
        for first_col in range(width):
            while edges[first_row, first_col]:
                s = surfaces[first_row, first_col]
                d = 0
                while not (edges[first_row, first_col] >> d) & 1:
                    d += 1
                row, col = first_row, first_col
                starts[rings] = at
                whose[rings] = s
                twice = 0.0
                while (edges[row, col] >> d) & 1:
                    edges[row, col] ^= 1 << d
                    row_2, col_2 = row + DOWN[d], col + RIGHT[d]
                    share = _share(labels, models, row, col, row_2, col_2) if subpixel else 0.5
                    vertices[at, 0] = row + share * DOWN[d]
                    vertices[at, 1] = col + share * RIGHT[d]
                    owners[at, 0] = row
                    owners[at, 1] = col
                    if at > starts[rings]:
                        twice += vertices[at - 1, 1] * vertices[at, 0] - vertices[at, 1] * vertices[at - 1, 0]
                    at += 1
                    along = (d + 1) % 4
                    if not _is(surfaces, row + DOWN[along], col + RIGHT[along], s):
                        d = along
                        continue
                    row += DOWN[along]
                    col += RIGHT[along]
                    if _is(surfaces, row + DOWN[d], col + RIGHT[d], s):
                        row += DOWN[d]
                        col += RIGHT[d]
                        d = (d + 3) % 4
                a, b = at - 1, starts[rings]
                twice += vertices[a, 1] * vertices[b, 0] - vertices[b, 1] * vertices[a, 0]
                areas[rings] = 0.5 * twice
                rings += 1
    starts[rings] = at
    return rings


def trace(surfaces: NDArray[np.int32], labels: NDArray[np.int32], models: Models, subpixel: bool) -> Rings:
    """The rings of all surfaces 1..M.

    Parameters
    ----------
    surfaces : (H, W) int32, 0 for none
    labels : (H, W) int32, regions that `models` belong to
    subpixel : whether the first channel of the models tells where two of them meet (inverse depth)
    """
    edges = np.empty(surfaces.shape, np.uint8)
    count = _mark(surfaces, edges)
    vertices, owners = np.empty((count, 2)), np.empty((count, 2), np.int64)
    most = count // 4 + 2  # a ring has four vertices at least
    starts, whose, areas = np.empty(most, np.int64), np.empty(most, np.int32), np.empty(most)
    rings = _walk(surfaces, labels, models, subpixel, edges, vertices, owners, starts, whose, areas)
    return Rings(vertices, owners, starts[: rings + 1], whose[:rings], areas[:rings])
