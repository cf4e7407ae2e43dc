"""The merge tree: every grouping is kept, so that the partition can be cut finer or coarser without segmenting again.

Leaves 1..L are the seeds; merge t makes node L + t. The height of a node is the multiple of the approximation
limit eps_t that its merges needed (0: noise alone explains them), made monotone towards the root. So level 1 is
the result, below 1 a finer one; above 1 the grouping is taken up again with a limit that many times as wide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


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
        for t, (a, b) in enumerate(self.children):
            parent[a] = parent[b] = self.leaf_count + 1 + t
        return parent

    def cut(self, level: float) -> NDArray[np.int64]:
        """(leaf_count + 1,) int64: for each leaf its highest ancestor whose height is at most `level`."""
        parent = self.parents()
        top = np.arange(self.node_count + 1)
        for node in range(self.node_count, 0, -1):  # parents have higher numbers than their children
            above = parent[node]
            if above and self.heights[above - self.leaf_count - 1] <= level:
                top[node] = top[above]
        return top[: self.leaf_count + 1]


class TreeBuilder:
    """Collects merges while the partition is built."""

    def __init__(self, leaf_count: int) -> None:
        self.leaf_count = leaf_count
        self._children: list[tuple[int, int]] = []
        self._heights: list[float] = []

    def add_leaves(self, count: int) -> None:
        """More leaves (regions found later); nodes made so far move up by as many."""
        old = self.leaf_count
        self._children = [
            (a + count if a > old else a, b + count if b > old else b) for a, b in self._children
        ]
        self.leaf_count += count

    def node_height(self, node: int) -> float:
        return 0.0 if node <= self.leaf_count else self._heights[node - self.leaf_count - 1]

    def merge(self, a: int, b: int, height: float) -> int:
        """Join two roots; returns the new node."""
        self._heights.append(max(height, self.node_height(a), self.node_height(b)))
        self._children.append((a, b))
        return self.leaf_count + len(self._children)

    def build(self) -> Hierarchy:
        return Hierarchy(
            self.leaf_count,
            np.array(self._children, np.int64).reshape(-1, 2),
            np.array(self._heights, float),
        )
