"""EVOPS's matched ratios against their definition, and against its own library where that is installed."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from rcseg_core.evaluation.association import matched_ratios, owners


def pair(seed):
    """Labels and truth of two frames: the second is the first with some pixels and some names changed."""
    rng = np.random.default_rng(seed)
    truth = [np.sort(rng.integers(0, 5, 60)) for _ in range(2)]
    ids = []
    for own in truth:
        name = rng.permutation(8)[:5] if rng.random() < 0.5 else np.arange(5)
        made = np.where(rng.random(60) < 0.25, rng.integers(0, 8, 60), name[own])
        made[0] = own[0] = 0  # there is always something that nobody segmented
        ids.append(made)
    return ids, truth


def naive(ids, truth):
    """Pixel by pixel, from the words of the definition."""
    belongs = []
    for own, true in zip(ids, truth, strict=True):
        claims = []
        for name in sorted(set(own.tolist()) - {0}):
            votes = [list(true[own == name]).count(t) for t in range(5)]
            if votes.index(max(votes)):
                claims.append((max(votes), name, votes.index(max(votes))))
        found = {}
        for _, name, t in sorted(claims, key=lambda claim: -claim[0]):
            if t not in found.values():
                found[name] = t
        belongs.append(found)
    good = total = good_points = points = 0
    for name in set(ids[1].tolist()) - {0}:
        wanted = [n for n, t in belongs[0].items() if t == belongs[1].get(name)]
        named = [name] if name in ids[0] else []
        size = int((ids[1] == name).sum())
        total, points = total + 1, points + size
        if wanted == named:
            good, good_points = good + 1, good_points + size
    return good / total, good_points / points


@pytest.mark.parametrize("seed", range(40))
def test_they_are_what_their_definition_says(seed):
    ids, truth = pair(seed)
    told = matched_ratios(*(owners(own, true) for own, true in zip(ids, truth, strict=True)))
    assert told == pytest.approx(naive(ids, truth))


def test_evops_says_the_same(monkeypatch):
    # its hints need a package that is too old for numpy 2
    monkeypatch.setitem(sys.modules, "nptyping", SimpleNamespace(NDArray=dict))
    evops = pytest.importorskip("evops.metrics.association")
    for seed in range(40):
        _compare(evops, *pair(seed))


def _compare(evops, ids, truth):
    named = {int(n): int(n) if n in ids[0] else None for n in np.unique(ids[1]) if n}
    told = matched_ratios(*(owners(own, true) for own, true in zip(ids, truth, strict=True)))
    arguments = named, ids[1], ids[0], truth[1], truth[0]
    assert told[0] == pytest.approx(evops.matched_planes_ratio_with_matching(*arguments))
    assert told[1] == pytest.approx(evops.matched_points_ratio_with_matching(*arguments))


def test_names_that_change_places_are_wrong_and_new_ones_are_right():
    truth = np.repeat([1, 2, 3, 4], 10)
    first = owners(np.repeat([1, 2, 3, 0], 10), truth)
    assert matched_ratios(first, first) == (1.0, 1.0)
    assert matched_ratios(first, owners(np.repeat([2, 1, 3, 9], 10), truth)) == (0.5, 0.5)
    half = np.repeat([1, 7, 7, 7], 10)  # one plane on three truths takes the first of them
    assert matched_ratios(first, owners(half, truth)) == (0.5, 0.25)
    assert all(np.isnan(matched_ratios(first, owners(np.zeros(40, int), truth))))


def test_evaluated_journeys_tell_them():
    from rcseg_core.evaluation.tracks import evaluate_journey
    from rcseg_core.synthetic import make_journey

    frames = list(make_journey(40, 3, width=96, height=72))[:3]
    row = evaluate_journey(frames)["exact"]["surface"].row()
    assert 0.8 < row["matched_planes"] <= 1.0 and 0.9 < row["matched_points"] <= 1.0
    assert row["matched_planes"] >= row["matched_planes_untracked"]
