"""The partition while it is being built: label image, leaf image and merge tree, kept in step.

`labels` are the current regions 1..count; `leaves` the seeds that every pixel came with. The tree links the
two. What is measured of the regions (moments, boxes, pairs) is kept until a pixel changes its region:
grouping adds moments and joins pairs, so several passes need the image only once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.jit import bare
from rcseg_core.compute.parallel import BANDS, over_bands
from rcseg_core.graph.adjacency import Pairs, enter, find_pairs
from rcseg_core.graph.components import by_size, label_parts
from rcseg_core.graph.grouping import Grouped, Held
from rcseg_core.graph.hierarchy import TreeBuilder
from rcseg_core.models.moments import Moments, accumulate, counted, extended, move_pixels, region_boxes
from rcseg_core.models.polynomials import Models
from rcseg_core.pixels.absorption import Before, absorb, refine
from rcseg_core.signal.signals import INVALID, Signals


@bare
def _relabel(labels, mapping):  # type: ignore[no-untyped-def]
    for row in range(labels.shape[0]):
        for col in range(labels.shape[1]):
            labels[row, col] = mapping[np.uint32(labels[row, col])]  # never negative


def relabel(labels: NDArray[np.int32], mapping: NDArray[np.int32]) -> None:
    """labels = mapping[labels], in place."""
    over_bands(len(labels), lambda _, first, last: _relabel(labels[first:last], mapping))


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
    sizes = np.zeros((BANDS, count + 1), np.int64)
    over_bands(len(labels), lambda i, first, last: _count_runs(labels[first:last], sizes[i]))
    return np.asarray(sizes.sum(axis=0))


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
def count_together(first, second, width, keys, tally):  # type: ignore[no-untyped-def]
    """tally[., 0] += pixels with label a in `first` and b in `second`, at key a * width + b of a hash table.

    keys, tally : see `adjacency.touching`. Returns the number of entries, or -1 when the table is too full.
    """
    entries = 0
    for row in range(first.shape[0]):
        start = 0
        for col in range(1, first.shape[1] + 1):
            a = first[row, start]
            b = second[row, start]
            if col < first.shape[1] and first[row, col] == a and second[row, col] == b:
                continue
            entries += enter(keys, tally, np.int64(a) * width + b, float(col - start), 0.0, 0.0)
            if 2 * entries > keys.shape[0]:
                return -1
            start = col
    return entries


class Partition:
    """Regions 1..count over the pixels (0 unassigned) and the tree that led to them."""

    def __init__(
        self, seeds: NDArray[np.int32], count: int, within: NDArray[np.int32] | None = None,
        before: NDArray[np.int32] | None = None, favour: float = 1.0,
    ) -> None:  # fmt: skip
        #: (H, W) int32 or None: regions never reach from one value of it to another
        self.within = within
        #: (H, W) int32 or None: regions of the last frame as this one shows them, 0 not known
        self.before = before if favour > 1.0 else None
        self.favour = favour
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
        #: labels of the pixels that the moments hold, 0 of all others; what differs is added and taken away
        self._counted: NDArray[np.int32] | None = None
        self.pixels_changed()

    def pixels_changed(self) -> None:
        """Pixels have changed their regions: boxes, sizes and pairs are void, moments are carried along."""
        self._boxes: NDArray[np.int64] | None = None
        self._sizes: NDArray[np.int64] | None = None
        self._pairs: Pairs | None = None
        #: what the pairs were looked for with: edges, gap and bounds
        self._pairs_of: tuple[object, int, object] = (None, 0, None)
        self._current = False

    def moments(self, signals: Signals, degree: int) -> Moments:
        """Moments of the regions for models up to `degree` or more; grouping may add them up in place."""
        kept, held = self._moments, self._counted
        fits = kept is not None and kept.cross.shape[2] > degree
        fits = fits and kept is not None and kept.cross.shape[1] == signals.image.shape[2]
        if fits and self._current and kept is not None:
            return kept
        wanted = counted(self.labels, signals.flags)
        if fits and kept is not None and held is not None:
            move_pixels(kept, signals.image, held, wanted)
        else:
            kept = accumulate(
                signals.image, signals.flags, self.labels, self.count, degree, self.boxes()
            )  # fmt: skip
        self._counted = wanted
        self._moments, self._current = kept, True
        return kept

    def sizes(self) -> NDArray[np.int64]:
        """(count + 1,) pixels of each region; index 0: unassigned ones. Not to be written to."""
        if self._sizes is None:
            self._sizes = count_pixels(self.labels, self.count)
        return self._sizes

    def boxes(self) -> NDArray[np.int64]:
        """(count + 1, 4) boxes of the regions; grouping may join them in place."""
        if self._boxes is None:
            self._boxes = region_boxes(self.labels, self.count)
        return self._boxes

    def pairs(self, edges: NDArray[np.uint8], max_gap: int) -> Pairs:
        """Adjacent regions, of one value of `within` where that is set; `edges` is held to stay as it is."""
        before, gap, bounds = self._pairs_of
        known = before is edges and gap == max_gap and bounds is self.within
        if self._pairs is None or not known:
            self._pairs = find_pairs(self.labels, self.count, edges, max_gap, self.groups())
            self._pairs_of = (edges, max_gap, self.within)
        return self._pairs

    def absorb(self, signals: Signals, models: Models, max_cost: float) -> None:
        """Grow the regions over unassigned pixels that they predict."""
        before = self._decided()
        if absorb(signals, self.labels, self.leaves, models, max_cost, self.within, before):
            self.pixels_changed()

    def refine(self, signals: Signals, models: Models, passes: int) -> None:
        """Let boundary pixels move to the region that predicts them better."""
        if refine(signals, self.labels, self.leaves, models, passes, self._decided()):
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
        if self._sizes is not None:
            sizes = np.zeros(alive.size, np.int64)
            np.add.at(sizes, mapping, self._sizes)
            self._sizes = sizes
        if self._pairs is not None:
            self._pairs = self._pairs.relabelled(mapping)

    def add_leftovers(
        self, flags: NDArray[np.uint8], least: int, within: NDArray[np.int32] | None = None
    ) -> int:
        """Unassigned pixels become regions where at least `least` hang together; returns how many.

        within : (H, W) int32, none reaches from one value of it to another; by default that of the partition
        """
        old_leaves = self.tree.leaf_count
        extra = label_parts(
            self.labels,
            self.leaves,
            flags,
            self.within if within is None else within,
            least,
            self.count + 1,
            old_leaves + 1,
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

    def separate(self, parts: NDArray[np.int32], flags: NDArray[np.uint8], least: int) -> int:
        """Pixels of `parts` > 0 leave their regions; at least `least` of one part that hang together are new.

        Returns how many regions were added; the other pixels stay unassigned.
        """
        self.labels[parts > 0] = 0
        self.pixels_changed()
        return self.add_leftovers(np.where(parts > 0, flags, np.uint8(INVALID)), least, parts)

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

    def held(self) -> Held | None:
        """What the last frame decided of the regions, as grouping takes it; None without `before`.

        A region was part of that of the last frame which holds more than half of it.
        """
        if self.before is None:
            return None
        names, pixels = _most(self.labels, self.count, self.before, int(self.before.max(initial=0)))
        names[2 * pixels <= self.sizes()] = 0
        names[0] = 0
        return Held(names, self.favour)

    def _decided(self) -> Before | None:
        """The same, as pixels take it."""
        held = self.held()
        return None if held is None or self.before is None else Before(self.before, *held)

    def sort_by_size(self) -> NDArray[np.int64]:
        """Number the regions from the largest down (ties by number), without gaps; returns old numbers."""
        order, mapping = by_size(self.sizes())
        self._relabel(mapping, order)
        return order


def majority(partition: Partition, surfaces: Partition) -> NDArray[np.int64]:
    """(count + 1,) the surface that holds most of each region's pixels (the lowest of equals)."""
    return _most(partition.labels, partition.count, surfaces.labels, surfaces.count)[0]


def _most(
    labels: NDArray[np.int32], count: int, others: NDArray[np.int32], most: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """(count + 1,) the value 0..most of `others` that holds most pixels of each label, and how many."""
    width, size = most + 1, 1 << int(np.ceil(np.log2(4 * (count + 64))))
    entries = -1
    while entries < 0:
        keys, tally = np.full(size, -1, np.int64), np.zeros((size, 3))
        entries = count_together(labels, others, width, keys, tally)
        size *= 2
    used = np.nonzero(keys >= 0)[0]
    label, other = np.divmod(keys[used], width)
    order = np.lexsort((other, -tally[used, 0], label))
    found, first = np.unique(label[order], return_index=True)
    out, pixels = np.zeros(count + 1, np.int64), np.zeros(count + 1)
    out[found] = other[order][first]
    pixels[found] = tally[used, 0][order][first]
    return out, pixels
