"""From the last partition to the result: regions by size with models; the rest when asked for."""

from __future__ import annotations

import time
from functools import partial

import numpy as np
from numpy.typing import NDArray

from rcseg_core.config import SegmenterConfig
from rcseg_core.frame import RangeColorFrame
from rcseg_core.graph.adjacency import Pairs
from rcseg_core.graph.grouping import Grouped, group
from rcseg_core.models.moments import Moments
from rcseg_core.partition.partition import Partition, majority
from rcseg_core.result.description import describe_regions
from rcseg_core.result.segmentation import Segmentation
from rcseg_core.signal.signals import Signals
from rcseg_core.stages.measures import final_models, make_rule
from rcseg_core.stages.surfaces import copied, number_surfaces, surfaces_of

#: A limit that any pair with a joint model keeps.
NO_LIMIT = 1e9


class Clock:
    """Seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
        self._last = now


def conclude(
    frame: RangeColorFrame, signals: Signals, edges: NDArray[np.uint8], partition: Partition,
    surfaces: Partition | None, config: SegmenterConfig, clock: Clock,
) -> Segmentation:  # fmt: skip
    """The result: regions by size with their models; patches and coarser levels follow when asked for."""
    partition.sort_by_size()
    moments, models = final_models(partition, signals, config)
    boxes, pairs = partition.boxes(), partition.pairs(edges, config.grouping.max_gap)
    if surfaces is None:
        surface_of = surfaces_of(partition, signals, moments, boxes, pairs, config)
    else:
        surface_of = majority(partition, surfaces)
    surface_labels, surface_of = number_surfaces(partition, surface_of)
    clock.lap("models")
    return Segmentation(
        labels=partition.labels,
        surface_labels=surface_labels,
        tree=partition.tree.build(),
        range_tree=surfaces.tree.build() if surfaces is not None else None,
        edges=edges,
        timings=clock.seconds,
        camera=frame.camera,
        measure=lambda: (signals, models),
        leaves=partition.leaves,
        range_leaves=surfaces.leaves if surfaces is not None else None,
        nodes=partition.nodes,
        coarsen=partial(coarser_merges, signals, moments, boxes, pairs, config),
        describe=partial(
            describe_regions, frame, signals, partition.labels, surface_of, moments, models, boxes, pairs
        ),
        world_config=config.world,
    )


def coarser_merges(
    signals: Signals, moments: Moments, boxes: NDArray[np.int64], pairs: Pairs, config: SegmenterConfig
) -> Grouped:
    """The groupings that would follow if the limit were widened on and on, and the limit that each needs."""
    count = moments.energy.shape[0] - 1
    degree = np.full((count + 1, 2), config.generalization.max_range_degree, np.int64)
    degree[:, 1] = config.generalization.max_color_degree
    rule = make_rule(signals, degree, config)._replace(earn=False)
    return group(copied(moments), boxes.copy(), pairs, rule, gated=False, limit=NO_LIMIT)
