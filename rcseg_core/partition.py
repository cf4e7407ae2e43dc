"""The partition while it is being built: label image, leaf image and merge tree, kept in step.

`labels` are the current regions 1..count; `leaves` the seeds that every pixel came with. The tree links the
two. What is measured of the regions (moments, boxes, pairs) is kept until a pixel changes its region:
grouping adds moments and joins pairs, so several passes need the image only once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rcseg_core.absorption import absorb, refine
from rcseg_core.adjacency import Pairs, find_pairs
from rcseg_core.components import label_parts
from rcseg_core.grouping import Grouped
from rcseg_core.hierarchy import TreeBuilder
from rcseg_core.jit import bare
from rcseg_core.models import Models
from rcseg_core.moments import Moments, accumulate, extended, move_pixels, region_boxes
from rcseg_core.signals import INVALID, Signals


@bare
def relabel(labels, mapping):  # type: ignore[no-untyped-def]
    """labels = mapping[labels], in place."""
    for row in range(labels.shape[0]):
        for col in range(labels.shape[1]):
            labels[row, col] = mapping[labels[row, col]]


@bare
def _follow(merges, target):  # type: ignore[no-untyped-def]
    """target[k]: the region that k ended in; later merges first, so that every chain is followed."""
    for t in range(merges.shape[0] - 1, -1, -1):
        target[merges[t, 1]] = target[merges[t, 0]]


@bare
def _count_runs(labels, sizes):  # type: ignore[no-untyped-def]
    """sizes[k] += pixels of label k, a run at a time."""
    height, width = labels.shape
    for row in range(height):
        start = 0
        for col in range(1, width + 1):
            if col == width or labels[row, col] != labels[row, start]:
                sizes[labels[row, start]] += col - start
                start = col


def count_pixels(labels: NDArray[np.int32], count: int) -> NDArray[np.int64]:
    """(count + 1,) int64 number of pixels of each label."""
    sizes = np.zeros(count + 1, np.int64)
    _count_runs(labels, sizes)
    return sizes


@bare
def _first_groups(labels, within, group):  # type: ignore[no-untyped-def]
    """group[k] = value of `within` at the last run of label k; the same all over k."""
    height, width = labels.shape
    for row in range(height):
        before = np.int32(0)
        for col in range(width):
            k = labels[row, col]
            if k != before:
                group[k] = within[row, col]
                before = k


@bare
def count_together(first, second, counts):  # type: ignore[no-untyped-def]
    """counts[a, b] += pixels with label a in `first` and b in `second`."""
    for row in range(first.shape[0]):
        for col in range(first.shape[1]):
            counts[first[row, col], second[row, col]] += 1


class Partition:
    """Regions 1..count over the pixels (0 unassigned) and the tree that led to them."""

    def __init__(self, seeds: NDArray[np.int32], count: int, within: NDArray[np.int32] | None = None) -> None:
        #: (H, W) int32 or None: regions never reach from one value of it to another
        self.within = within
        self.labels = seeds
        self.leaves = seeds.copy()
        self.count = count
        self.tree = TreeBuilder(count)
        #: (count + 1,) tree node of each current region
        self.nodes = np.arange(count + 1)
        self.forget()

    def forget(self) -> None:
        """What was measured no longer holds."""
        self._moments: Moments | None = None
        #: labels of the pixels that the moments hold; the pixels that differ are added and taken away
        self._counted: NDArray[np.int32] | None = None
        self.pixels_changed()

    def pixels_changed(self) -> None:
        """Pixels have changed their regions: boxes and pairs are void, moments are carried along."""
        self._boxes: NDArray[np.int64] | None = None
        self._pairs: Pairs | None = None
        self._current = False

    def moments(self, signals: Signals, degree: int) -> Moments:
        """Moments of the regions for models up to `degree` or more; grouping may add them up in place."""
        kept, counted = self._moments, self._counted
        fits = kept is not None and kept.cross.shape[2] > degree
        fits = fits and kept is not None and kept.cross.shape[1] == signals.image.shape[2]
        if not fits or kept is None or counted is None:
            kept = accumulate(
                signals.image, signals.flags, self.labels, self.count, degree, self.boxes()
            )  # fmt: skip
        elif not self._current:
            move_pixels(kept, signals.image, signals.flags, counted, self.labels)
        if not self._current or not fits:
            self._counted = self.labels.copy()
        self._moments, self._current = kept, True
        return kept

    def sizes(self) -> NDArray[np.int64]:
        """(count + 1,) pixels of each region; index 0: unassigned ones."""
        sizes: NDArray[np.int64] = count_pixels(self.labels, self.count)
        return sizes

    def boxes(self) -> NDArray[np.int64]:
        """(count + 1, 4) boxes of the regions; grouping may join them in place."""
        if self._boxes is None:
            self._boxes = region_boxes(self.labels, self.count)
        return self._boxes

    def pairs(self, edges: NDArray[np.uint8], max_gap: int) -> Pairs:
        """Adjacent regions, of one value of `within` where that is set."""
        if self._pairs is None:
            self._pairs = find_pairs(self.labels, self.count, edges, max_gap, self.groups())
        return self._pairs

    def absorb(self, signals: Signals, models: Models, max_cost: float) -> None:
        """Grow the regions over unassigned pixels that they predict."""
        if absorb(signals, self.labels, self.leaves, models, max_cost, self.within):
            self.pixels_changed()

    def refine(self, signals: Signals, models: Models, passes: int) -> None:
        """Let boundary pixels move to the region that predicts them better."""
        if refine(signals, self.labels, self.leaves, models, passes):
            self.pixels_changed()

    def apply(self, grouped: Grouped) -> NDArray[np.int64]:
        """Carry out the merges: relabel, record. Returns the old label of each new region, (count + 1,)."""
        if not len(grouped.merges):
            return np.arange(self.count + 1)
        self.tree.merge(grouped.merges, grouped.heights, self.nodes)
        target = np.arange(self.count + 1)
        _follow(grouped.merges, target)
        alive = np.unique(target)  # 0 stays 0
        new = np.zeros(self.count + 1, np.int32)
        new[alive] = np.arange(alive.size)
        self._relabel(new[target], alive)
        return alive

    def _relabel(self, mapping: NDArray[np.int32], alive: NDArray[np.int64]) -> None:
        """New label of each old one (0: freed), old label of each new one; measurements go along."""
        relabel(self.labels, mapping)
        self.nodes = self.nodes[alive]
        self.count = alive.size - 1
        if self._moments is not None:
            self._moments = Moments(*(a[alive] for a in self._moments))
        if self._counted is not None:
            relabel(self._counted, mapping)
        if self._boxes is not None:
            self._boxes = self._boxes[alive]
        if self._pairs is not None:
            self._pairs = self._pairs.relabelled(mapping)

    def add_leftovers(self, flags: NDArray[np.uint8], least: int) -> int:
        """Unassigned pixels become regions where at least `least` hang together; returns how many."""
        old_leaves = self.tree.leaf_count
        extra = label_parts(
            self.labels, self.leaves, flags, self.within, least, self.count + 1, old_leaves + 1
        )
        if extra == 0:
            return 0
        self.tree.add_leaves(extra)
        inner = self.nodes > old_leaves
        self.nodes[inner] += extra
        self.nodes = np.concatenate([self.nodes, np.arange(old_leaves + 1, old_leaves + extra + 1)])
        self.count += extra
        self.pixels_changed()
        if self._moments is not None:
            self._moments = extended(self._moments, self.boxes())
        return extra

    def separate(self, part: NDArray[np.bool_], flags: NDArray[np.uint8], least: int) -> int:
        """Pixels of `part` leave their regions; at least `least` that hang together are a new one.

        Returns how many regions were added; the other pixels stay unassigned.
        """
        self.labels[part] = 0
        self.pixels_changed()
        return self.add_leftovers(np.where(part, flags, np.uint8(INVALID)), least)

    def drop_small(self, least: int) -> None:
        """Free the pixels of regions under `least` pixels, so that they can join a neighbour."""
        keep = self.sizes() >= least
        keep[0] = True
        if not keep.all():
            self.free(keep)

    def free(self, keep: NDArray[np.bool_]) -> None:
        """Free the pixels of all regions but those to keep, (count + 1,); keep[0] is set."""
        mapping = np.where(keep, np.cumsum(keep) - 1, 0).astype(np.int32)
        self._relabel(mapping, np.nonzero(keep)[0])

    def groups(self) -> NDArray[np.int64] | None:
        """(count + 1,) value of `within` that each region lies in; None without one."""
        if self.within is None:
            return None
        group = np.zeros(self.count + 1, np.int64)
        _first_groups(self.labels, self.within, group)
        group[0] = 0
        return group

    def sort_by_size(self) -> NDArray[np.int64]:
        """Number the regions from the largest down (ties by number), without gaps; returns old numbers."""
        sizes = self.sizes()
        order = np.argsort(-sizes[1:], kind="stable") + 1
        order = order[sizes[order] > 0]
        mapping = np.zeros(self.count + 1, np.int32)
        mapping[order] = np.arange(1, order.size + 1)
        order = np.concatenate([[0], order])
        self._relabel(mapping, order)
        return order


def majority(partition: Partition, surfaces: Partition) -> NDArray[np.int64]:
    """(count + 1,) the surface that holds most of each region's pixels (the lowest of equals)."""
    counts = np.zeros((partition.count + 1, surfaces.count + 1), np.int64)
    count_together(partition.labels, surfaces.labels, counts)
    return np.asarray(np.argmax(counts, axis=1), np.int64)
