"""HOTA against an oracle from the paper's definitions, and against trackeval where it is installed."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rcseg_core.evaluation.hota import ALPHAS, Seen, track_metrics


def sequence(seed, frames=4, most=3):
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(frames):
        truth = np.sort(rng.choice(4, rng.integers(0, most + 1), replace=False)) + 10
        tracks = np.sort(rng.choice(5, rng.integers(0, most + 1), replace=False)) + 50
        overlap = rng.random((len(truth), len(tracks))) ** 2
        # of masks: rows and columns cannot sum to more than one
        overlap /= max(1.0, *overlap.sum(0), *overlap.sum(1)) if overlap.size else 1.0
        made.append(Seen(truth.astype(np.int64), tracks.astype(np.int64), overlap))
    return made


def naive(frames, alpha):
    """HOTA at one alpha, all matchings of each frame tried out."""
    seen_truth, seen_track, together = {}, {}, {}
    for truth, tracks, overlap in frames:
        for i, t in enumerate(truth):
            seen_truth[t] = seen_truth.get(t, 0) + 1
            for j, p in enumerate(tracks):
                union = overlap[i].sum() + overlap[:, j].sum() - overlap[i, j]
                if union > 0:
                    together[t, p] = together.get((t, p), 0.0) + overlap[i, j] / union
        for p in tracks:
            seen_track[p] = seen_track.get(p, 0) + 1
    alike = {(t, p): v / (seen_truth[t] + seen_track[p] - v) for (t, p), v in together.items()}
    hits = []
    for truth, tracks, overlap in frames:
        best, score = [], -1.0
        n, m = overlap.shape
        for order in permutations(range(max(n, m)), min(n, m)):
            pairs = [(i, j) for i, j in enumerate(order)] if n <= m else [(i, j) for j, i in enumerate(order)]
            total = sum(alike.get((truth[i], tracks[j]), 0.0) * overlap[i, j] for i, j in pairs)
            if total > score:
                best, score = pairs, total
        hits += [(truth[i], tracks[j]) for i, j in best if overlap[i, j] >= alpha - 1e-12]
    if not hits:
        return 0.0
    missed = sum(seen_truth.values()) - len(hits)
    false = sum(seen_track.values()) - len(hits)
    detection = len(hits) / (len(hits) + missed + false)
    association = 0.0
    for t, p in hits:
        tpa = hits.count((t, p))
        association += tpa / (seen_truth[t] + seen_track[p] - tpa)
    return np.sqrt(detection * association / len(hits))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6))
def test_it_is_what_the_paper_defines(seed):
    frames = sequence(seed)
    assert track_metrics(frames).hota == pytest.approx(np.mean([naive(frames, a) for a in ALPHAS]), abs=1e-9)


def test_trackeval_says_the_same():
    hota = pytest.importorskip("trackeval.metrics.hota").HOTA()
    for seed in range(8):
        frames = [f for f in sequence(seed, 6) if len(f.truth) and len(f.tracks)]
        ids = [np.unique(np.concatenate([f[k] for f in frames])) for k in (0, 1)]
        theirs = hota.eval_sequence(
            {
                "gt_ids": [np.searchsorted(ids[0], f.truth) for f in frames],
                "tracker_ids": [np.searchsorted(ids[1], f.tracks) for f in frames],
                "similarity_scores": [f.overlap for f in frames],
                "num_gt_ids": len(ids[0]),
                "num_tracker_ids": len(ids[1]),
                "num_gt_dets": sum(len(f.truth) for f in frames),
                "num_tracker_dets": sum(len(f.tracks) for f in frames),
            }
        )
        ours = track_metrics(frames)
        assert ours.hota == pytest.approx(np.mean(theirs["HOTA"]), abs=1e-9)
        assert ours.detection == pytest.approx(np.mean(theirs["DetA"]), abs=1e-9)
        assert ours.association == pytest.approx(np.mean(theirs["AssA"]), abs=1e-9)


def test_switches_and_fragmentations_of_a_written_out_sequence():
    one = np.array([[0.9]])
    names = [7, 7, None, 7, 8, 8]
    frames = [
        Seen(np.array([1]), np.array([n] if n else [], np.int64), one if n else np.empty((1, 0)))
        for n in names
    ]
    found = track_metrics(frames)
    assert (found.switches, found.fragmentations, found.matches) == (1, 1, 5)
    assert (found.truth_tracks, found.tracks) == (1, 2)


def test_perfect_tracks_score_one_and_no_track_none():
    frames = [Seen(np.array([1, 2]), np.array([5, 6]), np.eye(2))] * 3
    assert track_metrics(frames).hota == 1.0
    nothing = [Seen(np.array([1]), np.empty(0, np.int64), np.empty((1, 0)))]
    assert track_metrics(nothing).hota == 0.0 and track_metrics([]).hota == 0.0
