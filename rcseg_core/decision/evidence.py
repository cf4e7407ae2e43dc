"""How well two regions go together (section 6), from their moments alone.

bounded (default): one joint model must explain BOTH sides: for each side s and each modality
    RSS_s(joint) - RSS_s(own)  <  m (p + 4 sqrt(2 p))  +  n_s (share^2 + eps^2)     (everything in sigma^2)
The first term is what noise alone costs when m pixels make one independent measurement, the second what the
approximation limit eps_t allows; the value is the largest ratio of left to right, so 1 is the limit and the
measure is symmetric.
A joint model of higher degree must also be the shorter account (Schwarz 1978, m pixels counting for one): its
residual and m log(N/m) for each coefficient against those of the simplest models of both sides; else two
faces become one that bends. chow: the same for the total rise of both sides at once.
bayes: c_ib of eq. (21), the larger region predicts the smaller (the other way extrapolation explodes).
points: small regions are absorbed whole (step 3) where the larger one predicts them within the tolerance.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.compute.inline import inlined
from rcseg_core.compute.jit import bare
from rcseg_core.decision.rule import BAYES, CHOW, POINTS, channel_span, explained
from rcseg_core.models.moments import Moments, mean_square_gradient, residual, shift_grid, solve
from rcseg_core.models.planes import joint_shape, joint_signal, rise
from rcseg_core.signal.signals import local_scales
from rcseg_core.signal.units import UNIT_PX

#: Steeper than this (tan^2) a surface is hardly measured: the tolerance along the ray grows no further.
MAX_TAN2 = 8.0


class Work(NamedTuple):
    """Scratch arrays of one thread for `compare`."""

    shift: NDArray[np.float64]
    power: NDArray[np.float64]
    cross: NDArray[np.float64]
    sum_power: NDArray[np.float64]
    sum_cross: NDArray[np.float64]
    sum_energy: NDArray[np.float64]
    gram: NDArray[np.float64]
    coef: NDArray[np.float64]


def make_work(moments: Moments) -> Work:
    """Scratch arrays that fit `moments`."""
    channels, size, low = moments.energy.shape[1], moments.power.shape[1], moments.cross.shape[2]
    p = low * low
    return Work(
        np.empty((size, size)),
        np.empty((size, size)),
        np.empty((channels, low, low)),
        np.empty((size, size)),
        np.empty((channels, low, low)),
        np.empty(channels),
        np.empty((p + 1, max(p, 3))),
        np.empty((channels, max(p, 3))),
    )


@bare
def move(moments, k, center_x, center_y, work, power, cross):  # type: ignore[no-untyped-def]
    """Sums of region k about another centre (px), into power and cross."""
    dx = (moments.center[k, 0] - center_x) / UNIT_PX
    dy = (moments.center[k, 1] - center_y) / UNIT_PX
    shift_grid(moments.power[k], dx, dy, power, work.shift)
    low = cross.shape[1]
    part = work.shift[:low, :low]
    for c in range(cross.shape[0]):
        shift_grid(moments.cross[k, c], dx, dy, cross[c], part)


@bare
def own_residuals(moments, k, rule, work, out):  # type: ignore[no-untyped-def]
    """Residual sums of squares of region k about its own models: out[0] range, out[1] colour.

    out[2]: range about a first-degree model where the own degree is higher, else inf; out[3]: mean of 1/cos^2
    of the slope of the surface, by which a distance along the ray exceeds the distance to the surface,
    squared; out[4]: range about the model of the settled degree.
    """
    for modality in range(2):
        first, last = channel_span(rule, modality)
        terms = rule.terms[rule.degree[k, modality]]
        solve(moments.power[k], moments.cross[k], first, last, terms, work.gram, work.coef)
        out[modality] = residual(
            moments.power[k], moments.cross[k], moments.energy[k], first, last, terms, work.coef
        )
        if modality == 0 and rule.use_range and rule.degree[k, 0] > 1:
            steepness = mean_square_gradient(moments.power[k], terms, work.coef[last - 1])
            mean = moments.cross[k, 0, 0, 0] / max(moments.power[k, 0, 0], 1.0)
            flat = rule.slope[0] + rule.slope[1] * mean
            out[3] = 1.0 + min(steepness / (flat * flat), MAX_TAN2)
    out[2] = np.inf
    if rule.use_range and rule.degree[k, 0] > 1:
        solve(moments.power[k], moments.cross[k], 0, rule.n_range, rule.terms[1], work.gram, work.coef)
        out[2] = residual(
            moments.power[k], moments.cross[k], moments.energy[k], 0, rule.n_range, rule.terms[1], work.coef
        )
        out[4] = out[0]
        if rule.settled[k] < rule.degree[k, 0]:
            terms = rule.terms[rule.settled[k]]
            solve(moments.power[k], moments.cross[k], 0, rule.n_range, terms, work.gram, work.coef)
            out[4] = residual(
                moments.power[k], moments.cross[k], moments.energy[k], 0, rule.n_range, terms, work.coef
            )


@bare
def earned_tolerance(eps2, relief2, n, own, var):  # type: ignore[no-untyped-def]
    """The tolerance that a side may claim in a higher-degree model, from what its first-degree model misses.

    The tolerance is there for shapes that no polynomial follows. A side that is flat to within the noise
    needs none: two such sides that only a bent model with tolerance could join are the two faces of a crease.
    A side with much relief may miss a share of it: a quartic follows a hemisphere to 2 % of its radius,
    however large. The tolerance is a distance to the surface; own[3] makes it one along the ray.
    """
    if own[2] == np.inf:
        return eps2
    relief = max(own[2] / n - var, 0.0)
    eps2 *= own[3]
    return min(max(eps2, relief2 * relief), relief)


@inlined
def _excess(rise, allowance, budget):  # type: ignore[no-untyped-def]
    """(ratio of rise to all that is allowed, share of the tolerance that is needed)."""
    ratio = rise / (allowance + budget)
    need = rise - allowance
    if need <= 0.0:
        return ratio, 0.0
    if budget <= 0.0:
        return ratio, np.inf
    return ratio, np.sqrt(need / budget)


@inlined
def _favoured(value, height, limited, favour):  # type: ignore[no-untyped-def]
    """What `compare` returns, where `limited`, which may be 1 at most, counts for less by `favour`."""
    if limited <= favour:  # what is allowed by favour alone needs no wider limit than the others
        return value / favour, height if favour == 1.0 else min(height, 1.0), True
    return value / favour, height, False


@inlined
def _weigh(rule, modality, n_a, n_b, q, var, rise_a, rise_b, budget_a, budget_b):  # type: ignore[no-untyped-def]
    """`_excess` of both sides: of their total for CHOW, else the larger of the two, and what it needs."""
    if rule.kind == CHOW:
        error = var * explained(rule, modality, n_a + n_b, q)
        return _excess(rise_a + rise_b, error, budget_a + budget_b)
    ratio_a, need_a = _excess(rise_a, var * explained(rule, modality, n_a, q), budget_a)
    ratio_b, need_b = _excess(rise_b, var * explained(rule, modality, n_b, q), budget_b)
    return max(ratio_a, ratio_b), max(need_a, need_b)


@inlined
def compare_planes(planes, i, j, rule, gate_r, gate_c, favour, shape, signal):  # type: ignore[no-untyped-def]
    """`compare` for three-term planes, from centred moments; shape (6,), signal (C, 5) scratch."""
    joint_shape(planes, i, j, shape)
    n_i = planes.shape[i, 0]
    n_j = planes.shape[j, 0]
    value = 0.0
    height = 0.0
    for modality in range(2):
        if (modality == 0 and not rule.use_range) or (modality == 1 and not rule.use_color):
            continue
        first, last = channel_span(rule, modality)
        rise_i = 0.0
        rise_j = 0.0
        for c in range(first, last):
            joint_signal(planes, i, j, c, shape, signal[c])
            rise_i += rise(planes, i, c, shape, signal[c])
            rise_j += rise(planes, j, c, shape, signal[c])
        if modality == 0:
            var, eps2 = local_scales(rule.law, signal[0, 0])
            eps2 *= gate_r * gate_r
        else:
            var = 1.0
            eps2 = rule.color_eps2 * gate_c * gate_c
        p = 3.0 * (last - first)
        ratio, need = _weigh(rule, modality, n_i, n_j, p, var, rise_i, rise_j, n_i * eps2, n_j * eps2)
        value = max(value, ratio)
        height = max(height, need)
    return _favoured(value, height, value, favour)


@bare
def simplest(own, rule, k, price):  # type: ignore[no-untyped-def]
    """Least cost of describing the range of one side alone: residual plus `price` for each coefficient.

    The models are a first-degree one, the one that the side has earned, and the one that is tried.
    """
    high = rule.terms[rule.degree[k, 0]].shape[0] * rule.n_range
    least = own[0] + high * price
    if own[2] < np.inf:
        settled = rule.terms[rule.settled[k]].shape[0] * rule.n_range
        least = min(least, own[4] + settled * price)
        least = min(least, own[2] + rule.terms[1].shape[0] * rule.n_range * price)
    return least


@bare
def _flat_joint(moments, big, small, rule, price, work):  # type: ignore[no-untyped-def]
    """Cost of describing the range of both sides by one first-degree model, as `simplest`."""
    for c in range(rule.n_range):
        work.sum_energy[c] = moments.energy[big, c] + moments.energy[small, c]
    terms = rule.terms[1]
    solve(work.sum_power, work.sum_cross, 0, rule.n_range, terms, work.gram, work.coef)
    rss = residual(work.sum_power, work.sum_cross, work.sum_energy, 0, rule.n_range, terms, work.coef)
    return rss + terms.shape[0] * rule.n_range * price


@bare
def _bounded(moments, big, small, rule, own, gate_r, gate_c, favour, work):  # type: ignore[no-untyped-def]
    """Largest ratio over sides and modalities (or of the totals), and the multiple of the limit it needs."""
    n_big = moments.power[big, 0, 0]
    n_small = moments.power[small, 0, 0]
    value = 0.0
    height = 0.0
    for modality in range(2):
        if (modality == 0 and not rule.use_range) or (modality == 1 and not rule.use_color):
            continue
        first, last = channel_span(rule, modality)
        terms = rule.terms[max(rule.degree[big, modality], rule.degree[small, modality])]
        solve(work.sum_power, work.sum_cross, first, last, terms, work.gram, work.coef)
        if modality == 0:
            var, eps2 = local_scales(rule.law, work.sum_cross[0, 0, 0] / (n_big + n_small))
            eps2 *= gate_r * gate_r
        else:
            var = 1.0
            eps2 = rule.color_eps2 * gate_c * gate_c
        p = np.float64(terms.shape[0] * (last - first))
        rise_big = -own[big, modality] + residual(
            moments.power[big], moments.cross[big], moments.energy[big], first, last, terms, work.coef
        )
        rise_small = -own[small, modality] + residual(
            work.power, work.cross, moments.energy[small], first, last, terms, work.coef
        )
        budget_big = n_big * eps2
        budget_small = n_small * eps2
        if modality == 0:
            noise2 = var * rule.n_range
            budget_big = n_big * earned_tolerance(eps2, rule.relief2, n_big, own[big], noise2)
            budget_small = n_small * earned_tolerance(eps2, rule.relief2, n_small, own[small], noise2)
            if rule.earn and terms.shape[0] > rule.terms[1].shape[0]:
                price = var * rule.correlation[0]
                price *= np.log(max((n_big + n_small) / rule.correlation[0], np.e))
                apart = simplest(own[big], rule, big, price) + simplest(own[small], rule, small, price)
                apart += budget_big + budget_small
                apart *= favour
                joint = own[big, 0] + rise_big + own[small, 0] + rise_small + p * price
                if joint > apart and _flat_joint(moments, big, small, rule, price, work) > apart:
                    return np.inf, np.inf
        ratio, need = _weigh(
            rule, modality, n_big, n_small, p, var, rise_big, rise_small, budget_big, budget_small
        )
        value = max(value, ratio)
        height = max(height, need)
    return value, height


@bare
def trace_inverse(moments, k, box, terms, work):  # type: ignore[no-untyped-def]
    """Tr R^-1 of region k on its local domain, its box scaled to [-1, 1] in x and y; inf if R is singular."""
    p = terms.shape[0]
    half_x = max(0.5 * (box[3] - box[1]), 0.5) / UNIT_PX
    half_y = max(0.5 * (box[2] - box[0]), 0.5) / UNIT_PX
    gram = work.gram
    for i in range(p):
        for j in range(i + 1):
            a = terms[i, 0] + terms[j, 0]
            b = terms[i, 1] + terms[j, 1]
            total = moments.power[k, a, b] / (half_x**a * half_y**b)
            for m in range(j):
                total -= gram[i, m] * gram[j, m]
            if i == j:
                if total <= 1e-9:
                    return np.inf
                gram[i, i] = np.sqrt(total)
            else:
                gram[i, j] = total / gram[j, j]
    # Tr (L L^T)^-1 is the squared Frobenius norm of L^-1, found column by column
    trace = 0.0
    column = gram[p]
    for j in range(p):
        for i in range(j, p):
            total = 1.0 if i == j else 0.0
            for m in range(j, i):
                total -= gram[i, m] * column[m]
            column[i] = total / gram[i, i]
            trace += column[i] * column[i]
    return trace


@bare
def _bayes(moments, big, small, rule, own, boxes, work):  # type: ignore[no-untyped-def]
    """c_ib of eq. (21) for i = small, b = big, over n_i; and the average extrapolation error over the limit.

    Returns (c_ib / n_i, e): grouping may go on while e <= 1 (section 8: the average extrapolation error of
    range and of colour each under its own threshold).
    """
    n_small = moments.power[small, 0, 0]
    n_big = moments.power[big, 0, 0]
    value = 0.0
    height = 0.0
    box = boxes[big]
    for modality in range(2):
        if (modality == 0 and not rule.use_range) or (modality == 1 and not rule.use_color):
            continue
        first, last = channel_span(rule, modality)
        terms = rule.terms[rule.degree[big, modality]]
        # the big region's sums are about its own centre, and the small one's were moved there
        solve(moments.power[big], moments.cross[big], first, last, terms, work.gram, work.coef)
        # eq. (18)
        sigma2_ib = residual(work.power, work.cross, moments.energy[small], first, last, terms, work.coef)
        p = terms.shape[0]
        dof = max(n_big - p, 1.0)
        sigma2_b = own[big, modality] / dof
        prior = sigma2_b * trace_inverse(moments, big, box, terms, work) / (rule.beta2 * dof)  # eq. (19)-(20)
        value += (sigma2_ib + prior) / n_small  # eq. (21)
        var, eps2 = local_scales(rule.law, work.sum_cross[0, 0, 0] / (n_big + n_small))
        limit = eps2 + (last - first) * var if modality == 0 else rule.color_eps2 + (last - first)
        height = max(height, np.sqrt(sigma2_ib / n_small / limit))
    return value, height


@bare
def _predicted(moments, big, small, rule, gate_r, gate_c, work):  # type: ignore[no-untyped-def]
    """Mean squared residual of a small region under the model of the larger, over noise and tolerance.

    The tolerance along the ray grows with the slope of the larger model over the small region, as in
    `earned_tolerance`: slivers at the limb of a ball are near its model in space though not along the ray.
    """
    n = moments.power[small, 0, 0]
    worst = 0.0
    for modality in range(2):
        if (modality == 0 and not rule.use_range) or (modality == 1 and not rule.use_color):
            continue
        first, last = channel_span(rule, modality)
        degree = rule.degree[big, modality]
        terms = rule.terms[degree]
        solve(moments.power[big], moments.cross[big], first, last, terms, work.gram, work.coef)
        mean2 = residual(work.power, work.cross, moments.energy[small], first, last, terms, work.coef) / n
        if modality == 0:
            var, eps2 = local_scales(rule.law, work.cross[0, 0, 0] / n)
            eps2 *= gate_r * gate_r
            if degree > 1:
                flat = rule.slope[0] + rule.slope[1] * work.cross[0, 0, 0] / n
                steepness = mean_square_gradient(work.power, terms, work.coef[last - 1])
                eps2 *= 1.0 + min(steepness / (flat * flat), MAX_TAN2)
        else:
            var, eps2 = 1.0, rule.color_eps2 * gate_c * gate_c
        width = last - first
        spread = 4.0 * np.sqrt(2.0 * width * rule.correlation[modality] / n)  # 4 sigma of a mean of squares
        # the larger region predicts with three coefficients that the systematic error has bent
        systematic = rule.systematic2[modality] * (1.0 + 4.0 * np.sqrt(2.0 / 3.0))
        worst = max(worst, mean2 / (var * (width + spread + systematic) + eps2))
    return np.sqrt(worst)


@bare
def compare(moments, i, j, rule, own, boxes, gate_r, gate_c, favour, work):  # type: ignore[no-untyped-def]
    """Compare two regions.

    own : (N, 5) residuals of each region's own models, see `own_residuals`
    boxes : (N, 4) boxes of the regions, for eq. (19)
    gate_r, gate_c : shares of the boundary that are free of edges, of range and of colour
    favour : 1; above, by how much the limit is wider for this pair, below, narrower

    Returns
    -------
    value : float, order of the grouping (smaller is merged first)
    height : float, multiple of the approximation limit that the grouping needs (0: noise alone explains it)
    allowed : bool, whether the grouping stays within the limit
    """
    big, small = (i, j) if moments.power[i, 0, 0] >= moments.power[j, 0, 0] else (j, i)
    move(moments, small, moments.center[big, 0], moments.center[big, 1], work, work.power, work.cross)
    low = work.sum_cross.shape[1]
    for a in range(work.sum_power.shape[0]):
        for b in range(work.sum_power.shape[0]):
            work.sum_power[a, b] = moments.power[big, a, b] + work.power[a, b]
    for c in range(work.sum_cross.shape[0]):
        for a in range(low):
            for b in range(low):
                work.sum_cross[c, a, b] = moments.cross[big, c, a, b] + work.cross[c, a, b]
    if rule.kind == POINTS:
        if moments.power[small, 0, 0] >= rule.small * favour:
            return np.inf, np.inf, False
        value = _predicted(moments, big, small, rule, gate_r, gate_c, work)
        return _favoured(value, value, value, favour)
    if rule.kind == BAYES:
        value, height = _bayes(moments, big, small, rule, own, boxes, work)
        return _favoured(value, height, height, favour)
    value, height = _bounded(moments, big, small, rule, own, gate_r, gate_c, favour, work)
    return _favoured(value, height, value, favour)
