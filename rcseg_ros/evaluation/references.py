"""What recorded frames are expected to give: figures with tolerances, and points on faces set by hand.

`rcseg evaluate DATA --write-reference FILE` rewrites the figures and keeps what is set by hand (tolerances,
faces); `--check FILE` and the tests compare. A figure that has a better and a worse direction may become
better without limit; a number of regions must stay about the same: without truth nobody knows the right one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from numpy.typing import NDArray

from rcseg_core.errors import InputError
from rcseg_ros.evaluation.options import LEVELS
from rcseg_ros.frames.expansion import load_yaml
from rcseg_ros.recordings.recorded import group_of

if TYPE_CHECKING:
    from rcseg_ros.evaluation.evaluate import Report

BETTER = {
    "purity": +1,
    "boundary_recall": +1,
    "coverage": +1,
    "best_iou": +1,
    "labelled": +1,
    "correct": +1,
    "parts_per_object": -1,
    "noise": -1,
    "blobs": -1,
    "regions": 0,
}
"""Figures that are kept: +1 larger is better, -1 smaller is better, 0 neither."""
RELATIVE = ("parts_per_object", "regions")
"""Figures whose tolerance is a share of the expected value."""
TOLERANCES = {
    "frame": {
        "purity": 0.01, "boundary_recall": 0.08, "coverage": 0.01, "best_iou": 0.2, "labelled": 0.01,
        "correct": 2, "parts_per_object": 0.6, "noise": 2, "blobs": 2, "regions": 0.5,
    },
    "group": {
        "purity": 0.002, "boundary_recall": 0.02, "coverage": 0.005, "best_iou": 0.04, "labelled": 0.005,
        "correct": 2, "parts_per_object": 0.15, "noise": 3, "blobs": 1, "regions": 0.25,
    },
}  # fmt: skip
"""What a new file begins with; by frame wider than pooled, as one piece more of two objects is much."""
HEADER = """\
# What `rcseg evaluate` finds on the recorded frames, and how far a later version may stay behind it.
# The figures are rewritten, tolerances and faces kept, by
#     rcseg evaluate DATA --write-reference {name}
# tolerances: absolute; of parts_per_object and regions a share of the value. Only worse figures are faults;
#     regions, a number, has no worse direction and may move both ways.
# faces: points [row, col] set by hand. All points of one face must lie on one surface, and points of
#     different faces of a frame on different surfaces. A point stands for the 5 x 5 pixels round it.
# face_faults: what is wrong with them as yet, rewritten too; anything else is a fault.
"""
DIGITS = 4
POINT_PX = 2
"""Half width of what a point on a face stands for."""

Figures = dict[str, dict[str, float]]
Faces = dict[str, list[list[int]]]


@dataclass(frozen=True)
class Reference:
    """Expected figures by frame and by group, each by level and name; points [row, col] by frame and face.

    `known_faults` are the faults of faces, in words, that are expected of a frame.
    """

    frames: Mapping[str, Figures] = field(default_factory=dict)
    groups: Mapping[str, Figures] = field(default_factory=dict)
    faces: Mapping[str, Faces] = field(default_factory=dict)
    known_faults: Mapping[str, list[str]] = field(default_factory=dict)
    tolerances: Mapping[str, Mapping[str, float]] = field(default_factory=lambda: TOLERANCES)

    def face_faults(self, name: str, surface_labels: NDArray[np.integer]) -> list[str]:
        """Faces of a frame that are not one surface each, in words."""
        faults, owner = [], {}
        for face, points in self.faces.get(name, {}).items():
            found = [_label_at(surface_labels, *point) for point in points]
            for label, point in zip(found, points, strict=True):
                if label == 0:
                    faults.append(f"face {face}: no surface at {point}")
                elif label != found[0] and found[0] != 0:
                    faults.append(f"face {face}: {point} lies on another surface than {points[0]}")
                other = owner.setdefault(label, face)
                if label != 0 and other != face:
                    faults.append(f"face {face}: {point} lies on the same surface as face {other}")
        return faults

    def faults(self, report: Report) -> dict[str, list[str]]:
        """What is worse than expected, in words, by frame and group of the report; no entry: as expected.

        Frames that the reference has and the report lacks are left out, and the other way round.
        Groups are compared when all of their frames that the reference knows are in the report.
        """
        found: dict[str, list[str]] = {}
        for name, texts in report.face_faults.items():
            if new := [text for text in texts if text not in self.known_faults.get(name, ())]:
                found[name] = new
        for kind, name, level, figures in self._compared(report):
            expected = (self.frames if kind == "frame" else self.groups)[name].get(level, {})
            for key, value in expected.items():
                text = self._fault(kind, key, value, figures.get(key))
                if text:
                    found.setdefault(name, []).append(f"{level}: {text}")
        return found

    def _compared(self, report: Report) -> list[tuple[str, str, str, dict[str, float]]]:
        frames = [("frame", m.name, m.level, figures_of(m)) for m in report.frames if m.name in self.frames]
        incomplete = {group_of(name) for name in self.frames if name not in report.seconds}
        groups = [
            ("group", p.name, p.level, figures_of(p))
            for p in report.pooled
            if p.name in self.groups and p.name not in incomplete
        ]
        return frames + groups

    def _fault(self, kind: str, key: str, expected: float, value: float | None) -> str:
        allowed = self.tolerances[kind][key] * (abs(expected) if key in RELATIVE else 1.0)
        if value is None:
            return f"{key} is missing, expected {expected:g}"
        change = (value - expected) * BETTER[key] if BETTER[key] else -abs(value - expected)
        if change >= -allowed - 10**-DIGITS:  # what rounding makes is no fault
            return ""
        return f"{key} is {value:.4g}, expected {expected:g} and at most {allowed:.3g} worse"


def figures_of(metrics: Any) -> dict[str, float]:
    """The figures of a frame or group that a reference keeps, rounded; what is NaN is left out."""
    row = metrics.row()
    return {key: round(float(row[key]), DIGITS) for key in BETTER if key in row and np.isfinite(row[key])}


def _label_at(labels: NDArray[np.integer], row: int, col: int) -> int:
    """The most frequent label round a pixel, 0 only where there is no other."""
    rows = slice(max(row - POINT_PX, 0), row + POINT_PX + 1)
    counts = np.bincount(labels[rows, max(col - POINT_PX, 0) : col + POINT_PX + 1].ravel())
    return int(np.argmax(counts[1:])) + 1 if counts[1:].any() else 0


def read_reference(path: Path) -> Reference:
    """A reference from its file.

    Raises
    ------
    InputError
        The file cannot be read, or does not hold what a reference holds.
    """
    try:
        document = load_yaml(path.read_text("utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a YAML file: {' '.join(str(error).split())}") from None
    try:
        frames, groups = document["frames"], document["groups"]
        tolerances = {kind: dict(values) for kind, values in document["tolerances"].items()}
        reference = Reference(
            {name: _figures(entry) for name, entry in frames.items()},
            {name: _figures(entry) for name, entry in groups.items()},
            {name: _faces(entry["faces"]) for name, entry in frames.items() if "faces" in entry},
            {name: list(entry["face_faults"]) for name, entry in frames.items() if "face_faults" in entry},
            tolerances,
        )
        for kind, entries in (("frame", reference.frames), ("group", reference.groups)):
            for key in (key for entry in entries.values() for figures in entry.values() for key in figures):
                if key not in BETTER or not isinstance(tolerances[kind][key], (int, float)):
                    raise KeyError(key)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"{path}: no reference of rcseg evaluate ({type(error).__name__}: {error}); "
            "write one with rcseg evaluate DATA --write-reference FILE"
        ) from None
    return reference


def _figures(entry: Mapping[str, Any]) -> Figures:
    return {
        level: {str(key): float(value) for key, value in entry[level].items()}
        for level in LEVELS
        if level in entry
    }


def _faces(entry: Mapping[str, Any]) -> Faces:
    return {str(face): [[int(row), int(col)] for row, col in points] for face, points in entry.items()}


def write_reference(path: Path, report: Report) -> Reference:
    """Write the figures of a report; tolerances, faces and frames that it lacks stay as they are.

    Raises
    ------
    InputError
        A file is there and is no reference, or it cannot be written.
    """
    old = read_reference(path) if path.exists() else Reference()
    frames, groups = dict(old.frames), dict(old.groups)
    for metrics in (m for m in report.frames if m.level in LEVELS):
        frames[metrics.name] = {**frames.get(metrics.name, {}), metrics.level: figures_of(metrics)}
    for pooled in (p for p in report.pooled if p.level in LEVELS):
        groups[pooled.name] = {**groups.get(pooled.name, {}), pooled.level: figures_of(pooled)}
    new = replace(
        old,
        frames=dict(sorted(frames.items())),
        groups=dict(sorted(groups.items())),
        known_faults={**old.known_faults, **report.face_faults},
    )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(_text(new, path.name), "utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
    return new


def _text(reference: Reference, name: str) -> str:
    """The file, one line for each level of a frame, so that a change of figures reads well."""
    lines = [HEADER.format(name=name) + "tolerances:"]
    lines += [f"  {kind}: {_inline(values)}" for kind, values in reference.tolerances.items()]
    lines.append("groups:" if reference.groups else "groups: {}")
    for group, entry in reference.groups.items():
        lines.append(f"  {_inline(group)}:")
        lines += [f"    {level}: {_inline(figures)}" for level, figures in entry.items()]
    lines.append("frames:" if reference.frames else "frames: {}")
    for frame, entry in reference.frames.items():
        lines.append(f"  {_inline(frame)}:")
        lines += [f"    {level}: {_inline(figures)}" for level, figures in entry.items()]
        if frame in reference.faces:
            lines.append("    faces:")
            faces = reference.faces[frame]
            lines += [f"      {_inline(face)}: {_inline(points)}" for face, points in faces.items()]
        if reference.known_faults.get(frame):
            lines.append("    face_faults:")
            lines += [f"      - {_inline(text)}" for text in reference.known_faults[frame]]
    return "\n".join(lines) + "\n"


def _inline(value: Any) -> str:
    if isinstance(value, Mapping):
        value = {key: _short(number) for key, number in value.items()}
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10**6)
    return text.removesuffix("...\n").strip()


def _short(number: float) -> float:
    rounded = round(float(number), DIGITS)
    return int(rounded) if rounded == int(rounded) else rounded
