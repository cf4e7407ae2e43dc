"""segment(): the paper's algorithm box (section 2), step by step, and nothing else."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from rcseg_core.config import SegmenterConfig
from rcseg_core.description import describe_regions
from rcseg_core.edges import RANGE_EDGES, detect_edges
from rcseg_core.errors import ConfigError
from rcseg_core.frame import RangeColorFrame
from rcseg_core.partition import Partition, majority
from rcseg_core.reduction import LEAST_SIDE_PX, at_full_size, reduced, unreduced
from rcseg_core.reflectance import normalize_reflectance, weigh_intensity
from rcseg_core.seeds import initial_partition
from rcseg_core.segmentation import Segmentation
from rcseg_core.signals import MISFIT, Signals, build_signals
from rcseg_core.stages import (
    absorb_points,
    absorb_small,
    coarser_merges,
    divide_creases,
    fill_small_holes,
    final_models,
    group_pass,
    link_signals,
    settle,
    settle_flying,
    sharpen_borders,
    top_degree,
)
from rcseg_core.surfaces import bridge_holes, number_surfaces, surfaces_of
from rcseg_core.views import carried_back, pinhole_view

#: Made once: every parameter is checked when a configuration is made.
DEFAULT = SegmenterConfig()
#: Rounds of regrouping after the points are settled; two are seldom needed.
MAX_ROUNDS = 3


def segment(
    frame: RangeColorFrame,
    config: SegmenterConfig | None = None,
    *,
    white_reference: RangeColorFrame | None = None,
) -> Segmentation:
    """Segment a registered range and colour image into regions of one surface and one colour model.

    Parameters
    ----------
    frame : RangeColorFrame
    config : SegmenterConfig, the defaults if None
    white_reference : RangeColorFrame, only for ``reflectance.mode = calibrated`` (eq. 6)

    Returns
    -------
    Segmentation
        The same input and configuration give the same labels, bit for bit.

    Raises
    ------
    ConfigError, InputError
    """
    config = config or DEFAULT
    if not isinstance(config, SegmenterConfig):
        raise ConfigError(f"config: expected a SegmenterConfig, got {type(config).__name__}")
    clock = Clock()

    # 1. normalise the colour (section 3) and find the discontinuities (section 8)
    color = normalize_reflectance(frame, config.reflectance, white_reference)
    view = pinhole_view(frame, color, config)
    if view is not None:  # a scanner's grid is segmented as a pinhole camera in its centre would see it
        result = segment(view.frame, config.replace({"reflectance.mode": "none"}))
        return carried_back(view, result, frame, color, config)
    if config.signal.reduction > 1 and min(frame.valid.shape) >= LEAST_SIDE_PX:  # coarse to fine
        squares = reduced(frame, color, config.signal.reduction)
        clock.lap("squares")
        result = at_full_size(frame, color, segment(squares, unreduced(config)), config)
        return replace(result, timings=clock.seconds | result.timings)
    evidence = weigh_intensity(color, config.grouping.intensity_weight)
    signals = build_signals(frame, evidence, config)
    clock.lap("signals")
    edges = detect_edges(signals, config.edges)
    clock.lap("edges")

    # 2-8. on both signals jointly; or on the range alone, which gives the surfaces ...
    surfaces: Partition | None = None
    if config.grouping.order == "joint":
        partition = partition_by(signals, edges, config, None, clock, "joint")
    else:
        surfaces = partition_by(signals.range_only(), edges & RANGE_EDGES, config, None, clock, "range")
        partition = surfaces

    # ... then on the colour of each surface; and both decide what small regions and border pixels belong to
    if surfaces is not None and config.grouping.order == "surfaces_first":
        within = bridge_holes(surfaces.labels)
        partition = partition_by(signals.color_only(), edges, config, within, clock, "color")
        if config.absorption.enabled:
            link_signals(partition, surfaces, signals, edges, config)
    elif config.absorption.enabled:
        seen = signals if surfaces is None else signals.range_only()
        settle_flying(partition, final_models(partition, seen, config)[1], seen, config)
    fill_small_holes(partition, surfaces, config)
    if evidence is not color:  # the models are of the colour as it was measured
        misfits = signals.flags & MISFIT
        signals = build_signals(frame, color, config)
        np.bitwise_or(signals.flags, misfits, out=signals.flags)
        partition.forget()
    return conclude(frame, signals, edges, partition, surfaces, config, clock)


def degrees(config: SegmenterConfig, signals: Signals) -> list[int]:
    """Degrees of the grouping passes; odd ones above 1 add nothing on symmetric patches, so only the paper's
    own way (each region generalises by itself) walks through them."""
    top = top_degree(signals, config)
    ladder = (1, 2, 3, 4) if config.generalization.hypothesis == "region" else (1, 2, 4)
    return [k for k in ladder if k <= top]


def partition_by(
    signals: Signals, edges: NDArray[np.uint8], config: SegmenterConfig, within: NDArray[np.int32] | None,
    clock: Clock, name: str,
) -> Partition:  # fmt: skip
    """Steps 2-8 on the channels of `signals`.

    Parameters
    ----------
    within : (H, W) int32 or None; regions never cross from one value of it to another
    name : prefix of the stages in `clock`
    """
    # 2. initial partition, bounded by the edges (section 5)
    partition = Partition(*initial_partition(signals, edges, config.seeds, within), within)
    clock.lap(f"{name} seeds")

    # 3-4. group planes, the best pair first; then points join the planes that predict them
    first, *higher = degrees(config, signals)
    models = group_pass(partition, signals, edges, first, config)
    clock.lap(f"{name} group {first}")
    if config.absorption.enabled:
        absorb_points(partition, signals, models, config)
        clock.lap(f"{name} absorb")

    # 5-8. generalise and group on, until no region changes
    divided = int(config.generalization.creases and name == "range")
    for round_ in range(MAX_ROUNDS):
        before = partition.count
        for degree in higher:
            group_pass(partition, signals, edges, degree, config)
        clock.lap(f"{name} generalize")
        if divided:  # a region may hold two creases
            divided = divide_creases(partition, signals, edges, config)
            clock.lap(f"{name} creases")
        if not config.absorption.enabled:
            break
        if round_ == 0 or divided:
            models = settle(partition, signals, config)
            if within is None:
                sharpen_borders(partition, partition, models, signals, edges, config)
        if within is None:  # within surfaces, both signals judge small regions later
            absorb_small(partition, signals, edges, config)
        clock.lap(f"{name} absorb")
        if within is not None or partition.count == before:
            break
    return partition


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
    )


class Clock:
    """Seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
        self._last = now
