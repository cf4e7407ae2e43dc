"""The passes: group and generalise one degree at a time, absorb, part, settle (steps 3-8)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rcseg_core.config import SegmenterConfig
from rcseg_core.decision.facets import QUADRIC
from rcseg_core.decision.generalization import residuals_by_degree
from rcseg_core.decision.rule import POINTS
from rcseg_core.graph.continuity import continuous_pairs
from rcseg_core.graph.grouping import add_merged, group
from rcseg_core.models.polynomials import Models, fit_models
from rcseg_core.partition.chamfers import dissolve_chamfers
from rcseg_core.partition.parting import split_creases
from rcseg_core.partition.partition import Partition
from rcseg_core.pixels.misfits import mark_taken
from rcseg_core.signal.noise import KNOWN_VARIANCE
from rcseg_core.signal.signals import Signals
from rcseg_core.stages.measures import (
    curved_regions,
    final_degrees,
    final_models,
    make_rule,
    noise_variance,
    scaled,
    seen_models,
    tested_degrees,
    top_degree,
)

#: Least face that a crease may part off, and largest chamfer, px at 640x480.
LEAST_FACE, MOST_CHAMFER = 60, 1000
#: Planes from this size on tell the systematic error, px at 640x480.
LEAST_PLANE = 1000
#: Least face in any image: less than twice as many pixels as coefficients say nothing about its shape.
LEAST_FACE_PX = 2 * QUADRIC


def degrees(config: SegmenterConfig, signals: Signals) -> list[int]:
    """Degrees of the grouping passes; odd ones above 1 add nothing on symmetric patches, so only the paper's
    own way (each region generalises by itself) walks through them, or whoever wants no more than 3."""
    top = top_degree(signals, config)
    ladder = (1, 2, 3, 4) if config.generalization.hypothesis == "region" or top == 3 else (1, 2, 4)
    return [k for k in ladder if k <= top]


def group_pass(
    partition: Partition, signals: Signals, edges: NDArray[np.uint8], degree: int, config: SegmenterConfig
) -> Models:
    """Steps 3-6 at one degree: generalise, then group until the best pair exceeds the limit; the models then.

    With hypothesis "pair" every pair is tried at the degree of the pass, and must earn it where neither side
    has; with "region" (the paper) each region has the degree that its own tests support.
    """
    general = config.generalization
    stored = degree if degree == 1 else top_degree(signals, config)  # later passes go on with the same sums
    moments = partition.moments(signals, stored)
    tested = np.ones((partition.count + 1, 2), np.int64)
    if degree > 1:
        tested = tested_degrees(moments, signals, degree, config)
    pair = general.hypothesis == "pair"
    tried = tested
    if pair:
        tried = np.minimum([[degree, degree]], [[general.max_range_degree, general.max_color_degree]])
        tried = np.repeat(tried, partition.count + 1, axis=0)
    planes = degree == 1 and pair
    rule = make_rule(signals, tried, config, planes=planes, settled=tested[:, 0])
    pairs = partition.pairs(edges, config.grouping.max_gap)
    held = partition.held()
    grouped = group(moments, partition.boxes(), pairs, rule, config.grouping.edge_gate, held=held)
    if planes:
        add_merged(moments, grouped.merges)
    alive = partition.apply(grouped)
    return fit_models(partition.moments(signals, stored), rule.degree[alive], signals.n_range, planes)


def absorb_points(partition: Partition, signals: Signals, models: Models, config: SegmenterConfig) -> int:
    """Step 3: points join the regions that predict them; what hangs together and fits nowhere is a region.

    Returns the number of regions that were added.
    """
    partition.absorb(signals, models, config.absorption.max_cost)
    return partition.add_leftovers(signals.flags, scaled(config.absorption.min_region, signals.flags))


def measured_on_planes(
    partition: Partition, signals: Signals, config: SegmenterConfig, settled: bool = False
) -> Signals:
    """`signals` with the systematic part of the range error as the first-degree regions show it.

    Windows see what bends over their own width; a table shows what bends over the whole image. What the
    larger half of all that first-degree models hold, by pixels, misses them by beyond the noise is the
    sensor's: things that are bent themselves are in the minority, or far beyond.

    settled : regions have been grouped by higher degrees, and some are bent: of those whose misfit the
        highest degree halves, only what it leaves counts
    """
    if config.noise.range_systematic >= 0:
        return signals  # it is stated
    moments = partition.moments(signals, top_degree(signals, config))
    big = np.nonzero(moments.count >= scaled(LEAST_PLANE, signals.flags))[0]
    if not big.size:
        return signals
    top = moments.cross.shape[2] - 1
    rss = residuals_by_degree(moments, signals.n_range, top)[big, 0]
    n = moments.count[big]
    white = n * signals.n_range * noise_variance(moments, signals)[big, 0]
    # a standard deviation that was stated may be wrong: then a quartic tells what is white
    known = white if config.noise.range_model == "auto" else np.maximum(white, rss[:, top - 1])
    misfit2 = np.maximum((rss[:, 0] - known) / white - KNOWN_VARIANCE, 0.0)
    if settled:  # a ball that fills the view is no error of the sensor
        left2 = np.maximum((rss[:, top - 1] - known) / white - KNOWN_VARIANCE, 0.0)
        misfit2 = np.where(2.0 * left2 < misfit2, left2, misfit2)
    order = np.argsort(misfit2, kind="stable")
    typical = misfit2[order][np.searchsorted(np.cumsum(n[order]), 0.5 * n.sum())]
    kappa = max(signals.noise.range_systematic, float(np.sqrt(typical)))
    return replace(signals, noise=replace(signals.noise, range_systematic=kappa))


def regroup_planes(
    partition: Partition, signals: Signals, edges: NDArray[np.uint8], config: SegmenterConfig
) -> Signals:
    """Planes are grouped once more when their pixels are settled; `signals` with the error as they show it.

    What parts of a floor miss their planes by tells of the systematic error that no window could see: the
    first pass, which knew less of it, has left apart what the sensor alone bends apart.
    """
    if signals.n_range and config.generalization.hypothesis == "pair":
        signals = measured_on_planes(partition, signals, config, settled=True)
        group_pass(partition, signals, edges, 1, config)
    return signals


def divide_creases(
    partition: Partition, signals: Signals, edges: NDArray[np.uint8], config: SegmenterConfig
) -> tuple[int, NDArray[np.uint8]]:
    """Bent regions are divided along creases, and chamfers dissolve.

    Returns how many regions were changed (some pixels are without one then), and the edges with the creases.
    """
    changed, creases = split_creases(
        partition, signals, max(scaled(LEAST_FACE, signals.flags), LEAST_FACE_PX)
    )
    if changed:
        edges = edges | creases
    if config.absorption.enabled:
        models = final_models(partition, signals, config)[1]
        pairs = partition.pairs(edges, config.grouping.max_gap)
        changed += dissolve_chamfers(partition, signals, models, pairs, scaled(MOST_CHAMFER, signals.flags))
    return changed, edges


def settle(partition: Partition, signals: Signals, config: SegmenterConfig) -> Models:
    """Specks dissolve into the neighbours that predict them; every measured pixel gets a region.

    Returns the models that the last choices were made by.
    """
    partition.drop_small(scaled(config.absorption.speck, signals.flags))
    models = seen_models(partition, signals, config)
    if absorb_points(partition, signals, models, config):
        models = seen_models(partition, signals, config)
    before = partition.labels.copy()
    # the order still matters, the limit no longer does; costs far below a limit are hardly told apart
    for limit in (1e4, 1e6, 1e8, 1e12):
        partition.absorb(signals, models, limit)
    mark_taken(partition.labels, before, signals.flags)
    if partition.within is None:
        partition.refine(signals, models, config.absorption.refine_passes)
    else:  # small parts of `within` that no region reached
        partition.add_leftovers(signals.flags, 1)
    return models


def absorb_small(
    partition: Partition, signals: Signals, edges: NDArray[np.uint8], config: SegmenterConfig
) -> None:
    """Step 3 for small regions: absorbed whole where a larger one predicts or continues them."""
    moments, degree = final_degrees(partition, signals, config)
    rule = make_rule(signals, degree, config)._replace(kind=POINTS)
    pairs = partition.pairs(edges, config.grouping.max_gap)
    held = partition.held()
    grouped = group(moments, partition.boxes(), pairs, rule, config.grouping.edge_gate, held=held)
    alive = partition.apply(grouped)
    if signals.n_range != signals.image.shape[2]:
        return  # continuity says nothing about colour
    moments = partition.moments(signals, top_degree(signals, config))
    models = fit_models(moments, rule.degree[alive], signals.n_range)
    pairs = partition.pairs(edges, config.grouping.max_gap)
    grouped = continuous_pairs(
        partition.labels,
        signals,
        models,
        pairs,
        curved_regions(moments, signals),
        partition.sizes(),
        rule.small,
    )
    if len(grouped.merges):
        partition.apply(grouped)
        partition.forget()
