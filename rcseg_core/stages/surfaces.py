"""Continuous surfaces: unions of regions, which the range alone tells apart (the aim of section 2).

Where surfaces are found first, they bound the windows of colour, and each region belongs to the surface that
holds most of it; where both signals are grouped at once, the regions are grouped further by their range.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rcseg_core.config import SegmenterConfig
from rcseg_core.graph.adjacency import Pairs, spread
from rcseg_core.graph.grouping import group
from rcseg_core.models.moments import Moments
from rcseg_core.partition.partition import Partition, relabel
from rcseg_core.signal.signals import Signals
from rcseg_core.stages.measures import make_rule

#: Holes up to twice this wide are bridged when surfaces bound the windows of colour.
HOLE_PX = 4


def bridge_holes(labels: NDArray[np.int32]) -> NDArray[np.int32]:
    """`labels` spread over small holes, so that missing pixels do not fence in the windows of colour."""
    return spread(labels, np.zeros(labels.shape, np.uint8), HOLE_PX)[0]


def _groups(grouped_count: int, merges: NDArray[np.int64]) -> NDArray[np.int64]:
    """(N + 1,) lowest label of the group of each region."""
    parent = np.arange(grouped_count + 1)
    for keep, gone in merges:
        parent[gone] = keep
    for k in range(1, grouped_count + 1):
        root = k
        while parent[root] != root:
            root = parent[root]
        parent[k] = root
    lowest = np.full(grouped_count + 1, grouped_count + 1)
    np.minimum.at(lowest, parent, np.arange(grouped_count + 1))
    return lowest[parent]


def copied(moments: Moments) -> Moments:
    """Moments that grouping may change."""
    return Moments(*(a.copy() for a in moments))


def surfaces_of(
    partition: Partition, signals: Signals, moments: Moments, boxes: NDArray[np.int64], pairs: Pairs,
    config: SegmenterConfig,
) -> NDArray[np.int64]:  # fmt: skip
    """(N + 1,) surface of each region of a joint partition: regions that one range model explains."""
    degree = np.full((partition.count + 1, 2), config.generalization.max_range_degree, np.int64)
    rule = make_rule(signals, degree, config, use_color=False)
    grouped = group(copied(moments), boxes.copy(), pairs, rule, config.grouping.edge_gate)
    return _groups(partition.count, grouped.merges)


def number_surfaces(
    partition: Partition, surface_of: NDArray[np.int64]
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Surfaces numbered from the largest down: the label image, and the number of each region's surface."""
    sizes = np.bincount(surface_of, partition.sizes(), minlength=int(surface_of.max()) + 1)
    sizes[surface_of[0]] -= partition.sizes()[0]
    order = np.argsort(-sizes, kind="stable")
    rank = np.empty(order.size, np.int64)
    rank[order] = np.arange(1, order.size + 1)
    number = rank[surface_of]
    number[0] = 0
    surface_labels = partition.labels.copy()
    relabel(surface_labels, number.astype(np.int32))
    return surface_labels, number
