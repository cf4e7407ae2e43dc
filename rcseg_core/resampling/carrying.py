"""A result found on another image of the scene, carried to the pixels of the frame itself.

Squares of pixels and the view of a scanner's grid are segmented in the frame's place. Their partition, its
tree and its surfaces hold for the frame as well; only the pixels, and the models of what was measured at
them, are others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from rcseg_core.config import SegmenterConfig
from rcseg_core.frame import RangeColorFrame
from rcseg_core.graph.components import by_size
from rcseg_core.graph.grouping import Grouped
from rcseg_core.models.polynomials import Models
from rcseg_core.partition.partition import Partition, count_pixels, relabel
from rcseg_core.result.description import describe_regions
from rcseg_core.result.segmentation import Region, Segmentation
from rcseg_core.signal.signals import Signals
from rcseg_core.stages.measures import final_models


def carried(
    found: Segmentation, frame: RangeColorFrame, config: SegmenterConfig, labels: NDArray[np.int32],
    leaves: NDArray[np.int32], range_leaves: NDArray[np.int32] | None, edges: NDArray[np.uint8],
    whiten: Callable[[], Signals],
) -> Segmentation:  # fmt: skip
    """`found` on the pixels of the frame, regions and surfaces numbered by their size there.

    Parameters
    ----------
    found : Segmentation of another image
    labels : (H, W) int32, the regions of `found` as the frame's pixels show them; numbered anew in place
    leaves, range_leaves, edges : (H, W), those of `found` at the same pixels
    whiten : the signals of the frame, called when models, patches or noise are first asked for
    """
    sizes = count_pixels(labels, found.nodes.size - 1)
    # regions that no pixel shows keep the last numbers: the tree knows them
    order = np.concatenate([[0], np.argsort(-sizes[1:], kind="stable") + 1])
    number = np.argsort(order).astype(np.int32)
    count = int(np.count_nonzero(sizes[1:]))
    surface_of = np.zeros(sizes.size, np.int64)
    surface_of[found.labels] = found.surface_labels
    surface_of = surface_of[order]
    pixels = np.bincount(surface_of[1:], sizes[order[1:]], minlength=int(surface_of.max(initial=0)) + 1)
    surface_of = by_size(pixels)[1][surface_of].astype(np.int64)
    relabel(labels, number)
    surface_labels = labels.copy()
    relabel(surface_labels, surface_of.astype(np.int32))

    @cache
    def measured() -> tuple[Signals, Models, Callable[[], Sequence[Region]]]:
        signals, partition = whiten(), Partition(labels, count)
        moments, models = final_models(partition, signals, config)
        boxes, pairs = partition.boxes(), partition.pairs(edges, config.grouping.max_gap)
        return signals, models, partial(
            describe_regions, frame, signals, labels, surface_of, moments, models, boxes, pairs
        )  # fmt: skip

    return replace(
        found,
        labels=labels,
        surface_labels=surface_labels,
        edges=edges,
        camera=frame.camera,
        measure=lambda: measured()[:2],
        leaves=leaves,
        range_leaves=range_leaves,
        nodes=found.nodes[order],
        coarsen=partial(_renumbered, found.coarsen, number),
        describe=lambda: measured()[2](),
    )


def _renumbered(coarsen: Callable[[], Grouped], number: NDArray[np.int32]) -> Grouped:
    """Groupings in the new numbers."""
    grouped = coarsen()
    return grouped._replace(merges=number[grouped.merges].astype(np.int64))
