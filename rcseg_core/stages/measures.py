"""What is measured of the regions of a partition, and what pairs of them are compared by."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rcseg_core.config import SegmenterConfig
from rcseg_core.decision.generalization import choose_degrees, residuals_by_degree
from rcseg_core.decision.rule import KINDS, Rule, error_budget
from rcseg_core.models.moments import Moments, model_terms
from rcseg_core.models.polynomials import Models, fit_models
from rcseg_core.partition.partition import Partition
from rcseg_core.signal.signals import Signals, scales


def make_rule(
    signals: Signals, degree: NDArray[np.int64], config: SegmenterConfig, *, planes: bool = False,
    use_color: bool = True, settled: NDArray[np.int64] | None = None,
) -> Rule:  # fmt: skip
    """The comparison of a pass.

    planes : first-degree models have three terms instead of four
    settled : (N + 1,) range degree that each region has earned so far; by default the degree itself
    """
    return Rule(
        kind=KINDS[config.grouping.criterion],
        n_range=signals.n_range,
        channels=signals.image.shape[2],
        law=signals.law,
        color_eps2=signals.color_eps2,
        systematic2=systematic2(signals, config),
        relief2=config.grouping.relief_tolerance**2,
        correlation=correlation(signals),
        slope=signals.slope,
        beta2=config.grouping.prior_beta**2,
        use_range=signals.n_range > 0,
        use_color=use_color and signals.image.shape[2] > signals.n_range,
        earn=True,
        small=config.absorption.small_region * signals.flags.size / (640 * 480),
        terms=model_terms(planes),
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


def systematic2(signals: Signals, config: SegmenterConfig) -> tuple[float, float]:
    """Squared systematic part of the error of range and of colour, in sigma^2."""
    return signals.noise.range_doubt2, config.grouping.noise_share**2


def tested_degrees(
    moments: Moments, signals: Signals, highest: int, config: SegmenterConfig, seen: bool = False
) -> NDArray[np.int64]:
    """(N + 1, 2) the degrees of range and colour that the tests of section 7 support, up to `highest`.

    seen : the surface as the sensor shows it is wanted, with the systematic error that bends it
    """
    start = np.ones((moments.energy.shape[0], 2), np.int64)
    range2, color2 = systematic2(signals, config)
    if seen:
        range2 = min(range2, config.grouping.noise_share**2)
    return choose_degrees(
        moments, signals.n_range, start, noise_variance(moments, signals), correlation(signals),
        (range2, color2), config.generalization, highest=highest,
    )  # fmt: skip


def curved_regions(moments: Moments, signals: Signals) -> NDArray[np.bool_]:
    """(N + 1,) regions that a first-degree model misses by more than the error and the tolerance."""
    flat = residuals_by_degree(moments, signals.n_range, 1)[:, 0, 0]
    count = np.maximum(moments.count, 1.0)
    var, eps2 = scales(signals.law, moments.cross[:, 0, 0, 0] / count)
    systematic = error_budget(0.0, signals.noise.range_doubt2, 1.0, 3)
    curved: NDArray[np.bool_] = flat / count > (signals.n_range + systematic) * var + eps2
    curved[0] = False
    return curved


def scaled(pixels: int, image: NDArray[np.uint8]) -> int:
    """An area that is given for 640x480, for the size of this image."""
    return max(4, round(pixels * image.size / (640 * 480)))


def top_degree(signals: Signals, config: SegmenterConfig) -> int:
    """Highest degree of any model of these signals."""
    top = config.generalization.max_range_degree if signals.n_range else 1
    if signals.image.shape[2] > signals.n_range:
        top = max(top, config.generalization.max_color_degree)
    return top


def final_degrees(
    partition: Partition, signals: Signals, config: SegmenterConfig, seen: bool = False
) -> tuple[Moments, NDArray[np.int64]]:
    """Moments up to the highest degree and the least degrees that the tests of section 7 support."""
    top = top_degree(signals, config)
    moments = partition.moments(signals, top)
    return moments, tested_degrees(moments, signals, top, config, seen)


def final_models(partition: Partition, signals: Signals, config: SegmenterConfig) -> tuple[Moments, Models]:
    """Moments of the current regions and their models at the degrees that the tests of section 7 support."""
    moments, degree = final_degrees(partition, signals, config)
    return moments, fit_models(moments, degree, signals.n_range)


def seen_models(partition: Partition, signals: Signals, config: SegmenterConfig) -> Models:
    """Models of the regions as the sensor shows them, for the places of pixels: they follow its error too."""
    moments, degree = final_degrees(partition, signals, config, seen=True)
    return fit_models(moments, degree, signals.n_range)
