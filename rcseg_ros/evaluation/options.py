"""What `rcseg evaluate` is asked for: scenes, levels and overlaps, and their options from text."""

from __future__ import annotations

from dataclasses import dataclass

from rcseg_core.errors import InputError
from rcseg_core.evaluation.hoover import TOLERANCES
from rcseg_core.evaluation.plane_evaluation import PLANES
from rcseg_core.synthetic import FAMILIES, SCANNER_FAMILIES

LEVELS = ("surfaces", "regions")
OBJECTS = "objects"
REPORT_SEEDS = "100-109"


@dataclass(frozen=True)
class SyntheticOptions:
    """Which scenes are drawn and how they are seen; `rcseg_core.synthetic.make_scene` explains each."""

    families: tuple[str, ...] = FAMILIES
    seeds: tuple[int, ...] = tuple(range(100, 110))
    width: int = 640
    height: int = 480
    outliers: float = 0.0
    dropout: float = 0.0
    structured_light: bool = False


@dataclass(frozen=True)
class View:
    """What is judged, at which overlap the tables show it, and whether stated errors are compared with true.

    Raises
    ------
    InputError
    """

    levels: tuple[str, ...]
    tolerance: float
    uncertainty: bool = False

    def __post_init__(self) -> None:
        if not 0.5 < self.tolerance <= 1:
            raise InputError(f"--tolerance {self.tolerance}: expected a share above 0.5 and at most 1")

    @property
    def tolerances(self) -> tuple[float, ...]:
        """The sweep, with the table's own tolerance in it."""
        return tuple(sorted({*TOLERANCES, self.tolerance}))


def parse_level(
    text: str, *, synthetic: bool, planes: bool = False, uncertainty: bool = False
) -> tuple[str, ...]:
    """What is judged: by `--labels` regions, surfaces, both, or objects, and with `--planes` recognised
    planes.

    By default regions of scenes, both of recordings, and neither where planes or errors are asked for.

    Raises
    ------
    InputError
    """
    also = (PLANES,) if planes else ()
    if text == "auto":
        return also if planes or uncertainty else ("regions",) if synthetic else LEVELS
    if text not in ("both", OBJECTS, *LEVELS):
        raise InputError(f"--labels {text}: expected regions, surfaces, both, objects or auto")
    return (LEVELS if text == "both" else (text,)) + also


def parse_seeds(text: str) -> tuple[int, ...]:
    """Seeds from `100-109`, `7` or `1,5,100-102`.

    Raises
    ------
    InputError
    """
    seeds: list[int] = []
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        if not first.isdigit() or (dash and not last.isdigit()) or (dash and int(last) < int(first)):
            raise InputError(
                f"--seeds {text}: expected numbers or ranges, for example {REPORT_SEEDS} or 1,5,9"
            )
        seeds.extend(range(int(first), int(last or first) + 1))
    return tuple(dict.fromkeys(seeds))


def parse_families(text: str, *, structured_light: bool = False) -> tuple[str, ...]:
    """Families from `room,blocks` or `all`; a structured-light camera has no scanner grids among its `all`.

    Raises
    ------
    InputError
    """
    if text == "all":
        return tuple(f for f in FAMILIES if not (structured_light and f in SCANNER_FAMILIES))
    families = tuple(part.strip() for part in text.split(","))
    for family in families:
        if family not in FAMILIES:
            raise InputError(f"--families {text}: {family!r} is none of {', '.join(FAMILIES)}")
    return families


def parse_size(text: str) -> tuple[int, int]:
    """Width and height from `640x480`.

    Raises
    ------
    InputError
    """
    width, cross, height = text.partition("x")
    if not (cross and width.isdigit() and height.isdigit()):
        raise InputError(f"--size {text}: expected WIDTHxHEIGHT in pixels, for example 640x480")
    return int(width), int(height)
