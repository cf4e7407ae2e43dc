"""segment(): the paper's algorithm box (section 2), step by step, and nothing else."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.config import SegmenterConfig
from rcseg_core.errors import ConfigError, InputError
from rcseg_core.frame import RangeColorFrame
from rcseg_core.partition.partition import Partition
from rcseg_core.partition.previous import Previous
from rcseg_core.partition.seeds import initial_partition
from rcseg_core.pixels.misfits import mark_misfits
from rcseg_core.resampling.elsewhere import found_elsewhere
from rcseg_core.result.segmentation import Segmentation
from rcseg_core.signal.edges import RANGE_EDGES, detect_edges
from rcseg_core.signal.noise import NoiseModel
from rcseg_core.signal.reflectance import normalize_reflectance, weigh_intensity
from rcseg_core.signal.signals import Signals, build_signals
from rcseg_core.stages.conclusion import Clock, conclude
from rcseg_core.stages.linking import (
    as_measured,
    fill_small_holes,
    link_signals,
    settle_flying,
    sharpen_borders,
)
from rcseg_core.stages.measures import final_models
from rcseg_core.stages.passes import (
    absorb_points,
    absorb_small,
    degrees,
    divide_creases,
    group_pass,
    measured_on_planes,
    regroup_planes,
    settle,
)
from rcseg_core.stages.surfaces import bridge_holes

#: Made once: every parameter is checked when a configuration is made.
DEFAULT = SegmenterConfig()
#: Rounds of regrouping after the points are settled; two are seldom needed.
MAX_ROUNDS = 3


def segment(
    frame: RangeColorFrame,
    config: SegmenterConfig | None = None,
    *,
    white_reference: RangeColorFrame | None = None,
    previous: Previous | None = None,
) -> Segmentation:
    """Segment a registered range and colour image into regions of one surface and one colour model.

    Parameters
    ----------
    frame : RangeColorFrame
    config : SegmenterConfig, the defaults if None
    white_reference : RangeColorFrame, only for ``reflectance.mode = calibrated`` (eq. 6)
    previous : Previous, what the last frame decided as this one shows it, for ``tracking.stability`` above 0;
        None: the frame stands alone. `rcseg_core.tracking.Segmenter` tells it

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
    if previous is not None:
        previous.check(frame.valid.shape)
    clock = Clock()

    # 1. normalise the colour (section 3) and find the discontinuities (section 8)
    color = normalize_reflectance(frame, config.reflectance, white_reference)
    result = found_elsewhere(frame, color, config, clock, segment, previous)
    if result is not None:  # on another image of the scene, where that does better
        return result
    evidence = weigh_intensity(color, config.grouping.intensity_weight)
    try:
        signals = build_signals(frame, evidence, config)
    except ZeroDivisionError:
        raise InputError(
            "the frame has no extent: its points lie in one place, or at z = 0 where a sensor model is "
            "given, so that their noise has no scale"
        ) from None
    clock.lap("signals")
    edges = detect_edges(signals, config.edges)
    clock.lap("edges")

    # 2-8. on both signals jointly; or on the range alone, which gives the surfaces ...
    surfaces: Partition | None = None
    decided = previous or Previous(None, None)
    if config.grouping.order == "joint":
        partition, edges, noise = partition_by(signals, edges, config, None, clock, "joint", decided.labels)
    else:
        ranges = signals.range_only()
        surfaces, creased, noise = partition_by(
            ranges, edges & RANGE_EDGES, config, None, clock, "range", decided.surface_labels
        )
        edges = edges | creased  # with the creases that were found between surfaces
        partition = surfaces
        # what fitted nowhere counts for no later fit either
        mark_misfits(surfaces.labels, surfaces.count, ranges.flags, signals.flags)
    signals = replace(signals, noise=noise)

    # ... then on the colour of each surface; and both decide what small regions and border pixels belong to
    if surfaces is not None and config.grouping.order == "surfaces_first":
        within = bridge_holes(surfaces.labels)
        colors = signals.color_only()
        partition, _, _ = partition_by(colors, edges, config, within, clock, "color", decided.labels)
        mark_misfits(partition.labels, partition.count, colors.flags, signals.flags)
        if config.absorption.enabled:
            link_signals(partition, surfaces, signals, edges, config)
    elif config.absorption.enabled:
        seen = signals if surfaces is None else signals.range_only()
        settle_flying(partition, final_models(partition, seen, config)[1], seen, config)
    fill_small_holes(partition, surfaces, config)
    clock.lap("link")

    # 9. the models are of the colour as it was measured; patches and coarser levels follow when asked for
    if evidence is not color:
        signals = as_measured(frame, color, signals, partition, config)
        clock.lap("signals")
    return conclude(frame, signals, edges, partition, surfaces, config, clock)


class Found(NamedTuple):
    """The regions, the edges with the creases between them, the noise as their residuals tell it."""

    partition: Partition
    edges: NDArray[np.uint8]
    noise: NoiseModel


def partition_by(
    signals: Signals, edges: NDArray[np.uint8], config: SegmenterConfig, within: NDArray[np.int32] | None,
    clock: Clock, name: str, decided: NDArray[np.int32] | None = None,
) -> Found:  # fmt: skip
    """Steps 2-8 on the channels of `signals`.

    Parameters
    ----------
    within : (H, W) int32 or None; regions never cross from one value of it to another
    name : prefix of the stages in `clock`
    decided : (H, W) int32 or None; regions of the last frame as this one shows them
    """
    # 2. initial partition, bounded by the edges (section 5)
    favour = 1.0 + config.tracking.stability
    partition = Partition(*initial_partition(signals, edges, config.seeds, within), within, decided, favour)
    clock.lap(f"{name} seeds")

    # 3-4. group planes, the best pair first; then points join the planes that predict them
    first, *higher = degrees(config, signals)
    models = group_pass(partition, signals, edges, first, config)
    clock.lap(f"{name} group {first}")
    if config.absorption.enabled:
        absorb_points(partition, signals, models, config)
        clock.lap(f"{name} absorb")
    if signals.n_range:
        signals = measured_on_planes(partition, signals, config)

    # 5-8. generalise and group on, until no region changes
    divided = int(config.generalization.creases and name == "range")
    for round_ in range(MAX_ROUNDS):
        before = partition.count
        for degree in higher:
            group_pass(partition, signals, edges, degree, config)
        clock.lap(f"{name} generalize")
        if divided:  # a region may hold two creases
            divided, edges = divide_creases(partition, signals, edges, config)
            clock.lap(f"{name} creases")
        if not config.absorption.enabled:
            break
        if round_ == 0 or divided:
            models = settle(partition, signals, config)
            if within is None:
                sharpen_borders(partition, partition, models, signals, edges, config)
        if within is None:  # within surfaces, both signals judge small regions later
            signals = regroup_planes(partition, signals, edges, config)
            absorb_small(partition, signals, edges, config)
        clock.lap(f"{name} absorb")
        if within is not None or partition.count == before:
            break
    return Found(partition, edges, signals.noise)
