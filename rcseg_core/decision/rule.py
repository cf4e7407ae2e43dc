"""What the comparison of two regions goes by: the criterion, the limits and the models of a pass (section 6).

All lengths are in sigmas of the whitened signals, so one rule holds for every pair of a frame; what depends
on depth is a law of the signal (`signals.local_scales`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.inline import inlined
from rcseg_core.compute.jit import bare

#: How two regions are compared; see `evidence`.
BOUNDED, CHOW, BAYES, POINTS = 0, 1, 2, 3
KINDS = {"bounded": BOUNDED, "chow": CHOW, "bayes": BAYES}


class Rule(NamedTuple):
    """What a comparison goes by, the same for all pairs of a pass.

    kind : BOUNDED, CHOW, BAYES or POINTS
    n_range, channels : number of range channels and of all
    law, color_eps2 : see `signals.Signals`
    systematic2 : squared systematic part of the error of range and of colour, in sigma^2
    relief2 : squared relief tolerance
    correlation : pixels an independent measurement, of range and of colour
    slope : gradient (whitened, per UNIT_PX) of a surface tilted by 45 degrees, as a + b s of the signal
    beta2 : beta^2 of eq. (20)
    use_range, use_color : whether a modality counts
    earn : whether a side must earn the tolerance and a new degree (not at levels that users ask for)
    small : pixels below which a region may be absorbed like a point, for POINTS
    terms : exponents of the models by degree, (p, 2) int64 each; terms[1] is a plane or the bilinear form
    degree : (N + 1, 2) int64, degree of range and colour of each region; a pair takes the higher (step 6)
    settled : (N + 1,) int64, range degree that each region had earned before; at or below its degree
    """

    kind: int
    n_range: int
    channels: int
    law: NDArray[np.float64]
    color_eps2: float
    systematic2: tuple[float, float]
    relief2: float
    correlation: tuple[float, float]
    slope: tuple[float, float]
    beta2: float
    use_range: bool
    use_color: bool
    earn: bool
    small: float
    terms: tuple[NDArray[np.int64], ...]
    degree: NDArray[np.int64]
    settled: NDArray[np.int64]


def error_budget(correlation, systematic2, n, q):  # type: ignore[no-untyped-def]
    """The criterion: what q coefficients gain on n pixels of error alone, mean and four deviations.

    The part of the error that is correlated over m pixels gives m sigma^2 to each coefficient. The systematic
    part, kappa^2 sigma^2 a pixel, no number of pixels averages away; it is smooth, so that q coefficients
    which follow a surface follow all of it: n kappa^2 / q each. The gain is chi-squared with q degrees of
    freedom times their sum.
    """
    return (correlation + systematic2 * n / q) * (q + 4.0 * np.sqrt(2.0 * q))


_budget = bare(error_budget)


@inlined
def explained(rule, modality, n, q):  # type: ignore[no-untyped-def]
    """Squared misfit of n pixels that the error alone explains where q more coefficients would remove it.

    In variances of one pixel; see `error_budget`.
    """
    return _budget(rule.correlation[modality], rule.systematic2[modality], n, q)


@inlined
def channel_span(rule, modality):  # type: ignore[no-untyped-def]
    """First channel and one past the last of a modality: 0 range, 1 colour."""
    if modality == 0:
        return 0, rule.n_range
    return rule.n_range, rule.channels
