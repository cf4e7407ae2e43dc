"""How well names last: tracks of a sequence against its exact truth, beside the same without tracking.

The house's conventions hold (see `evaluation`): pixels without a measurement are nobody's, slivers of the
truth are ignored with their pixels, and crumbs of the machine count as unlabelled.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rcseg_core.config import SegmenterConfig
from rcseg_core.errors import InputError
from rcseg_core.evaluation.association import Owned, matched_ratios, owners
from rcseg_core.evaluation.hota import Seen, TrackMetrics, track_metrics
from rcseg_core.evaluation.uncertainty import plane_error, true_kind, truth_of
from rcseg_core.frame import RangeColorFrame
from rcseg_core.pipeline import segment
from rcseg_core.result.segmentation import Segmentation
from rcseg_core.shapes.plane_forms import LocalPlane
from rcseg_core.synthetic import JourneyFrame
from rcseg_core.tracking import Segmenter, Tracker, Tracks

Array = NDArray[np.float64]
POSES = ("exact", "noisy", "none")
#: One sigma of noisy poses in each direction.
NOISE_M, NOISE_RAD = 0.01, np.deg2rad(0.5)
LEVELS = ("surface", "region")
#: Least area of what counts, and of what is large, shares of the image.
SLIVER, LARGE = 100 / (640 * 480), 0.01
#: By how much the depth of a pixel may differ from that of the point that was carried there, share of depth.
SAME_DEPTH = 0.01
#: The same between measured depths.
MEASURED_DEPTH = 0.03
#: Least share of the image of labels whose names should last: 500 px at 640 x 480.
PERSISTENT_PX = 500 / (640 * 480)


@dataclass
class LevelReport:
    """Figures of one level of one sequence.

    tracked, untracked : TrackMetrics with track ids and with the labels themselves as ids
    large : TrackMetrics of truths above LARGE alone, with track ids
    consistency, consistency_untracked : share of pixels, seen in one frame and the next and labelled in both,
        that keep their id
    matched, matched_untracked : EVOPS's matched_planes_ratio and matched_points_ratio (see `association`),
        means over the frames
    nees: squared errors over their covariance, by degree of freedom, of the fused planes of the last frame
    """

    tracked: TrackMetrics
    untracked: TrackMetrics
    large: TrackMetrics
    consistency: float
    consistency_untracked: float
    matched: tuple[float, float] = (float("nan"), float("nan"))
    matched_untracked: tuple[float, float] = (float("nan"), float("nan"))
    nees: tuple[float, ...] = ()

    def row(self) -> dict[str, Any]:
        """Plain figures, one line of a table."""
        return {
            "hota": self.tracked.hota,
            "detection": self.tracked.detection,
            "association": self.tracked.association,
            "consistency": self.consistency,
            "switches": self.tracked.switches,
            "switches_large": self.large.switches,
            "fragmentations": self.tracked.fragmentations,
            "tracks": self.tracked.tracks,
            "truth_tracks": self.tracked.truth_tracks,
            "hota_untracked": self.untracked.hota,
            "association_untracked": self.untracked.association,
            "consistency_untracked": self.consistency_untracked,
            "switches_untracked": self.untracked.switches,
            "matched_planes": self.matched[0],
            "matched_points": self.matched[1],
            "matched_planes_untracked": self.matched_untracked[0],
            "matched_points_untracked": self.matched_untracked[1],
            "fused_planes": len(self.nees),
            "fused_nees": float(np.mean(self.nees)) if self.nees else float("nan"),
        }


@dataclass
class _Level:
    """What one level of a sequence amounts to, frame by frame."""

    tracked: list[Seen] = field(default_factory=list)
    untracked: list[Seen] = field(default_factory=list)
    large: list[Seen] = field(default_factory=list)
    kept: Array = field(default_factory=lambda: np.zeros(2))
    carried: Array = field(default_factory=lambda: np.zeros(2))
    before: tuple[NDArray[np.int32], NDArray[np.int32]] | None = None
    owned: tuple[Owned, Owned] | None = None
    matched: list[list[float]] = field(default_factory=list)

    def report(self, nees: tuple[float, ...] = ()) -> LevelReport:
        share = self.kept / np.maximum(self.carried, 1)
        known = np.array(self.matched).reshape(-1, 4)
        known = known[np.isfinite(known).all(axis=1)]
        a, b, c, d = known.mean(axis=0).tolist() if len(known) else [float("nan")] * 4
        return LevelReport(
            track_metrics(self.tracked), track_metrics(self.untracked), track_metrics(self.large),
            float(share[0]), float(share[1]), (a, b), (c, d), nees,
        )  # fmt: skip


def noisy(pose: Array, rng: np.random.Generator) -> Array:
    """A pose with the errors NOISE_M and NOISE_RAD in each direction."""
    error = np.eye(4)
    error[:3, :3] = Rotation.from_rotvec(rng.normal(size=3) * NOISE_RAD).as_matrix()
    error[:3, 3] = rng.normal(size=3) * NOISE_M
    return pose @ error


def evaluate_journey(
    frames: Iterable[JourneyFrame],
    config: SegmenterConfig | None = None,
    *,
    poses: Sequence[str] = ("exact",),
    seed: int = 0,
    look: Callable[[JourneyFrame, Segmentation, Tracks], None] | None = None,
) -> dict[str, dict[str, LevelReport]]:
    """Segment a sequence, track it with poses of several kinds, and judge that.

    It is segmented once, but with ``tracking.stability`` once for each kind of poses.

    Parameters
    ----------
    poses : of "exact", "noisy" (the tracker is told how noisy) and "none"
    seed : int, of the noise of the poses
    look : called with every frame, its result and its tracks, for each kind of poses

    Returns
    -------
    Reports by poses and level.

    Raises
    ------
    InputError
        For other poses.
    """
    for word in poses:
        if word not in POSES:
            raise InputError(f"poses: expected of {', '.join(POSES)}, got {word!r}")
    config = config or SegmenterConfig()
    followed = [_Followed(word, config, seed) for word in poses]
    alone = config.tracking.stability == 0
    for frame in frames:
        result = segment(frame.scene.frame, config) if alone else None
        for one in followed:
            result_of_it, tracks = one.add(frame, result)
            if look is not None:
                look(frame, result_of_it, tracks)
    return {one.poses: one.report() for one in followed}


class _Followed:
    """A sequence that is tracked with poses of one kind."""

    def __init__(self, poses: str, config: SegmenterConfig, seed: int) -> None:
        if poses == "noisy":
            noise = {"tracking.pose_sigma_m": NOISE_M, "tracking.pose_sigma_rad": float(NOISE_RAD)}
            config = config.replace(noise)
        self.poses, self._tracker, self._segmenter = poses, Tracker(config), Segmenter(config)
        self._rng = np.random.default_rng([seed, *b"poses"])
        self._levels = {level: _Level() for level in LEVELS}
        self._last: tuple[JourneyFrame, Segmentation, Tracks] | None = None

    def add(self, frame: JourneyFrame, result: Segmentation | None) -> tuple[Segmentation, Tracks]:
        """The next frame, and its result where that depends on no other."""
        exact = frame.scene.pose
        pose = {"exact": exact, "noisy": noisy(exact, self._rng), "none": None}[self.poses]
        if result is None:
            result = self._segmenter.segment(frame.scene.frame, frame.stamp_ns, pose)
        tracks = self._tracker.update(result, frame.stamp_ns, pose)
        flow = None if self._last is None else carried_pixels(self._last[0], frame)
        for name, level in self._levels.items():
            _add(level, name, frame, result, tracks, flow)
        self._last = frame, result, tracks
        return result, tracks

    def report(self) -> dict[str, LevelReport]:
        nees = () if self._last is None else tuple(fused_nees(*self._last))
        return {name: level.report(nees if name == "surface" else ()) for name, level in self._levels.items()}


def fused_nees(frame: JourneyFrame, result: Segmentation, tracks: Tracks) -> Iterator[float]:
    """Squared error of each fused plane over its stated covariance, by degree of freedom.

    Of planes of which nearly all pixels are on one truth surface.
    """
    scene = frame.scene
    into = np.linalg.inv(scene.pose) if tracks.fixed else np.eye(4)
    for surface in result.surfaces:
        fused = tracks[int(tracks.surface_ids[surface.label])].fused
        owner = truth_of(scene.surface_labels, result.surface_labels == surface.label)
        if not isinstance(fused, LocalPlane) or not owner:
            continue
        own = scene.surface_labels == owner
        normals = scene.normals[own].astype(np.float64)
        if true_kind(normals) != "plane":
            continue
        here = LocalPlane(into @ fused.pose, fused.covariance, fused.systematic)
        error = plane_error(here, scene.clean_points[own], normals)
        yield float(error @ np.linalg.solve(here.covariance_of(), error)) / 3.0


def _add(
    level: _Level, name: str, frame: JourneyFrame, result: Segmentation, tracks: Tracks, flow: Any
) -> None:  # fmt: skip
    scene = frame.scene
    if name == "surface":
        truth, labels = frame.surface_tracks[scene.surface_labels], result.surface_labels
    else:
        truth, labels = frame.region_tracks[scene.labels], result.labels
    ids = tracks.labels(name)
    usable = scene.frame.valid
    level.tracked.append(seen_in(truth, ids, usable, SLIVER))
    level.untracked.append(seen_in(truth, labels, usable, SLIVER))
    level.large.append(seen_in(truth, ids, usable, LARGE))
    if flow is not None and level.before is not None:
        for i, (before, now) in enumerate(zip(level.before, (ids, labels), strict=True)):
            first, second = before.ravel()[flow[0]], now.ravel()[flow[1]]
            both = (first > 0) & (second > 0)
            level.carried[i] += both.sum()
            level.kept[i] += (first == second)[both].sum()
    level.before = ids, labels
    owned = (owned_in(truth, ids, usable), owned_in(truth, labels, usable))
    if level.owned is not None:
        both = zip(level.owned, owned, strict=True)
        level.matched.append([ratio for before, now in both for ratio in matched_ratios(before, now)])
    level.owned = owned


def owned_in(truth: NDArray[np.integer], ids: NDArray[np.integer], usable: NDArray[np.bool_]) -> Owned:
    """`owners` by the house's conventions: what is too small, on either side, is nobody's."""
    least = max(SLIVER * truth.size, 1.0)
    known = np.bincount(truth.ravel()) >= least
    counted = np.where(usable & known[truth], ids, 0)
    kept = np.bincount(counted.ravel()) >= least
    return owners(np.where(kept[counted], counted, 0), np.where(known[truth], truth, 0))


def seen_in(
    truth: NDArray[np.integer], ids: NDArray[np.integer], usable: NDArray[np.bool_], least: float
) -> Seen:
    """Overlaps of one frame.

    Parameters
    ----------
    truth, ids : (H, W) numbers, 0 for none
    usable : (H, W) pixels that count
    least : share of the image below which truths are ignored with their pixels
    """
    area = np.bincount(truth.ravel())
    names = np.flatnonzero(area >= max(least * truth.size, 1.0))
    names = names[names > 0]
    counted = usable & np.isin(truth, names)
    machine, of_pixel = np.unique(ids[counted], return_inverse=True)
    rows = np.searchsorted(names, truth[counted])
    table = np.bincount(rows * len(machine) + of_pixel, minlength=len(names) * len(machine))
    table = table.reshape(len(names), len(machine)).astype(np.float64)
    kept = (machine > 0) & (table.sum(axis=0) >= SLIVER * truth.size)
    sizes = table.sum(axis=1)[:, None] + table.sum(axis=0)[None] - table
    share = table / np.maximum(sizes, 1.0)
    there = table.sum(axis=1) > 0
    return Seen(names[there].astype(np.int64), machine[kept].astype(np.int64), share[there][:, kept])


def carried_pixels(last: JourneyFrame, now: JourneyFrame) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Flat indices of the pixels of one frame that the next shows too, and where."""
    scene, camera = now.scene, now.scene.frame.camera
    assert camera is not None
    before = last.scene
    thing = before.object_labels.ravel()
    world = before.clean_points.reshape(-1, 3) @ before.pose[:3, :3].T + before.pose[:3, 3]
    world = world + (now.shift - last.shift)[thing]
    into = np.linalg.inv(scene.pose)
    x, y, z = (world @ into[:3, :3].T + into[:3, 3]).T
    with np.errstate(invalid="ignore", divide="ignore"):
        col, row = np.rint(x / z * camera.fx + camera.cx), np.rint(y / z * camera.fy + camera.cy)
    height, width = scene.labels.shape
    inside = (thing > 0) & (z > 0) & (col >= 0) & (col < width) & (row >= 0) & (row < height)
    first = np.flatnonzero(inside)
    second = (row[inside] * width + col[inside]).astype(np.intp)
    depth = scene.clean_points[..., 2].ravel()[second]
    names = last.surface_tracks[before.surface_labels].ravel()[first]
    same = (np.abs(depth - z[inside]) < SAME_DEPTH * z[inside]) & (
        scene.object_labels.ravel()[second] == thing[first]
    )
    same &= now.surface_tracks[scene.surface_labels].ravel()[second] == names
    return first[same], second[same]


@dataclass
class RecordingReport:
    """How well names last in a recording without truth, by depth and the motion that tracking tells.

    frames : int
    ids : by level, different ids of surfaces of PERSISTENT_PX and more
    consistency, consistency_untracked : by level, share of pixels that keep their id, as in `LevelReport`
    persistent : by level, share of the ids of PERSISTENT_PX and more that the next frame has on the same
        pixels (IoU above .7), of the pixels that both frames show
    motions : frames by what told their motion
    """

    frames: int = 0
    consistency: dict[str, float] = field(default_factory=dict)
    consistency_untracked: dict[str, float] = field(default_factory=dict)
    persistent: dict[str, float] = field(default_factory=dict)
    ids: dict[str, int] = field(default_factory=dict)
    motions: dict[str, int] = field(default_factory=dict)

    def row(self, level: str) -> dict[str, Any]:
        """Plain figures of one level."""
        return {
            "frames": self.frames,
            "consistency": self.consistency[level],
            "consistency_untracked": self.consistency_untracked[level],
            "persistent": self.persistent[level],
            "ids": self.ids[level],
        }


def evaluate_recording(
    frames: Iterable[tuple[RangeColorFrame, int, Array | None]], config: SegmenterConfig | None = None
) -> RecordingReport:
    """Segment and track frames (frame, stamp in ns, pose or None) of which no truth is known."""
    config = config or SegmenterConfig()
    tracker, segmenter, report = Tracker(config), Segmenter(config), RecordingReport()
    kept = {level: np.zeros(6) for level in LEVELS}  # pixels and labels: kept, carried, kept untracked
    ids: dict[str, set[int]] = {level: set() for level in LEVELS}
    last: tuple[RangeColorFrame, Segmentation, Tracks] | None = None
    for frame, stamp_ns, pose in frames:
        result = segmenter.segment(frame, stamp_ns, pose)
        tracks = tracker.update(result, stamp_ns, pose)
        report.frames += 1
        report.motions[tracks.motion] = report.motions.get(tracks.motion, 0) + 1
        flow = None if last is None or frame.camera is None else _measured_flow(last, (frame, result, tracks))
        for level in LEVELS:
            now = tracks.labels(level)
            sizes = np.bincount(now.ravel())
            ids[level].update(np.flatnonzero(sizes >= PERSISTENT_PX * now.size)[:].tolist())
            if last is None or flow is None:
                continue
            plain = (
                (last[1].surface_labels, result.surface_labels)
                if level == "surface"
                else (last[1].labels, result.labels)
            )
            first, second = last[2].labels(level).ravel()[flow[0]], now.ravel()[flow[1]]
            both = (first > 0) & (second > 0)
            kept[level][:2] += (first == second)[both].sum(), both.sum()
            kept[level][2] += (plain[0].ravel()[flow[0]] == plain[1].ravel()[flow[1]])[both].sum()
            kept[level][3:5] += _persistent(first[both], second[both], PERSISTENT_PX * now.size)
        last = frame, result, tracks
    for level in LEVELS:
        good, carried, plain_good, persistent, labels, _ = kept[level]
        report.consistency[level] = float(good / max(carried, 1))
        report.consistency_untracked[level] = float(plain_good / max(carried, 1))
        report.persistent[level] = float(persistent / max(labels, 1))
        report.ids[level] = len(ids[level] - {0})
    return report


def _persistent(first: NDArray[np.integer], second: NDArray[np.integer], least: float) -> tuple[int, int]:
    """Ids of the first frame that the second has on the same pixels (IoU above .7), and all of them."""
    good = total = 0
    for name in np.flatnonzero(np.bincount(first) >= least).tolist():
        mine, there = first == name, second == name
        total += 1
        good += bool((mine & there).sum() > 0.7 * (mine | there).sum())
    return good, total


def _measured_flow(last: Any, now: Any) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """As `carried_pixels`, by measured depth and the motion that tracking tells."""
    before, (frame, _, tracks) = last[0], now
    into = np.linalg.inv(tracks.pose) @ last[2].pose
    x, y, z = (before.points.reshape(-1, 3) @ into[:3, :3].T + into[:3, 3]).T
    camera, (height, width) = frame.camera, frame.valid.shape
    with np.errstate(invalid="ignore", divide="ignore"):
        col, row = np.rint(x / z * camera.fx + camera.cx), np.rint(y / z * camera.fy + camera.cy)
    inside = before.valid.ravel() & (z > 0) & (col >= 0) & (col < width) & (row >= 0) & (row < height)
    first = np.flatnonzero(inside)
    second = (row[inside] * width + col[inside]).astype(np.intp)
    depth = frame.depth_m.ravel()[second]
    with np.errstate(invalid="ignore"):
        same = frame.valid.ravel()[second] & (np.abs(depth - z[inside]) < MEASURED_DEPTH * z[inside])
    return first[same], second[same]
