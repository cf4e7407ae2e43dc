"""The partition while it is being built: label image, leaf image and merge tree, kept in step.

`labels` are the current regions 1..count; `leaves` the seeds that every pixel came with. The tree links the two.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rcseg_core.grouping import Grouped
from rcseg_core.hierarchy import TreeBuilder


class Partition:
    """Regions 1..count over the pixels (0 unassigned) and the tree that led to them."""

    def __init__(
        self, seeds: NDArray[np.int32], count: int, within: NDArray[np.int32] | None = None
    ) -> None:
        #: (H, W) int32 or None: regions never reach from one value of it to another
        self.within = within
        self.labels = seeds
        self.leaves = seeds.copy()
        self.count = count
        self.tree = TreeBuilder(count)
        #: (count + 1,) tree node of each current region
        self.nodes = np.arange(count + 1)
        #: (count + 1,) range degree that each region has earned in grouping
        self.degree = np.ones(count + 1, np.int64)

    def apply(self, grouped: Grouped) -> NDArray[np.int64]:
        """Carry out the merges: relabel and record them. Returns the old label of each new region, (count + 1,)."""
        for (keep, gone), height in zip(grouped.merges.tolist(), grouped.heights.tolist()):
            self.nodes[keep] = self.tree.merge(int(self.nodes[keep]), int(self.nodes[gone]), height)
        target = np.arange(self.count + 1)
        for keep, gone in grouped.merges[::-1].tolist():  # later merges first, so that every chain is followed
            target[gone] = target[keep]
        alive = np.unique(target)  # 0 stays 0
        new = np.zeros(self.count + 1, np.int32)
        new[alive] = np.arange(alive.size)
        self._relabel(new[target], alive)
        return alive

    def _relabel(self, mapping: NDArray[np.int32], alive: NDArray[np.int64]) -> None:
        self.labels = mapping[self.labels]
        self.nodes = self.nodes[alive]
        self.degree = self.degree[alive]
        self.count = alive.size - 1

    def add_leftovers(self, candidates: NDArray[np.bool_], least: int) -> int:
        """Connected unassigned pixels become regions where at least `least` hang together; returns how many did."""
        rest = (candidates & (self.labels == 0)).astype(np.uint8)
        if not rest.any():
            return 0
        parts = cv2.connectedComponents(rest, connectivity=4)[1]
        if self.within is not None:
            at = rest > 0
            keys = parts[at].astype(np.int64) * (int(self.within.max()) + 1) + self.within[at]
            parts[at] = np.unique(keys, return_inverse=True)[1] + 1
        areas = np.bincount(parts[rest > 0])
        large = areas >= least
        found = areas.size
        extra = int(large.sum())
        if extra == 0:
            return 0
        number = np.zeros(found, np.int32)
        number[large] = np.arange(1, extra + 1)
        part = np.where(rest > 0, number[parts], 0)
        new = part > 0
        self.labels[new] = part[new] + self.count
        old_leaves = self.tree.leaf_count
        self.leaves[new] = part[new] + old_leaves
        self.tree.add_leaves(extra)
        inner = self.nodes > old_leaves
        self.nodes[inner] += extra
        self.nodes = np.concatenate([self.nodes, np.arange(old_leaves + 1, old_leaves + extra + 1)])
        self.degree = np.concatenate([self.degree, np.ones(extra, np.int64)])
        self.count += extra
        return extra

    def drop_small(self, least: int) -> None:
        """Free the pixels of regions under `least` pixels, so that they can join a neighbour."""
        sizes = np.bincount(self.labels.ravel(), minlength=self.count + 1)
        keep = sizes >= least
        keep[0] = True
        if keep.all():
            return
        mapping = np.where(keep, np.cumsum(keep) - 1, 0).astype(np.int32)
        self._relabel(mapping, np.nonzero(keep)[0])

    def groups(self) -> NDArray[np.int64] | None:
        """(count + 1,) value of `within` that each region lies in; None without one."""
        if self.within is None:
            return None
        group = np.zeros(self.count + 1, np.int64)
        group[self.labels.ravel()] = self.within.ravel()
        group[0] = 0
        return group

    def sort_by_size(self) -> NDArray[np.int64]:
        """Number the regions from the largest down (ties by number), without gaps; returns the old numbers."""
        sizes = np.bincount(self.labels.ravel(), minlength=self.count + 1)
        order = np.argsort(-sizes[1:], kind="stable") + 1
        order = order[sizes[order] > 0]
        mapping = np.zeros(self.count + 1, np.int32)
        mapping[order] = np.arange(1, order.size + 1)
        order = np.concatenate([[0], order])
        self._relabel(mapping, order)
        return order
