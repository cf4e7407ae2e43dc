"""The kernels composed into the passes of the algorithm: measure, generalise, group, one degree at a time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rcseg_core.adjacency import Pairs
from rcseg_core.borders import Sides, sharpen
from rcseg_core.chamfers import dissolve_chamfers
from rcseg_core.config import SegmenterConfig
from rcseg_core.continuity import continuous_pairs
from rcseg_core.creases import split_creases
from rcseg_core.gaps import fill_holes, treat_flying
from rcseg_core.generalization import choose_degrees, residuals_by_degree
from rcseg_core.grouping import Grouped, add_merged, group
from rcseg_core.models import Models, fit_models
from rcseg_core.moments import Moments, plane_exponents, tensor_exponents
from rcseg_core.partition import Partition, majority
from rcseg_core.rule import KINDS, POINTS, Rule
from rcseg_core.signals import MISFIT, Signals, scales

#: A limit that any pair with a joint model keeps.
NO_LIMIT = 1e9
#: Least face that a crease may part off, and largest chamfer, px at 640x480.
LEAST_FACE, MOST_CHAMFER = 60, 1000


def make_rule(
    signals: Signals, degree: NDArray[np.int64], config: SegmenterConfig, *, planes: bool = False,
    use_color: bool = True, settled: NDArray[np.int64] | None = None,
) -> Rule:  # fmt: skip
    """The comparison of a pass.

    planes : first-degree models have three terms instead of four
    settled : (N + 1,) range degree that each region has earned so far; by default the degree itself
    """
    first = plane_exponents() if planes else tensor_exponents(1)
    terms = (tensor_exponents(0), first, tensor_exponents(2), tensor_exponents(3), tensor_exponents(4))
    return Rule(
        kind=KINDS[config.grouping.criterion],
        n_range=signals.n_range,
        channels=signals.image.shape[2],
        law=signals.law,
        color_eps2=signals.color_eps2,
        share2=config.grouping.noise_share**2,
        relief2=config.grouping.relief_tolerance**2,
        correlation=correlation(signals),
        slope=signals.slope,
        beta2=config.grouping.prior_beta**2,
        use_range=signals.n_range > 0,
        use_color=use_color and signals.image.shape[2] > signals.n_range,
        earn=True,
        small=config.absorption.small_region * signals.flags.size / (640 * 480),
        terms=terms,
        degree=degree,
        settled=degree[:, 0].copy() if settled is None else np.minimum(settled, degree[:, 0]),
    )


def noise_variance(moments: Moments, signals: Signals) -> NDArray[np.float64]:
    """(N + 1, 2) variance of one pixel's noise in whitened units at the mean signal of each region."""
    out = np.ones((moments.count.size, 2))
    out[:, 0] = scales(signals.law, moments.cross[:, 0, 0, 0] / np.maximum(moments.count, 1.0))[0]
    return out


def correlation(signals: Signals) -> tuple[float, float]:
    """Pixels that make one independent measurement, of range and of colour."""
    return signals.noise.range_correlation, signals.noise.color_correlation


def tested_degrees(
    moments: Moments, signals: Signals, highest: int, config: SegmenterConfig
) -> NDArray[np.int64]:
    """(N + 1, 2) the degrees of range and colour that the tests of section 7 support, up to `highest`."""
    start = np.ones((moments.energy.shape[0], 2), np.int64)
    return choose_degrees(
        moments, signals.n_range, start, noise_variance(moments, signals), correlation(signals),
        config.generalization, highest=highest,
    )  # fmt: skip


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
    grouped = group(moments, partition.boxes(), pairs, rule, config.grouping.edge_gate)
    if planes:
        add_merged(moments, grouped.merges)
    alive = partition.apply(grouped)
    return fit_models(partition.moments(signals, stored), rule.degree[alive], signals.n_range, planes)


def curved_regions(moments: Moments, signals: Signals) -> NDArray[np.bool_]:
    """(N + 1,) regions that a first-degree model misses by more than the tolerance."""
    flat = residuals_by_degree(moments, signals.n_range, 1)[:, 0, 0]
    count = np.maximum(moments.count, 1.0)
    var, eps2 = scales(signals.law, moments.cross[:, 0, 0, 0] / count)
    curved: NDArray[np.bool_] = flat / count > signals.n_range * var + eps2
    curved[0] = False
    return curved


def absorb_points(partition: Partition, signals: Signals, models: Models, config: SegmenterConfig) -> int:
    """Step 3: points join the regions that predict them; what hangs together and fits nowhere is a region.

    Returns the number of regions that were added.
    """
    partition.absorb(signals, models, config.absorption.max_cost)
    return partition.add_leftovers(signals.flags, scaled(config.absorption.min_region, signals.flags))


def divide_creases(
    partition: Partition, signals: Signals, edges: NDArray[np.uint8], config: SegmenterConfig
) -> int:
    """Bent regions are divided along creases, and chamfers dissolve; the creases are added to `edges`.

    Returns how many regions were changed; some pixels are without one then.
    """
    changed = split_creases(partition, signals, edges, scaled(LEAST_FACE, signals.flags))
    if config.absorption.enabled:
        models = final_models(partition, signals, config)[1]
        pairs = partition.pairs(edges, config.grouping.max_gap)
        changed += dissolve_chamfers(partition, signals, models, pairs, scaled(MOST_CHAMFER, signals.flags))
    return changed


def settle(partition: Partition, signals: Signals, config: SegmenterConfig) -> Models:
    """Specks dissolve into the neighbours that predict them; every measured pixel gets a region.

    Returns the models that the last choices were made by.
    """
    partition.drop_small(scaled(config.absorption.speck, signals.flags))
    models = final_models(partition, signals, config)[1]
    if absorb_points(partition, signals, models, config):
        models = final_models(partition, signals, config)[1]
    unassigned = partition.labels == 0
    for limit in (1e4, 1e12):  # the order still matters; the limit no longer does
        partition.absorb(signals, models, limit)
    signals.flags[unassigned & (partition.labels > 0)] |= MISFIT
    if partition.within is None:
        partition.refine(signals, models, config.absorption.refine_passes)
    else:  # small parts of `within` that no region reached
        partition.add_leftovers(signals.flags, 1)
    return models


def scaled(pixels: int, image: NDArray[np.uint8]) -> int:
    """An area that is given for 640x480, for the size of this image."""
    return max(4, round(pixels * image.size / (640 * 480)))


def absorb_small(
    partition: Partition, signals: Signals, edges: NDArray[np.uint8], config: SegmenterConfig
) -> None:
    """Step 3 for small regions: absorbed whole where a larger one predicts or continues them."""
    moments, degree = final_degrees(partition, signals, config)
    rule = make_rule(signals, degree, config)._replace(kind=POINTS)
    pairs = partition.pairs(edges, config.grouping.max_gap)
    alive = partition.apply(group(moments, partition.boxes(), pairs, rule, config.grouping.edge_gate))
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


def link_signals(
    partition: Partition, surfaces: Partition, signals: Signals, edges: NDArray[np.uint8],
    config: SegmenterConfig,
) -> None:  # fmt: skip
    """Regions of colour meet the range again: both decide what small regions and border pixels belong to."""
    partition.within = None
    partition.forget()
    models = settle(partition, signals, config)
    sharpen_borders(partition, surfaces, models, signals, edges, config)
    settle_flying(partition, models, signals, config)
    absorb_small(partition, signals, edges, config)


def sharpen_borders(
    partition: Partition, surfaces: Partition, regions: Models, signals: Signals, edges: NDArray[np.uint8],
    config: SegmenterConfig,
) -> None:  # fmt: skip
    """Move the borders between surfaces to where their models intersect.

    surfaces : found from the range alone, or `partition` itself, whose models are `regions`
    """
    if not config.borders.sharpen:
        return
    models = regions
    if surfaces is not partition:
        models = final_models(surfaces, signals.range_only(), config)[1]
    # what pixels do not average away, and the mean variance of a fit (its terms over independent pixels)
    terms = (models.degree[:, 0] + 1.0) ** 2
    independent = np.maximum(surfaces.sizes() / correlation(signals)[0], 1.0)
    doubt = config.grouping.noise_share**2 + terms / independent
    sides = Sides(majority(partition, surfaces), models, doubt)
    if sharpen(signals, edges, partition.labels, partition.leaves, sides, regions, config.borders.reach):
        partition.pixels_changed()


def settle_flying(partition: Partition, regions: Models, signals: Signals, config: SegmenterConfig) -> None:
    """Decide on pixels in mid-air between two surfaces; `regions` are models of `partition`."""
    mode = config.borders.flying
    if mode != "nearest" and treat_flying(signals, partition.labels, partition.leaves, regions, mode):
        partition.pixels_changed()


def fill_small_holes(partition: Partition, surfaces: Partition | None, config: SegmenterConfig) -> None:
    """Label holes that one surface surrounds; without `surfaces`, one region."""
    if config.borders.fill_holes_px == 0:
        return
    surface_of = np.arange(partition.count + 1) if surfaces is None else majority(partition, surfaces)
    if fill_holes(partition.labels, partition.leaves, surface_of, config.borders.fill_holes_px):
        partition.pixels_changed()


def top_degree(signals: Signals, config: SegmenterConfig) -> int:
    """Highest degree of any model of these signals."""
    top = config.generalization.max_range_degree if signals.n_range else 1
    if signals.image.shape[2] > signals.n_range:
        top = max(top, config.generalization.max_color_degree)
    return top


def final_degrees(
    partition: Partition, signals: Signals, config: SegmenterConfig
) -> tuple[Moments, NDArray[np.int64]]:
    """Moments up to the highest degree and the least degrees that the tests of section 7 support."""
    top = top_degree(signals, config)
    moments = partition.moments(signals, top)
    return moments, tested_degrees(moments, signals, top, config)


def final_models(partition: Partition, signals: Signals, config: SegmenterConfig) -> tuple[Moments, Models]:
    """Moments of the current regions and their models at the degrees that the tests of section 7 support."""
    moments, degree = final_degrees(partition, signals, config)
    return moments, fit_models(moments, degree, signals.n_range)


def copied(moments: Moments) -> Moments:
    """Moments that grouping may change."""
    return Moments(*(a.copy() for a in moments))


def coarser_merges(
    signals: Signals, moments: Moments, boxes: NDArray[np.int64], pairs: Pairs, config: SegmenterConfig
) -> Grouped:
    """The groupings that would follow if the limit were widened on and on, and the limit that each needs."""
    count = moments.energy.shape[0] - 1
    degree = np.full((count + 1, 2), config.generalization.max_range_degree, np.int64)
    degree[:, 1] = config.generalization.max_color_degree
    rule = make_rule(signals, degree, config)._replace(earn=False)
    return group(copied(moments), boxes.copy(), pairs, rule, gated=False, limit=NO_LIMIT)
