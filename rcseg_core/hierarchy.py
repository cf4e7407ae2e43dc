"""The merge tree: every grouping is kept, so that it can be cut finer or coarser without segmenting again.

Leaves 1..L are the seeds; merge t makes node L + t. The height of a node is the multiple of the approximation
limit eps_t that its merges needed (0: noise alone explains them), made monotone towards the root. So level 1
is the result, below 1 a finer one; above 1 the grouping goes on from the regions with a limit that many times
as wide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rcseg_core.jit import bare


@dataclass(frozen=True)
class Hierarchy:
    """A forest over the leaves.

    Attributes
    ----------
    leaf_count : L
    children : (M, 2) int64; node L + 1 + t joins children[t]; leaves are 1..L
    heights : (M,) float64, multiples of the approximation limit, never below those of the children
    """

    leaf_count: int
    children: NDArray[np.int64]
    heights: NDArray[np.float64]

    @property
    def node_count(self) -> int:
        return self.leaf_count + len(self.children)

    def parents(self) -> NDArray[np.int64]:
        """(node_count + 1,) int64 parent of each node; 0 for roots and for index 0."""
        parent = np.zeros(self.node_count + 1, np.int64)
        parent[self.children] = (self.leaf_count + 1 + np.arange(len(self.children)))[:, None]
        return parent

    def cut(self, level: float) -> NDArray[np.int64]:
        """(node_count + 1,) int64: the highest ancestor of each node no higher than `level`, or itself."""
        parent = self.parents()
        top = np.arange(self.node_count + 1)
        for node in range(self.node_count, 0, -1):  # parents have higher numbers than their children
            above = parent[node]
            if above and self.heights[above - self.leaf_count - 1] <= level:
                top[node] = top[above]
        return top


@bare
def _record(merges, heights, nodes, node_heights, first_node, children, new_heights):  # type: ignore[no-untyped-def]
    """Give each merge (kept, gone) a node and move the kept region to it."""
    for t in range(merges.shape[0]):
        keep = merges[t, 0]
        gone = merges[t, 1]
        a = nodes[keep]
        b = nodes[gone]
        children[t, 0] = a
        children[t, 1] = b
        height = max(heights[t], max(node_heights[a], node_heights[b]))
        new_heights[t] = height
        node_heights[first_node + t] = height
        nodes[keep] = first_node + t


class TreeBuilder:
    """Collects merges while the partition is built."""

    def __init__(self, leaf_count: int) -> None:
        self.leaf_count = leaf_count
        self._children = np.empty((0, 2), np.int64)
        self._heights = np.empty(0)

    def add_leaves(self, count: int) -> None:
        """More leaves (regions found later); nodes made so far move up by as many."""
        self._children = np.where(self._children > self.leaf_count, self._children + count, self._children)
        self.leaf_count += count

    def merge(
        self, merges: NDArray[np.int64], heights: NDArray[np.float64], nodes: NDArray[np.int64]
    ) -> None:
        """Record merges (kept, gone) of regions in order.

        nodes : (N + 1,) int64, the node of each region; that of a kept region is changed in place
        """
        count = len(merges)
        first = self.leaf_count + len(self._heights) + 1
        node_heights = np.concatenate([np.zeros(self.leaf_count + 1), self._heights, np.zeros(count)])
        children, new_heights = np.empty((count, 2), np.int64), np.empty(count)
        _record(merges, heights, nodes, node_heights, first, children, new_heights)
        self._children = np.concatenate([self._children, children])
        self._heights = np.concatenate([self._heights, new_heights])

    @classmethod
    def resume(cls, tree: Hierarchy) -> TreeBuilder:
        """Go on from a finished tree."""
        builder = cls(tree.leaf_count)
        builder._children, builder._heights = tree.children, tree.heights
        return builder

    def build(self) -> Hierarchy:
        """The forest so far."""
        return Hierarchy(self.leaf_count, self._children, self._heights)
