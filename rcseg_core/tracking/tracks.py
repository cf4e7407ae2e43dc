"""What tracking tells of a frame: a name for every label, and the life of every name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rcseg_core.errors import InputError
from rcseg_core.shapes.local_forms import LocalCylinder, LocalSphere
from rcseg_core.shapes.plane_forms import LocalPlane

#: Levels that are followed; each label of each has a track.
KINDS = ("surface", "region", "object")
#: Seen in a few frames only; seen often enough to be believed; believed and not seen in this frame.
STATES = ("tentative", "confirmed", "lost")
#: What the last frame was carried into this one by; "start": there was none, or time jumped.
MOTIONS = ("start", "pose", "surfaces", "pixels")


@dataclass(frozen=True)
class Track:
    """The life of one surface, region or object up to this frame.

    Attributes
    ----------
    id : 1 and up; one sequence for all kinds, never used again
    kind : one of KINDS
    state : one of STATES
    label : its label in this frame; 0 where it is not seen
    age : frames since it was first seen, that one included
    seen : of these, frames that show it
    first_seen_ns, last_seen_ns : int, stamps
    parent : id of the track that it split from; 0 for none
    merged_into : id of the track that took its pixels, as long as it is not seen on its own; 0 for none
    fused : the shape that all frames together tell, in minimal local form with covariance and systematic
        part; in the fixed frame where poses are given (`Tracks.fixed`), else in the sensor's frame of this
        stamp; None for what is no plane, sphere or cylinder
    """

    id: int
    kind: str
    state: str
    label: int
    age: int
    seen: int
    first_seen_ns: int
    last_seen_ns: int
    parent: int
    merged_into: int
    fused: LocalPlane | LocalSphere | LocalCylinder | None = field(default=None, repr=False)

    @classmethod
    def of(cls, *values: Any) -> Track:
        """One with all of its values, in their order, in half of the time: the constructor of what is frozen
        calls for each."""
        made = cls.__new__(cls)
        vars(made).update(zip(NAMES, values, strict=True))
        return made


NAMES = tuple(one.name for one in fields(Track))


@dataclass(frozen=True)
class Tracks:
    """What `Tracker.update` tells of one frame.

    Attributes
    ----------
    stamp_ns : int, the frame's
    surface_ids, region_ids, object_ids : (N + 1,) int32, label to track id; index 0 is 0
    tracks : of this frame and the lost ones, by id
    ended : ids that were in `tracks` of the frame before and are forgotten now
    motion : one of MOTIONS, what carried the last frame into this one
    pose : (4, 4) float64, the sensor in the fixed frame; without poses in that of the first frame, as far as
        the frames themselves tell the motion
    fixed : whether `pose` was given, so that `Track.fused` is in that frame
    restarted : why all tracks began anew in this frame; "" where they did not
    """

    stamp_ns: int
    surface_ids: NDArray[np.int32]
    region_ids: NDArray[np.int32]
    object_ids: NDArray[np.int32]
    tracks: tuple[Track, ...]
    ended: tuple[int, ...]
    motion: str
    pose: NDArray[np.float64]
    fixed: bool
    restarted: str = ""
    images: Mapping[str, NDArray[np.int32]] = field(default_factory=dict, repr=False)

    def ids(self, kind: str) -> NDArray[np.int32]:
        """(N + 1,) int32, label of a kind to track id.

        Raises
        ------
        InputError
            For another kind.
        """
        if kind not in KINDS:
            raise InputError(f"kind: expected one of {', '.join(KINDS)}, got {kind!r}")
        ids: NDArray[np.int32] = getattr(self, f"{kind}_ids")
        return ids

    def labels(self, kind: str) -> NDArray[np.int32]:
        """(H, W) int32 of track ids; 0 unlabelled. Where a result has no objects, theirs are all 0.

        Raises
        ------
        InputError
            For another kind.
        """
        return self.ids(kind)[self.images[kind]]

    def __getitem__(self, track_id: int) -> Track:
        """The track of an id.

        Raises
        ------
        KeyError
            For an id that is none of this frame's.
        """
        for track in self.tracks:
            if track.id == track_id:
                return track
        raise KeyError(track_id)
