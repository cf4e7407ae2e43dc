"""The region graph of grouping: who touches whom, in arrays that merges change in place (section 6).

Every pair of adjacent regions is an edge, and every region keeps a linked list of its half-edges, so that a
merge only relinks the edges of the smaller side. Dead edges stay in the lists until a walk meets them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.graph.adjacency import Pairs


class Graph(NamedTuple):
    """Incidence lists over half-edges: half-edge 2e is edge e seen from ends[e, 0], 2e + 1 from ends[e, 1].

    ends : (E, 2) int64; first, last : (N,) int64 half-edge or -1; length : (N,) int64 entries of each list,
    dead ones included until they are met; following : (2E,) int64;
    alive : (E,) bool; version : (E,) int64; boundary, range_crossed, color_crossed : (E,) float64;
    height : (E,) float64, multiple of the approximation limit that the pair needed when last compared
    pixels : (E,) float64, of both ends when last compared
    """

    ends: NDArray[np.int64]
    first: NDArray[np.int64]
    last: NDArray[np.int64]
    length: NDArray[np.int64]
    following: NDArray[np.int64]
    alive: NDArray[np.bool_]
    version: NDArray[np.int64]
    boundary: NDArray[np.float64]
    range_crossed: NDArray[np.float64]
    color_crossed: NDArray[np.float64]
    height: NDArray[np.float64]
    pixels: NDArray[np.float64]


def make_graph(pairs: Pairs, count: int) -> Graph:
    """Incidence lists of regions 1..count; the arrays of `pairs` are copied."""
    n = pairs.nodes.shape[0]
    graph = Graph(
        pairs.nodes.copy(),
        np.full(count + 1, -1, np.int64),
        np.full(count + 1, -1, np.int64),
        np.zeros(count + 1, np.int64),
        np.full(2 * n, -1, np.int64),
        np.ones(n, np.bool_),
        np.zeros(n, np.int64),
        pairs.boundary.copy(),
        pairs.range_crossed.copy(),
        pairs.color_crossed.copy(),
        np.zeros(n),
        np.zeros(n),
    )
    _link(graph)
    return graph


@bare
def _link(graph):  # type: ignore[no-untyped-def]
    for half in range(2 * graph.ends.shape[0]):
        _append(graph, graph.ends[half // 2, half % 2], half)


@bare
def _append(graph, node, half):  # type: ignore[no-untyped-def]
    if graph.first[node] < 0:
        graph.first[node] = half
    else:
        graph.following[graph.last[node]] = half
    graph.last[node] = half
    graph.following[half] = -1
    graph.length[node] += 1


@bare
def _find_edge(graph, node, target):  # type: ignore[no-untyped-def]
    """The living edge between two nodes, or -1; dead entries met on the way leave the list of `node`."""
    before = np.int64(-1)
    half = graph.first[node]
    while half >= 0:
        following = graph.following[half]
        if graph.alive[half // 2]:
            if graph.ends[half // 2, 1 - half % 2] == target:
                return half // 2
            before = half
        else:
            if before < 0:
                graph.first[node] = following
            else:
                graph.following[before] = following
            if graph.last[node] == half:
                graph.last[node] = before
            graph.length[node] -= 1
        half = following
    return np.int64(-1)


@bare
def merge_edges(graph, keep, gone, fresh):  # type: ignore[no-untyped-def]
    """Give the edges of `gone` to `keep`; parallel edges become one. `fresh` lists what to compare anew.

    Only the list of `gone` is walked, and for each of its neighbours the shorter of two lists: the list of a
    large region is long. Returns how many edges are fresh.
    """
    count = 0
    half = graph.first[gone]
    while half >= 0:
        following = graph.following[half]
        edge = half // 2
        if graph.alive[edge]:
            other = graph.ends[edge, 1 - half % 2]
            if other == keep:
                graph.alive[edge] = False
            else:
                if graph.length[other] <= graph.length[keep]:
                    twin = _find_edge(graph, other, keep)
                else:
                    twin = _find_edge(graph, keep, other)
                if twin >= 0:
                    graph.boundary[twin] += graph.boundary[edge]
                    graph.range_crossed[twin] += graph.range_crossed[edge]
                    graph.color_crossed[twin] += graph.color_crossed[edge]
                    graph.alive[edge] = False
                    fresh[count] = twin
                else:
                    graph.ends[edge, half % 2] = keep
                    _append(graph, keep, half)
                    fresh[count] = edge
                count += 1
        half = following
    graph.first[gone] = -1
    return count
