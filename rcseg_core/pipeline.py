"""segment(): the paper's algorithm box (section 2), step by step, and nothing else."""

from __future__ import annotations

import time
from functools import partial

import numpy as np
from numpy.typing import NDArray

from rcseg_core.absorption import absorb, refine
from rcseg_core.config import SegmenterConfig
from rcseg_core.description import describe_regions
from rcseg_core.edges import detect_edges
from rcseg_core.errors import ConfigError
from rcseg_core.frame import RangeColorFrame
from rcseg_core.models import Models, fit_models
from rcseg_core.moments import Moments
from rcseg_core.partition import Partition
from rcseg_core.reflectance import normalize_reflectance
from rcseg_core.seeds import initial_partition
from rcseg_core.segmentation import Segmentation
from rcseg_core.signals import INVALID, Signals, build_signals
from rcseg_core.stages import coarser_groups, final_degrees, group_pass, measure, surfaces_of


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
    config = config or SegmenterConfig()
    if not isinstance(config, SegmenterConfig):
        raise ConfigError(f"config: expected a SegmenterConfig, got {type(config).__name__}")
    clock = Clock()

    # 1. normalise the colour (section 3)
    color = normalize_reflectance(frame, config.reflectance, white_reference)
    signals = build_signals(frame, color, config)
    clock.lap("signals")

    # 2. initial partition, bounded by depth, orientation and colour edges (section 5)
    edges = detect_edges(signals, config.edges)
    clock.lap("edges")
    partition = Partition(*initial_partition(signals, edges, config.seeds))
    clock.lap("seeds")

    # 3-8. group the best pair first, generalise, until nothing changes (sections 6 and 7)
    for degree in degrees(config):
        models = group_pass(partition, signals, edges, degree, config)
        clock.lap(f"group {degree}")
        if config.absorption.enabled:
            absorb_points(partition, signals, models, config)
        clock.lap("absorb")

    moments, models, boxes, pairs = finish(partition, signals, edges, config)
    clock.lap("finish")
    surface_of = surfaces_of(partition, signals, moments, boxes, pairs, config)
    clock.lap("surfaces")
    regions = describe_regions(
        frame, signals, partition.labels, surface_of, moments, models, boxes, pairs
    )
    clock.lap("describe")
    return Segmentation(
        labels=partition.labels,
        surface_labels=surface_of.astype(np.int32)[partition.labels],
        regions=regions,
        hierarchy=partition.tree.build(),
        edges=edges,
        timings=clock.seconds,
        camera=frame.camera,
        signals=signals,
        models=models,
        leaves=partition.leaves,
        nodes=partition.nodes,
        coarsen=partial(coarser_groups, signals, moments, boxes, pairs, config),
    )


def degrees(config: SegmenterConfig) -> list[int]:
    """Degrees of the grouping passes; odd ones above 1 add nothing on symmetric patches, so only the paper's
    own way (each region generalises by itself) walks through them."""
    top = max(config.generalization.max_range_degree, config.generalization.max_color_degree)
    ladder = (1, 2, 3, 4) if config.generalization.hypothesis == "region" else (1, 2, 4)
    return [k for k in ladder if k <= top]


def absorb_points(partition: Partition, signals: Signals, models: Models, config: SegmenterConfig) -> None:
    """Step 3: points join the regions that predict them; what hangs together and fits nowhere is a region."""
    absorb(signals, partition.labels, partition.leaves, models, config.absorption.max_cost)
    measured = signals.flags & INVALID == 0
    partition.add_leftovers(measured, scaled(config.absorption.min_region, signals.flags))


def finish(
    partition: Partition, signals: Signals, edges: NDArray[np.uint8], config: SegmenterConfig
) -> tuple[Moments, Models, NDArray[np.int64], object]:
    """Degrees by the nested tests, boundary pixels to the better side, specks to a neighbour; the final models."""
    if config.absorption.enabled:
        partition.drop_small(scaled(config.absorption.speck, signals.flags))
        models = final_models(partition, signals, config)[1]
        absorb_points(partition, signals, models, config)
        models = final_models(partition, signals, config)[1]
        for limit in (1e4, 1e12):  # the order still matters; the limit no longer does
            absorb(signals, partition.labels, partition.leaves, models, limit)
        refine(signals, partition.labels, partition.leaves, models, config.absorption.refine_passes)
    partition.sort_by_size()
    moments, models = final_models(partition, signals, config)
    boxes, pairs = measure(partition, edges, config)
    return moments, models, boxes, pairs


def final_models(
    partition: Partition, signals: Signals, config: SegmenterConfig
) -> tuple[Moments, Models]:
    """Moments of the current regions and their models at the degrees that the tests of section 7 support."""
    moments, degree = final_degrees(partition, signals, config)
    return moments, fit_models(moments, degree, signals.n_range)


def scaled(pixels: int, image: NDArray[np.uint8]) -> int:
    """An area that is given for 640x480, for the size of this image."""
    return max(4, round(pixels * image.size / (640 * 480)))


class Clock:
    """Seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
        self._last = now
