"""All tracks there are: who is seen, who is lost, who came from whom.

Tracks of the last frame compete for the labels of this one first. What is left of the labels is offered to
lost tracks, whose points are looked up one track at a time, since what a lost thing hid or was hidden by is
not known. Labels that nobody takes begin tracks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.config import TrackingConfig
from rcseg_core.tracking import matching
from rcseg_core.tracking.fusion import NO_DRIFT, Filter, Local, in_fixed_frame
from rcseg_core.tracking.named_shapes import Shapes, fixed_shapes, fuse_all, gate
from rcseg_core.tracking.novelty import Novelty
from rcseg_core.tracking.observation import Observation, pick
from rcseg_core.tracking.prediction import Overlap, carry, overlap
from rcseg_core.tracking.tracks import KINDS, Track

Array = NDArray[np.float64]
#: Share of a new label that comes from one track, or of a lost one that lies in one label: split and union.
LINEAGE = 0.5
#: Points that are kept of a track, for the time when it is lost; frames after which they are renewed.
SAMPLE, RENEW = 48, 10


class Frame(NamedTuple):
    """The frame that is being named.

    pose : (4, 4) the sensor in the fixed frame; step, margin : px, see `prediction.carry`; posed : whether
    the pose was told
    """

    seen: Observation
    stamp_ns: int
    pose: Array
    step: int
    margin: int
    posed: bool = False


@dataclass(eq=False)
class Entry:
    """A track as the registry keeps it; see `tracks.Track`. Points are in the fixed frame."""

    id: int
    kind: str
    first_seen_ns: int
    first_frame: int
    parent: int
    state: str = "tentative"
    label: int = 0
    seen: int = 0
    last_seen_ns: int = 0
    last_frame: int = 0
    merged_into: int = 0
    color: Array = field(default_factory=lambda: np.full(3, np.nan))
    filter: Filter | None = None
    points: Array = field(default_factory=lambda: np.empty((0, 3)))
    pixels: NDArray[np.int64] = field(default_factory=lambda: np.empty((0, 2), np.int64))
    squares: float = 0.0
    sampled: int = -RENEW


class Registry:
    """The tracks of one `Tracker`."""

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config
        self._frame = 0
        self._next = 1
        self._forgotten: list[int] = []
        self._entries: dict[str, dict[int, Entry]] = {kind: {} for kind in KINDS}
        self._drift = NO_DRIFT
        self._novelty = Novelty()

    def reconfigure(self, config: TrackingConfig) -> None:
        """End all tracks, and go on with other parameters."""
        self.clear()
        self._config = config

    def clear(self) -> None:
        """End all tracks; ids go on."""
        for entries in self._entries.values():
            self._forgotten.extend(entries)
            entries.clear()

    def drift(self, pose: Array, covariance: Array) -> None:
        """The sensor came to `pose` by a motion with this error, of its own axes: what was seen before lies
        so much less certainly in the fixed frame."""
        self._drift = self._drift + in_fixed_frame(pose, covariance)

    def forgotten(self) -> tuple[int, ...]:
        """Ids of the tracks that ended since the last call."""
        ids, self._forgotten = tuple(sorted(self._forgotten)), []
        return ids

    def update(
        self, frame: Frame, last: Observation | None, votes: NDArray[np.int64] | None
    ) -> dict[str, NDArray[np.int32]]:
        """Ids by label for each kind.

        Parameters
        ----------
        last, votes : the observation of the last frame and what `prediction.carry` made of its points; None
            for the first frame
        """
        self._frame += 1
        squares = {kind: _squares(frame.seen, kind) for kind in KINDS}
        ids = {}
        for kind in KINDS:
            ids[kind] = self._update_kind(kind, frame, last, votes, squares[kind])
            self._prune(kind, frame.stamp_ns)
        return ids

    def snapshot(self, place: Callable[[Local], Local] | None) -> tuple[Track, ...]:
        """All tracks, by id; `place` takes fused shapes to the frame they are told in."""
        entries = [entry for kind in KINDS for entry in self._entries[kind].values()]
        entries.sort(key=lambda entry: entry.id)
        return tuple(self._told(entry, place) for entry in entries)

    def _told(self, entry: Entry, place: Callable[[Local], Local] | None) -> Track:
        fused = None if entry.filter is None else entry.filter.carried(self._drift).fused
        if fused is not None and place is not None:
            fused = place(fused)
        age = self._frame - entry.first_frame + 1
        return Track(
            entry.id, entry.kind, entry.state, entry.label, age, entry.seen, entry.first_seen_ns,
            entry.last_seen_ns, entry.parent, entry.merged_into, fused,
        )  # fmt: skip

    def _update_kind(
        self, kind: str, frame: Frame, last: Observation | None, votes: NDArray[np.int64] | None,
        squares: Array,
    ) -> NDArray[np.int32]:  # fmt: skip
        entries = self._entries[kind]
        count = frame.seen.count(kind)
        owner: list[Entry | None] = [None] * (count + 1)
        shapes = fixed_shapes(frame.seen.shapes, frame.pose) if kind == "surface" else Shapes([], None)
        live = [entry for entry in entries.values() if entry.label]
        live.sort(key=lambda entry: entry.id)
        over: Overlap | None = None
        if last is not None and votes is not None and live and count:
            over = self._overlap(kind, frame, last, votes, live)
            self._match(kind, frame, live, over, over.common.sum(axis=0), owner, shapes)
        found = {entry.id for entry in owner if entry is not None}
        missed = [entry for entry in live if entry.id not in found]
        for entry in missed:
            self._lose(entry)
        lost = [entry for entry in entries.values() if entry.id not in found and not entry.label]
        free = [label for label in range(1, count + 1) if owner[label] is None]
        if lost and free:
            self._find_again(kind, frame, sorted(lost, key=lambda e: e.id), squares, owner, shapes)
        self._relate(live, over, owner)
        for label in range(1, count + 1):
            if owner[label] is None:
                owner[label] = self._begin(kind, frame, label, live, over, squares)
        ids = np.zeros(count + 1, np.int32)
        for label, taken in enumerate(owner):
            if taken is not None:
                ids[label] = taken.id
                self._take(taken, label, frame, float(squares[label]))
        if shapes.planes is not None:
            known = [None if entry is None else entry.filter for entry in owner]
            filters = fuse_all(
                known, shapes.forms, shapes.planes, frame.pose[:3, 3], self._config, self._drift,
                self._novelty if frame.posed else None,
            )  # fmt: skip
            for taken, made in zip(owner, filters, strict=True):
                if taken is not None:
                    taken.filter = made
        return ids

    def _overlap(
        self, kind: str, frame: Frame, last: Observation, votes: NDArray[np.int64], live: list[Entry]
    ) -> Overlap:
        """Overlaps of the tracks of the last frame, a row each in the order of `live`, from 1."""
        row_of = np.zeros(last.count(kind) + 1, np.int64)
        for row, entry in enumerate(live, start=1):
            row_of[entry.label] = row
        rows = row_of[last.group[kind][last.points.region]]
        return overlap(
            votes, last.points.weight, rows, len(live), frame.seen.group[kind], frame.seen.count(kind)
        )

    def _match(
        self, kind: str, frame: Frame, tracks: list[Entry], over: Overlap, size: Array,
        owner: list[Entry | None], shapes: Shapes,
    ) -> None:  # fmt: skip
        """Give labels without an owner to the tracks that claim them best."""
        share = matching.union_share(over.common[1:, 1:], over.visible[1:], size[1:])
        share[:, [entry is not None for entry in owner[1:]]] = 0.0
        allowed = share >= self._config.min_overlap
        rows, columns = np.nonzero(allowed)
        color = np.stack([entry.color for entry in tracks])
        like = matching.likeness(color[rows], frame.seen.colors[kind][1:][columns])
        share[rows, columns] += self._config.color_weight * like
        if shapes.planes is not None:
            claims = np.any(allowed, axis=1)
            known = [entry.filter if some else None for entry, some in zip(tracks, claims, strict=True)]
            sensor = frame.pose[:3, 3]
            gate(allowed, known, shapes.forms, shapes.planes, sensor, self._config, self._drift)
        for t, m in matching.assign(np.where(allowed, share, 0.0)):
            owner[m + 1] = tracks[t]

    def _find_again(
        self, kind: str, frame: Frame, lost: list[Entry], squares: Array, owner: list[Entry | None],
        shapes: Shapes,
    ) -> None:  # fmt: skip
        """Offer the labels that are left to lost tracks."""
        into = np.linalg.inv(frame.pose)
        xyz = np.concatenate([entry.points for entry in lost]) @ into[:3, :3].T + into[:3, 3]
        pixels = np.concatenate([entry.pixels for entry in lost])
        sizes = [len(entry.points) for entry in lost]
        row = np.repeat(np.arange(1, len(lost) + 1), sizes)
        weight = np.repeat([entry.squares / max(len(entry.points), 1) for entry in lost], sizes)
        tolerance = self._config.depth_tolerance
        votes = carry(xyz, pixels, frame.seen, frame.step, tolerance, frame.margin, hides=False)
        over = overlap(votes, weight, row, len(lost), frame.seen.group[kind], frame.seen.count(kind))
        size = np.maximum(squares, over.common.max(axis=0))
        self._match(kind, frame, lost, over, size, owner, shapes)

    def _lose(self, entry: Entry) -> None:
        entry.label = 0
        if entry.state == "confirmed":
            entry.state = "lost"

    def _relate(self, live: list[Entry], over: Overlap | None, owner: list[Entry | None]) -> None:
        """Tracks that lie in the label of another now are merged into that."""
        if over is None:
            return
        for row, entry in enumerate(live, start=1):
            if entry.label or not over.visible[row] > 0:
                continue
            label = int(np.argmax(over.common[row, 1:])) + 1
            other = owner[label]
            if other is not None and over.common[row, label] >= LINEAGE * over.visible[row]:
                entry.merged_into = other.id

    def _begin(
        self, kind: str, frame: Frame, label: int, live: list[Entry], over: Overlap | None, squares: Array
    ) -> Entry:
        """A new track; that of which most of it was, and which is seen elsewhere, is its parent."""
        parent = 0
        if over is not None:
            row = int(np.argmax(over.common[1:, label])) + 1
            if live[row - 1].label and over.common[row, label] >= LINEAGE * max(squares[label], 1e-9):
                parent = live[row - 1].id
        entry = Entry(self._next, kind, frame.stamp_ns, self._frame, parent)
        self._next += 1
        self._entries[kind][entry.id] = entry
        return entry

    def _take(self, entry: Entry, label: int, frame: Frame, squares: float) -> None:
        """The track is this label of this frame."""
        entry.label, entry.merged_into = label, 0
        entry.seen += 1
        entry.last_seen_ns, entry.last_frame = frame.stamp_ns, self._frame
        entry.color = frame.seen.colors[entry.kind][label]
        if entry.seen >= self._config.confirm_frames:
            entry.state = "confirmed"
        grown = squares > 1.1 * entry.squares
        if grown or (self._frame - entry.sampled >= RENEW and squares > 0.7 * entry.squares):
            self._sample(entry, label, frame, squares)

    def _sample(self, entry: Entry, label: int, frame: Frame, squares: float) -> None:
        """Keep some of its points, for the time when it is lost."""
        points = frame.seen.points
        mine = np.empty(SAMPLE, np.int64)
        mine = mine[: pick(points.region, frame.seen.group[entry.kind], label, mine)]
        entry.points = points.xyz[mine] @ frame.pose[:3, :3].T + frame.pose[:3, 3]
        entry.pixels = points.pixel[mine]
        entry.squares, entry.sampled = squares, self._frame

    def _prune(self, kind: str, stamp_ns: int) -> None:
        """Forget lost tracks that are too old or too many, and tentative ones that are not seen."""
        config, entries = self._config, self._entries[kind]
        unseen = [entry for entry in entries.values() if not entry.label]
        gone = []
        for entry in unseen:
            if entry.state == "lost":
                if (stamp_ns - entry.last_seen_ns) / 1e9 > config.keep_lost_s:
                    gone.append(entry)
            elif self._frame - entry.last_frame >= config.confirm_frames:
                gone.append(entry)
        dropped = {entry.id for entry in gone}
        rest = [entry for entry in unseen if entry.id not in dropped]
        rest.sort(key=lambda entry: (entry.last_frame, entry.id))
        gone.extend(rest[: max(len(rest) - config.max_lost, 0)])
        for entry in gone:
            del entries[entry.id]
            self._forgotten.append(entry.id)


def _squares(seen: Observation, kind: str) -> Array:
    """(M + 1,) how many squares each label has."""
    group = seen.group[kind][seen.points.region]
    squares: NDArray[Any] = np.bincount(group, seen.points.weight, seen.count(kind) + 1)
    return squares
