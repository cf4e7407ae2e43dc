"""All tracks there are: who is seen, who is lost, who came from whom.

Tracks of the last frame compete for the labels of this one first. What is left of the labels is offered to
lost tracks, whose points are looked up one track at a time, since what a lost thing hid or was hidden by is
not known. Labels that nobody takes begin tracks.
"""

from __future__ import annotations

from operator import attrgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rcseg_core.config import TrackingConfig
from rcseg_core.tracking import matching
from rcseg_core.tracking.columns import RENEW, SAMPLE, Entries, longer, some
from rcseg_core.tracking.fusion import NO_DRIFT, in_fixed_frame
from rcseg_core.tracking.named_shapes import FusedShapes, Shapes, fixed_shapes
from rcseg_core.tracking.novelty import Novelty
from rcseg_core.tracking.observation import Observation
from rcseg_core.tracking.prediction import Carried, Overlap, carry
from rcseg_core.tracking.tracks import KINDS, STATES, Track

Array = NDArray[np.float64]
Whole = NDArray[np.int64]
#: Share of a new label that comes from one track, or of a lost one that lies in one label: split and union.
LINEAGE = 0.5
#: The kind of labels that have shapes; states by number.
SHAPED = "surface"
_, CONFIRMED, LOST = range(len(STATES))


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


class Registry:
    """The tracks of one `Tracker`."""

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config
        self._frame = 0
        self._next = 1
        self._forgotten: list[int] = []
        self._entries: dict[str, Entries] = {}
        self._fused = FusedShapes()
        self._drift = NO_DRIFT
        self._novelty = Novelty()
        self.clear()

    def reconfigure(self, config: TrackingConfig) -> None:
        """End all tracks, and go on with other parameters."""
        self.clear()
        self._config = config

    def clear(self) -> None:
        """End all tracks; ids go on."""
        for kind in list(self._entries):
            self._keep(kind, np.zeros(len(self._entries[kind].id), np.bool_))
        none = np.zeros(0, np.int64)
        self._entries = {kind: Entries.new(none, none, 0, 0) for kind in KINDS}

    def drift(self, pose: Array, covariance: Array) -> None:
        """The sensor came to `pose` by a motion with this error, of its own axes: what was seen before lies
        so much less certainly in the fixed frame."""
        self._drift = self._drift + in_fixed_frame(pose, covariance)
        self._fused.carry(self._drift)

    def forgotten(self) -> tuple[int, ...]:
        """Ids of the tracks that ended since the last call."""
        ids, self._forgotten = tuple(sorted(self._forgotten)), []
        return ids

    def update(
        self, frame: Frame, last: Observation | None, over: Overlap | None
    ) -> dict[str, NDArray[np.int32]]:
        """Ids by label for each kind.

        Parameters
        ----------
        last, over : the observation of the last frame, and how its regions lie over those of this one; None
            for the first frame
        """
        self._frame += 1
        ids = {}
        for kind in KINDS:
            ids[kind] = self._update_kind(kind, frame, last, over)
            self._prune(kind, frame.stamp_ns)
        return ids

    def snapshot(self, home: Array | None) -> tuple[Track, ...]:
        """All tracks, by id; `home` (4, 4) takes fused shapes to the frame they are told in."""
        told: list[Track] = []
        for kind, rows in self._entries.items():
            ids = rows.id.tolist()
            fused = self._fused.told(ids, home) if kind == SHAPED else [None] * len(ids)
            age = self._frame - rows.first_frame + 1
            columns = (
                rows.label, age, rows.seen, rows.first_seen_ns, rows.last_seen_ns, rows.parent,
                rows.merged_into,
            )  # fmt: skip
            states = [STATES[state] for state in rows.state.tolist()]
            numbers = [column.tolist() for column in columns]
            told += map(Track.of, ids, [kind] * len(ids), states, *numbers, fused)
        return tuple(sorted(told, key=attrgetter("id")))

    def _update_kind(
        self, kind: str, frame: Frame, last: Observation | None, regions: Overlap | None
    ) -> NDArray[np.int32]:
        """Ids by label of one kind; regions: how those of the last frame lie over those of this one."""
        rows, count = self._entries[kind], frame.seen.count(kind)
        squares = frame.seen.squares_of(kind)
        owner = np.full(count + 1, -1)  # row of the track of each label
        shapes = fixed_shapes(frame.seen.shapes, frame.pose) if kind == SHAPED else None
        live = np.flatnonzero(rows.label)
        over: Overlap | None = None
        if last is not None and regions is not None and len(live) and count:
            over = self._overlap(kind, frame, last, regions, live)
            self._match(kind, frame, live, over, over.common.sum(axis=0), owner, shapes)
        found = np.zeros(len(rows.id), np.bool_)
        found[owner[owner >= 0]] = True
        missed = live[~found[live]]
        rows.label[missed] = 0
        rows.state[missed[rows.state[missed] == CONFIRMED]] = LOST
        lost = np.flatnonzero((rows.label == 0) & ~found)
        if len(lost) and (owner[1:] < 0).any():
            self._find_again(kind, frame, lost, squares, owner, shapes)
        if over is not None:
            self._unite(rows, live, over, owner)
        self._begin(kind, frame, live, over, squares, owner)
        rows = self._entries[kind]
        self._take(kind, frame, squares, owner)
        ids = np.zeros(count + 1, np.int32)
        ids[1:] = rows.id[owner[1:]]
        if shapes is not None:
            self._fused.fuse(
                owner, ids.tolist(), shapes, frame.pose[:3, 3], self._config,
                self._novelty if frame.posed else None,
            )  # fmt: skip
        return ids

    def _overlap(
        self, kind: str, frame: Frame, last: Observation, regions: Overlap, live: Whole
    ) -> Overlap:  # fmt: skip
        """Overlaps of the tracks of the last frame, a row each in the order of `live`, from 1."""
        row_of = np.zeros(last.count(kind) + 1, np.int64)
        row_of[self._entries[kind].label[live]] = np.arange(1, len(live) + 1)
        rows, seen = row_of[last.group[kind]], frame.seen
        return regions.of_groups(rows, len(live), seen.group[kind], seen.count(kind))

    def _match(
        self, kind: str, frame: Frame, tracks: Whole, over: Overlap, size: Array, owner: Whole,
        shapes: Shapes | None,
    ) -> None:  # fmt: skip
        """Give labels without an owner to the tracks (T,), by row, that claim them best."""
        rows = self._entries[kind]
        score, allowed = matching.scores(
            over.common[1:, 1:], matching.Side(over.visible[1:], rows.color[tracks]),
            matching.Side(size[1:], frame.seen.colors[kind][1:]), owner[1:] < 0, self._config,
        )  # fmt: skip
        if shapes is not None:
            ids = rows.id[tracks].tolist()
            self._fused.gate(allowed, tracks, ids, shapes, frame.pose[:3, 3], self._config)
        taken, labels = matching.assign(np.where(allowed, score, 0.0))
        owner[labels + 1] = tracks[taken]

    def _find_again(
        self, kind: str, frame: Frame, lost: Whole, squares: Array, owner: Whole, shapes: Shapes | None
    ) -> None:
        """Offer the labels that are left to lost tracks."""
        rows, seen = self._entries[kind], frame.seen
        many = rows.sample[lost]
        kept = np.arange(SAMPLE) < many[:, None]
        row = np.repeat(np.arange(1, len(lost) + 1), many)
        weight = np.repeat(rows.squares[lost] / np.maximum(many, 1), many)
        points = Carried(rows.points[lost][kept], rows.pixels[lost][kept], weight, row, len(lost))
        over = carry(
            points, np.asarray(np.linalg.inv(frame.pose), np.float64), seen, frame.step,
            self._config.depth_tolerance, frame.margin, hides=False,
        )  # fmt: skip
        each = np.arange(len(lost) + 1)
        over = over.of_groups(each, len(lost), seen.group[kind], seen.count(kind))
        self._match(kind, frame, lost, over, np.maximum(squares, over.common.max(axis=0)), owner, shapes)

    def _unite(self, rows: Entries, live: Whole, over: Overlap, owner: Whole) -> None:
        """Tracks that lie in the label of another now are merged into that."""
        gone = np.flatnonzero((rows.label[live] == 0) & (over.visible[1:] > 0))
        if not len(gone):
            return
        common = over.common[gone + 1, 1:]
        label = np.argmax(common, axis=1) + 1
        most = common[np.arange(len(gone)), label - 1] >= LINEAGE * over.visible[gone + 1]
        inside = most & (owner[label] >= 0)
        rows.merged_into[live[gone[inside]]] = rows.id[owner[label[inside]]]

    def _begin(
        self, kind: str, frame: Frame, live: Whole, over: Overlap | None, squares: Array, owner: Whole
    ) -> None:
        """New tracks of the labels without; that of which most of one was, and which is seen elsewhere, is
        its parent."""
        rows = self._entries[kind]
        labels = np.flatnonzero(owner[1:] < 0) + 1
        if not len(labels):
            return
        parent = np.zeros(len(labels), np.int64)
        if over is not None:
            common = over.common[1:, labels]
            row = np.argmax(common, axis=0)
            most = common[row, np.arange(len(labels))] >= LINEAGE * np.maximum(squares[labels], 1e-9)
            parent = np.where(most & (rows.label[live[row]] > 0), rows.id[live[row]], 0)
        owner[labels] = len(rows.id) + np.arange(len(labels))
        ids = self._next + np.arange(len(labels))
        self._next += len(labels)
        self._entries[kind] = longer(rows, Entries.new(ids, parent, frame.stamp_ns, self._frame))
        if kind == SHAPED:
            self._fused.append(len(labels))

    def _take(self, kind: str, frame: Frame, squares: Array, owner: Whole) -> None:
        """The tracks are the labels of this frame that they own; for the time when they are lost, some of
        their points are kept."""
        rows, mine, seen = self._entries[kind], owner[1:], frame.seen
        rows.label[mine] = np.arange(1, len(owner))
        rows.merged_into[mine] = 0
        rows.seen[mine] += 1
        rows.last_seen_ns[mine], rows.last_frame[mine] = frame.stamp_ns, self._frame
        rows.color[mine] = seen.colors[kind][1:]
        rows.state[mine[rows.seen[mine] >= self._config.confirm_frames]] = CONFIRMED
        before, now = rows.squares[mine], squares[1:]
        old = self._frame - rows.sampled[mine] >= RENEW
        due = np.flatnonzero((now > 1.1 * before) | (old & (now > 0.7 * before)))
        if len(due):
            into = np.full(len(owner), -1)
            into[due + 1] = mine[due]
            many = seen.pick(kind, into, frame.pose, rows.points, rows.pixels)
            rows.sample[mine[due]], rows.squares[mine[due]] = many[due + 1], now[due]
            rows.sampled[mine[due]] = self._frame

    def _prune(self, kind: str, stamp_ns: int) -> None:
        """Forget lost tracks that are too old or too many, and tentative ones that are not seen."""
        config, rows = self._config, self._entries[kind]
        unseen = rows.label == 0
        if not unseen.any():
            return
        lost = rows.state == LOST
        old = (stamp_ns - rows.last_seen_ns) / 1e9 > config.keep_lost_s
        forgotten = self._frame - rows.last_frame >= config.confirm_frames
        keep = ~(unseen & np.where(lost, old, forgotten))
        rest = np.flatnonzero(unseen & keep)
        if len(rest) > config.max_lost:
            order = np.argsort(rows.last_frame[rest], kind="stable")
            keep[rest[order[: len(rest) - config.max_lost]]] = False
        if not keep.all():
            self._keep(kind, keep)

    def _keep(self, kind: str, keep: NDArray[np.bool_]) -> None:
        """Keep some tracks (n,), and forget the others."""
        rows = self._entries[kind]
        gone = rows.id[~keep].tolist()
        self._forgotten.extend(gone)
        self._entries[kind] = some(rows, keep)
        if kind == SHAPED:
            self._fused.keep(keep, gone)
