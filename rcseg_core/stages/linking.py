"""The two partitions meet: both signals decide what border pixels, misfits and holes belong to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rcseg_core.config import SegmenterConfig
from rcseg_core.frame import RangeColorFrame
from rcseg_core.models.polynomials import Models
from rcseg_core.partition.partition import Partition, majority
from rcseg_core.pixels.borders import Sides, sharpen
from rcseg_core.pixels.gaps import fill_holes, treat_flying
from rcseg_core.signal.signals import MISFIT, Signals, build_signals
from rcseg_core.stages.measures import correlation, seen_models
from rcseg_core.stages.passes import absorb_small, settle


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
        models = seen_models(surfaces, signals.range_only(), config)
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


def as_measured(
    frame: RangeColorFrame, color: NDArray[np.uint8], signals: Signals, partition: Partition,
    config: SegmenterConfig,
) -> Signals:  # fmt: skip
    """The signals with another colour than the evidence was of; noise of the range and misfits stay."""
    misfits = signals.flags & MISFIT
    signals = replace(build_signals(frame, color, config), noise=signals.noise)
    np.bitwise_or(signals.flags, misfits, out=signals.flags)
    partition.forget()
    return signals
