"""What the shell offers after TAB for options whose values are words; plain words need no import."""

from __future__ import annotations

from collections.abc import Callable, Iterable

RANGE_FROM = ("auto", "points", "depth")
IMAGES = ("auto", "raw", "rectified")
RUNNERS = ("local", "ray")
LEVELS = ("auto", "regions", "surfaces", "both", "objects")
UP = ("floor", "imu", "imu:", "tf:")
TOPIC_KEYS = ("range=", "color=", "camera_info=", "range_camera_info=")


def one_of(words: Iterable[str]) -> Callable[[str], list[str]]:
    """Completion of one word of these."""

    def complete(incomplete: str) -> list[str]:
        return [word for word in words if word.startswith(incomplete)]

    return complete


def some_of(words: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """Completion of the last of several words with commas between, each at most once."""

    def complete(incomplete: str) -> list[str]:
        before, comma, last = incomplete.rpartition(",")
        taken = before.split(",")
        return [before + comma + word for word in words() if word.startswith(last) and word not in taken]

    return complete


def parameters(incomplete: str) -> list[str]:
    """Completion of KEY=VALUE: keys of parameters, and values of those that are words."""
    from rcseg_core.config import SegmenterConfig, describe

    key, equals, value = incomplete.partition("=")
    known = describe(SegmenterConfig())
    if not equals:
        return [f"{one.key}=" for one in known if one.key.startswith(key)]
    words = next((one.choices for one in known if one.key == key), None) or ()
    return [f"{key}={word}" for word in words if word.startswith(value)]


def outputs() -> tuple[str, ...]:
    """Words of --outputs."""
    from rcseg_ros.recordings.segmenting import CLOUDS, OUTPUTS

    return ("usual", "all", *OUTPUTS, *CLOUDS)


def families() -> tuple[str, ...]:
    """Words of --families."""
    from rcseg_core.synthetic import FAMILIES

    return ("all", *FAMILIES)


def poses() -> tuple[str, ...]:
    """Words of --poses."""
    from rcseg_core.evaluation.tracks import POSES

    return ("all", *POSES)
