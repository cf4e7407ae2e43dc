"""The merge tree: every grouping is kept, so that it can be cut finer or coarser without segmenting again.

Leaves 1..L are the seeds; merge t makes node L + t. The height of a node is the multiple of the approximation
limit eps_t that its merges needed (0: noise alone explains them), made monotone towards the root. So level 1
is the result, below 1 a finer one; above 1 the grouping goes on from the regions with a limit that many times
as wide. A level is a length as well, since the range tolerance is one at each depth (`Scale`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare


@dataclass(frozen=True)
class Scale:
    """What a level of the merge tree is in metres and in sigmas.

    The approximation limit of the range is ``level * tolerance_m`` at `depth_m`, and in proportion to the
    depth elsewhere; that of colour widens by the same factor.

    Attributes
    ----------
    depth_m : median depth of the frame, m; NaN for x, y, z, whose tolerance is one length everywhere
    tolerance_m : the configured range tolerance there, m
    sigma_m : standard deviation of the range there, m, one pixel's
    """

    depth_m: float
    tolerance_m: float
    sigma_m: float

    def length_m(self, level: float) -> float:
        """Approximation limit at a level, m at the median depth."""
        return level * self.tolerance_m

    def sigmas(self, level: float) -> float:
        """Approximation limit at a level, in standard deviations of the range noise at the median depth."""
        return level * self.tolerance_m / self.sigma_m

    def level(self, *, tolerance_m: float | None = None, sigmas: float | None = None) -> float:
        """The level whose approximation limit is a length, or a multiple of sigma, at the median depth.

        Raises
        ------
        ValueError
            Neither or both are given, one is negative or NaN, or the configured tolerance is zero.
        """
        if (tolerance_m is None) == (sigmas is None):
            raise ValueError("give one of tolerance_m and sigmas")
        name, wanted = ("tolerance_m", tolerance_m) if sigmas is None else ("sigmas", sigmas)
        assert wanted is not None
        if not wanted >= 0:
            raise ValueError(f"{name} = {wanted}: expected 0 or more")
        if self.tolerance_m == 0:
            raise ValueError("grouping.range_tolerance is 0, so levels have no length; give a level")
        return wanted * (1.0 if sigmas is None else self.sigma_m) / self.tolerance_m

    @property
    def noise_level(self) -> float:
        """The level, at most 1, below which the limit is less than one sigma: no scale of its own."""
        return min(1.0, self.sigma_m / self.tolerance_m) if self.tolerance_m > 0 else 1.0


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


@bare
def _mark_members(labels, leaves, last, marks):  # type: ignore[no-untyped-def]
    """marks[label, leaf] for all pairs that occur; last (L + 1,) int64 zeros: scratch."""
    for row in range(labels.shape[0]):
        before = leaf_before = -1
        for col in range(labels.shape[1]):
            label = labels[row, col]
            leaf = leaves[row, col]
            if label == before and leaf == leaf_before:
                continue
            before, leaf_before = label, leaf
            if label > 0 and last[leaf] != label:
                last[leaf] = label
                marks[label, leaf] = True


@bare
def _join(marks, parent, heights, leaf_count, out):  # type: ignore[no-untyped-def]
    for label in range(1, marks.shape[0]):
        count = 0
        for node in range(marks.shape[1]):
            count += marks[label, node]
        if marks[label, 0]:  # pixels of no leaf join nothing
            out[label] = 0.0 if count == 1 else np.inf
            continue
        for node in range(1, marks.shape[1]):
            if not marks[label, node]:
                continue
            if count == 1:
                out[label] = heights[node - leaf_count - 1] if node > leaf_count else 0.0
                break
            above = parent[node]
            if above == 0:
                break
            count -= marks[label, above]
            marks[label, above] = True


def join_heights(
    tree: Hierarchy, labels: NDArray[np.int32], leaves: NDArray[np.int32], count: int
) -> NDArray[np.float64]:
    """The level from which on the pixels of a label hang together in a tree.

    Parameters
    ----------
    labels : (H, W) int32, 0 for none, up to `count`
    leaves : (H, W) int32, leaf of each pixel, 0 for none

    Returns
    -------
    (count + 1,) float64: height of the lowest common ancestor of the leaves of each label; inf without one
    """
    out = np.full(count + 1, np.inf)
    marks = np.zeros((count + 1, tree.node_count + 1), np.bool_)
    _mark_members(labels, leaves, np.zeros(tree.leaf_count + 1, np.int64), marks)
    _join(marks, tree.parents(), tree.heights, tree.leaf_count, out)
    return out


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
