"""HOTA, id switches and fragmentations of tracks against truth.

J. Luiten et al., "HOTA: A Higher Order Metric for Evaluating Multi-Object Tracking", IJCV 2021. At each
overlap alpha (.05 to .95) the labels of a frame are matched to its truth, one to one, so that pairs of tracks
that belong together over the whole sequence come first. Of the matches, detection accuracy is TP / (TP + FN +
FP), association accuracy the mean over TP of TPA / (TPA + FNA + FPA) of its pair of tracks; HOTA is the root
of their product, averaged over alpha.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

ALPHAS = np.arange(0.05, 0.99, 0.05)
#: Overlap at which a switch and a fragmentation are counted, as CLEAR MOT does.
CLEAR_OVERLAP = 0.5


class Seen(NamedTuple):
    """One frame: ids of the truth (n,), ids of the tracks (m,), intersection over union (n, m)."""

    truth: NDArray[np.int64]
    tracks: NDArray[np.int64]
    overlap: NDArray[np.float64]


@dataclass(frozen=True)
class TrackMetrics:
    """How well tracks follow the truth over a sequence.

    Attributes
    ----------
    hota, detection, association : float, see the module; means over ALPHAS
    switches : int, times that a truth is matched to another track than when it was last matched
    fragmentations : int, times that a truth is matched again after frames in which it was seen unmatched
    matches : int, pairs at CLEAR_OVERLAP
    truth_tracks, tracks : int, different ids
    """

    hota: float
    detection: float
    association: float
    switches: int
    fragmentations: int
    matches: int
    truth_tracks: int
    tracks: int

    def row(self) -> dict[str, Any]:
        return dict(vars(self))


def track_metrics(frames: Sequence[Seen]) -> TrackMetrics:
    """Figures of a sequence."""
    truth_ids = np.unique(np.concatenate([np.asarray(f.truth) for f in frames] or [np.empty(0, np.int64)]))
    track_ids = np.unique(np.concatenate([np.asarray(f.tracks) for f in frames] or [np.empty(0, np.int64)]))
    rows = [np.searchsorted(truth_ids, f.truth) for f in frames]
    columns = [np.searchsorted(track_ids, f.tracks) for f in frames]
    alike, in_truth, in_tracks = _alignment(frames, rows, columns, (len(truth_ids), len(track_ids)))
    detection, association = np.zeros(len(ALPHAS)), np.zeros(len(ALPHAS))
    for a, alpha in enumerate(ALPHAS):
        detection[a], association[a] = _accuracy(frames, rows, columns, alike, in_truth, in_tracks, alpha)
    switches, fragmentations, matches = _clear(frames)
    return TrackMetrics(
        float(np.mean(np.sqrt(detection * association))), float(detection.mean()), float(association.mean()),
        switches, fragmentations, matches, len(truth_ids), len(track_ids),
    )  # fmt: skip


def _alignment(
    frames: Sequence[Seen], rows: Any, columns: Any, shape: tuple[int, int]
) -> tuple[Any, Any, Any]:
    """Jaccard index of every pair of tracks over the sequence, and the number of frames of each."""
    together, in_truth, in_tracks = np.zeros(shape), np.zeros(shape[0]), np.zeros(shape[1])
    for frame, r, c in zip(frames, rows, columns, strict=True):
        whole = frame.overlap.sum(axis=0)[None] + frame.overlap.sum(axis=1)[:, None] - frame.overlap
        share = np.divide(frame.overlap, whole, out=np.zeros_like(whole), where=whole > 1e-12)
        together[np.ix_(r, c)] += share
        in_truth[r] += 1
        in_tracks[c] += 1
    alike = together / np.maximum(in_truth[:, None] + in_tracks[None] - together, 1e-12)
    return alike, in_truth, in_tracks


def _accuracy(
    frames: Sequence[Seen], rows: Any, columns: Any, alike: Any, in_truth: Any, in_tracks: Any, alpha: float
) -> tuple[float, float]:
    """Detection and association accuracy at one overlap."""
    pairs = np.zeros_like(alike)
    hits = 0
    for frame, r, c in zip(frames, rows, columns, strict=True):
        i, j = linear_sum_assignment(alike[np.ix_(r, c)] * frame.overlap, maximize=True)
        good = frame.overlap[i, j] >= alpha - 1e-12
        hits += int(good.sum())
        pairs[r[i[good]], c[j[good]]] += 1
    wanted, given = in_truth.sum(), in_tracks.sum()
    if not hits:
        return 0.0, 0.0
    jaccard = pairs / np.maximum(in_truth[:, None] + in_tracks[None] - pairs, 1.0)
    return hits / (wanted + given - hits), float((pairs * jaccard).sum() / hits)


def _clear(frames: Sequence[Seen]) -> tuple[int, int, int]:
    """Switches, fragmentations and matches at CLEAR_OVERLAP, which a truth and a track reach once at most."""
    last: dict[int, int] = {}
    lost: set[int] = set()
    switches = fragmentations = matches = 0
    for frame in frames:
        for i, truth in enumerate(frame.truth.tolist()):
            hits = np.flatnonzero(frame.overlap[i] > CLEAR_OVERLAP)
            if not len(hits):
                if truth in last:
                    lost.add(truth)
                continue
            matches += 1
            track = int(frame.tracks[hits[0]])
            switches += truth in last and last[truth] != track
            fragmentations += truth in lost
            lost.discard(truth)
            last[truth] = track
    return switches, fragmentations, matches
