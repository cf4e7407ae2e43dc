"""Which recorded topics give range, colour and camera: named by the user, or found by content and name.

What a topic could be is told by `candidates`. Where several would do, the choice goes by what speaks against
each, in the order of `_against_range`, `_against_color` and `_against_camera`; ties go to the
first in alphabetical order. Topics of truth and of rcseg itself are inputs only when named.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from rcseg_core.errors import InputError
from rcseg_ros.frames.registration import registered_by_name
from rcseg_ros.recordings.bag import Recording
from rcseg_ros.recordings.candidates import (
    CAMERA_INFO,
    CLOUD,
    COMPRESSED,
    IMAGE,
    Candidate,
    candidates_of,
    words_of,
)

__all__ = [
    "CAMERA_INFO",
    "CLOUD",
    "COMPRESSED",
    "IMAGE",
    "KEYS",
    "TF_TYPE",
    "TRUTH_TOPICS",
    "InputTopics",
    "find_topics",
]

#: Where recordings of synthetic scenes hold their truth.
TRUTH_TOPICS = {"labels": "/truth/labels", "surface_labels": "/truth/surface_labels"}
TF_TYPE = "tf2_msgs/msg/TFMessage"
KEYS = ("range", "color", "camera_info", "range_camera_info")
_TYPES = (CLOUD, IMAGE, COMPRESSED, CAMERA_INFO)

#: What speaks against a candidate, the weightiest first: whether it holds, and the words for it.
_Faults = list[tuple[bool, str]]


@dataclass(frozen=True)
class InputTopics:
    """Topics that make frames; ``color`` None: the cloud's own colour; ``camera_info`` None: do without.

    ``range_camera_info`` is that of a range which another camera than the colour's measures, else None.
    """

    range: str
    color: str | None
    camera_info: str | None
    range_camera_info: str | None = None

    def names(self) -> list[str]:
        names = (self.range, self.color, self.camera_info, self.range_camera_info)
        return [name for name in names if name is not None]


def find_topics(
    recording: Recording,
    named: Mapping[str, str],
    range_from: str = "auto",
    explain: Callable[[str], None] = lambda line: None,
) -> InputTopics:
    """Choose the input topics of a recording.

    Parameters
    ----------
    named : any of ``range``, ``color``, ``camera_info``, ``range_camera_info`` to a topic, or to ``none``
    range_from : "auto", "points" or "depth"
    explain : called with a line for every topic: what it is taken for and why, or why not

    Raises
    ------
    InputError
        If nothing fits; the message lists the topics that there are.
    """
    candidates = candidates_of(recording)
    _check_names(recording, candidates, named)
    ranges = _select(candidates, named.get("range"), lambda c: _is_range(c, range_from))
    if not ranges and range_from != "points":
        ranges = _select(candidates, named.get("range"), lambda c: c.maybe_depth and not c.odd)
    colors = _select(candidates, named.get("color"), lambda c: c.role == "color")
    ranked = _ranked(ranges, lambda c: _against_range(c, [o for o in colors if o is not c]))
    chosen = ranked[0][0] if ranked else None
    rows = {"range": ranked}
    color = info = own = None
    if chosen is not None:
        rows["color"] = _ranked([c for c in colors if c is not chosen], lambda c: _against_color(c, chosen))
        color = rows["color"][0][0] if rows["color"] else None
        if color is not None and "color" not in named and chosen.has_color and not _one_grid(color, chosen):
            color = None
        infos = _select(candidates, named.get("camera_info"), lambda c: c.role == "camera")
        beside = [
            c for c in ((color, chosen) if chosen.role == "cloud" else (chosen, color)) if c is not None
        ]
        if color is not None and _apart(chosen, color):
            beside = [color]
            others = _select(candidates, named.get("range_camera_info"), lambda c: c.role == "camera")
            rows["range_camera_info"] = _ranked(others, lambda c: _against_camera(c, [chosen]))
            own = rows["range_camera_info"][0][0] if others else None
            if own is not None and not own.same_frame(chosen) and "range_camera_info" not in named:
                own = None  # the colour's
        rows["camera_info"] = _ranked(
            [c for c in infos if c is not own], lambda c: _against_camera(c, beside)
        )
        info = rows["camera_info"][0][0] if rows["camera_info"] else None
    taken = {"range": chosen, "color": color, "camera_info": info, "range_camera_info": own}
    for line in _explained(candidates, rows, taken, named):
        explain(line)
    if chosen is None:
        wanted = {"points": "point clouds", "depth": "depth images"}
        what = wanted.get(range_from, "point clouds or depth images")
        raise InputError(f"no {what} in {recording.path}; {_listing(candidates)}")
    if color is None and not chosen.has_color:
        raise InputError(f"no colour image for {chosen.name} in {recording.path}; {_listing(candidates)}")
    return InputTopics(chosen.name, *(c.name if c else None for c in (color, info, own)))


def _check_names(recording: Recording, candidates: Sequence[Candidate], named: Mapping[str, str]) -> None:
    usable = {
        c.name for c in candidates if c.topic.type in _TYPES and c.topic.count and c.topic.encoding == "cdr"
    }
    for key, name in named.items():
        if key not in KEYS:
            raise InputError(f"--topics: unknown key {key!r}, expected one of {', '.join(KEYS)}")
        if name != "none" and name not in usable:
            raise InputError(f"no topic {name} of a usable type in {recording.path}; {_listing(candidates)}")


def _is_range(candidate: Candidate, range_from: str) -> bool:
    wanted = {"points": ("cloud",), "depth": ("depth",)}.get(range_from, ("cloud", "depth"))
    return candidate.role in wanted


def _select(
    candidates: Sequence[Candidate], name: str | None, fits: Callable[[Candidate], bool]
) -> list[Candidate]:
    """The candidate that the user named, none where the user wants none, else all that fit."""
    if name is not None:
        return [c for c in candidates if c.name == name]
    return [c for c in candidates if fits(c) and not c.reserved]


def _ranked(
    candidates: Sequence[Candidate], against: Callable[[Candidate], _Faults]
) -> list[tuple[Candidate, _Faults]]:
    """Candidates with what speaks against them, the best first."""
    judged = [(c, against(c)) for c in candidates]
    return sorted(judged, key=lambda item: ([fault for fault, _ in item[1]], item[0].name))


def _one_grid(one: Candidate, other: Candidate) -> bool:
    return one.same_size(other) and one.same_frame(other)


def _apart(chosen: Candidate, color: Candidate) -> bool:
    """Whether range and colour are of two cameras that no driver has registered."""
    return not chosen.same_frame(color) and not registered_by_name(chosen.name, color.name)


def _against_range(candidate: Candidate, colors: Sequence[Candidate]) -> _Faults:
    sized = [c for c in colors if c.size == candidate.size]
    framed = any(c.same_frame(candidate) for c in sized)
    kin = any(c.kinship(candidate) > 1 for c in colors)  # the first part is the empty one before the slash
    return [
        (not sized, "no colour image has its size"),
        (not framed, "no colour image of its size is in its frame"),
        (not kin, "of another name than any colour image"),
        (candidate.role != "cloud", "a cloud goes before a depth image"),
        (not words_of(candidate.name) & {"aligned", "registered"}, "another is named aligned or registered"),
        (candidate.is_compressed, "compressed"),
    ]


def _against_color(candidate: Candidate, chosen: Candidate) -> _Faults:
    seldom = 2 * candidate.topic.count < chosen.topic.count
    rectified = ["rect" in words_of(c.name) for c in (candidate, chosen)]
    return [
        (bool(candidate.odd), f"its name says {candidate.odd}"),
        (not candidate.same_size(chosen), f"not of the size of {chosen.name}"),
        (not candidate.same_frame(chosen), f"not in the frame of {chosen.name}"),
        (seldom, f"{candidate.topic.count} messages for {chosen.topic.count}"),
        (candidate.grey, "grey"),
        (rectified[0] != rectified[1], "rectified, or not, unlike the range"),
        *_strangeness(candidate, chosen),
        (candidate.is_compressed, "compressed"),
    ]


def _against_camera(candidate: Candidate, beside: Sequence[Candidate]) -> _Faults:
    parent = candidate.name.rpartition("/")[0] + "/"
    at = next((i for i, c in enumerate(beside) if c.name.startswith(parent)), len(beside))
    return [
        (not candidate.calibrated, "without calibration"),
        (candidate.size not in {c.size for c in beside}, "of another size"),
        (not any(candidate.same_frame(c) for c in beside), "in another frame"),
        *[(at > i, f"not beside {c.name}") for i, c in enumerate(beside)],
        *_strangeness(candidate, beside[0]),
    ]


def _strangeness(candidate: Candidate, other: Candidate) -> _Faults:
    """One fault for each of the first parts of the other's name that the candidate's does not share."""
    shared = candidate.kinship(other)
    return [(shared <= i, f"of another name than {other.name}") for i in range(other.name.count("/") + 1)]


def _explained(
    candidates: Sequence[Candidate],
    rows: Mapping[str, Sequence[tuple[Candidate, _Faults]]],
    taken: Mapping[str, Candidate | None],
    named: Mapping[str, str],
) -> list[str]:
    """A line for every topic."""
    verdicts: dict[str, list[str]] = {}
    for key, ranked in rows.items():
        best = taken[key]
        for candidate, faults in ranked:
            if candidate is best:
                why = "named" if key in named else "the only one" if len(ranked) == 1 else "the best"
                verdict = f"taken as {key}: {why}"
            else:
                verdict = f"not as {key}: {_worse(faults, ranked[0][1]) or 'after it in the alphabet'}"
                if best is None:
                    verdict = f"not as {key}: the cloud's own colour fits better"
            verdicts.setdefault(candidate.name, []).append(verdict)
    lines = []
    for c in candidates:
        size = f" {c.size[1]}x{c.size[0]}" if any(c.size) else ""
        frame = f" in {c.frame_id}" if c.frame_id else ""
        unasked = "read where two frames need them" if c.topic.type == TF_TYPE else "not used"
        found = verdicts.get(c.name) or ["only when named" if c.reserved else unasked]
        lines.append(f"{c.name}: {c.what}{size}{frame}, {c.topic.count} messages; {'; '.join(found)}")
    return lines


def _worse(faults: _Faults, best: _Faults) -> str:
    return next(
        (words for (fault, words), (other, _) in zip(faults, best, strict=True) if fault and not other), ""
    )


def _listing(candidates: Sequence[Candidate]) -> str:
    """What there is, and what to do with what is not read."""
    rows = []
    for c in candidates:
        encoding = "" if c.topic.encoding == "cdr" else f", {c.topic.encoding}"
        rows.append(f"{c.name} ({c.topic.type}, {c.topic.count}{encoding})")
    advice = "".join(f"; {c.name} is {c.advice}" for c in candidates if c.advice)
    return "it has " + (", ".join(rows) if rows else "no topic at all") + advice
