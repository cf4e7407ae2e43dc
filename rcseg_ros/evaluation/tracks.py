"""`rcseg evaluate --tracks`: how well names last, on journeys with exact truth or on recordings without."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from rcseg_core import RangeColorFrame, SegmenterConfig
from rcseg_core.errors import InputError
from rcseg_core.evaluation.tracks import LEVELS, POSES, evaluate_journey, evaluate_recording
from rcseg_core.synthetic import make_journey
from rcseg_ros.console import at_least
from rcseg_ros.evaluation.reports import write_csv
from rcseg_ros.frames.reading import DEFAULT_READING, Reading
from rcseg_ros.recordings.recorded import Source, find_sources
from rcseg_ros.recordings.staging import staged
from rcseg_ros.settings import config_yaml

METRICS = "metrics.json"
TABLE_WIDTH = 180
SYNTHETIC = "synthetic"
#: Of frames of a data set that carry no stamps of their own.
FRAME_NS = 33_333_333
LEGEND = (
    "HOTA, DetA, AssA: accuracy of tracks, of masks, of names (Luiten et al. 2021); warp: share of pixels, "
    "seen in one frame and the next, that keep their id; persist: ids of 500 px and more (at 640x480) that "
    "lie on the same pixels in the next frame; switch: truths that change their track, in brackets those "
    "above 1 % of the image; frag: truths found again; planes, points: matched_planes_ratio and "
    "matched_points_ratio of EVOPS, from frame to frame; bare: the same with labels as ids; NEES: of fused "
    "planes in the last frame, by degree of freedom"
)


@dataclass(frozen=True)
class TrackOptions:
    """Which sequences are drawn, and what the tracker is told of poses.

    Raises
    ------
    InputError
    """

    seeds: tuple[int, ...] = tuple(range(100, 110))
    frames: int = 60
    width: int = 320
    height: int = 240
    poses: tuple[str, ...] = POSES
    still: bool = False

    def __post_init__(self) -> None:
        for word in self.poses:
            if word not in POSES:
                raise InputError(f"--poses {word}: expected {', '.join(POSES)} or all")


def run_evaluate_tracks(
    dataset: str,
    *,
    config: SegmenterConfig,
    console: Console,
    warm_up: Callable[[SegmenterConfig], object] | None = None,
    output: Path | None = None,
    force: bool = False,
    options: TrackOptions | None = None,
    match: str = "*",
    reading: Reading = DEFAULT_READING,
) -> list[dict[str, Any]]:
    """Track sequences, print tables, and with `output` write metrics.json and tracks.csv.

    Parameters
    ----------
    dataset : "synthetic", or the path of a recording or of a folder of frames, which are taken in the order
        of their names

    Returns
    -------
    One row for each sequence and level.

    Raises
    ------
    InputError, ConfigError
    """
    options = options or TrackOptions()
    sources = [] if dataset == SYNTHETIC else find_sources(dataset, match, reading)
    with staged(output, force, METRICS) as stage:
        if warm_up is not None:
            warm_up(config)
        synthetic = dataset == SYNTHETIC
        rows = list(_synthetic(options, config) if synthetic else _recorded(dataset, sources, config))
        pooled = pool(rows)
        if stage is not None:
            stage.path.mkdir()
            (stage.path / "config.yaml").write_text(config_yaml(config), "utf-8")
            document = {"dataset": dataset, "options": asdict(options), "sequences": rows, "pooled": pooled}
            (stage.path / METRICS).write_text(json.dumps(document, indent=1) + "\n", "utf-8")
            write_csv(stage.path / "tracks.csv", rows)
            stage.commit()
    console = at_least(console, TABLE_WIDTH)
    for level in LEVELS:
        both = [*rows, *pooled] if len(rows) > len(pooled) else rows
        console.print(_table(level, [row for row in both if row["level"] == level]))
    console.print(LEGEND if dataset == SYNTHETIC else LEGEND.partition("; ")[2])
    return rows


def _synthetic(options: TrackOptions, config: SegmenterConfig) -> Iterator[dict[str, Any]]:
    for seed in options.seeds:
        frames = make_journey(
            options.frames, seed, width=options.width, height=options.height, still=options.still
        )
        found = evaluate_journey(frames, config, poses=options.poses, seed=seed)
        for poses, levels in found.items():
            for level, report in levels.items():
                yield {"sequence": f"journey_{seed:03d}", "poses": poses, "level": level, **report.row()}


def _recorded(dataset: str, sources: list[Source], config: SegmenterConfig) -> Iterator[dict[str, Any]]:
    number = count()

    def frames() -> Iterator[tuple[RangeColorFrame, int, None]]:
        for source in sources:
            for frame in source.read():
                yield frame.frame, next(number) * FRAME_NS, None

    report = evaluate_recording(frames(), config)
    told = ", ".join(f"{motion} {times}" for motion, times in report.motions.items())
    for level in LEVELS:
        yield {"sequence": Path(dataset).name, "poses": told, "level": level, **report.row(level)}


def pool(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means of the rows of one kind of poses and level; counts are sums."""
    pooled = []
    for poses, level in dict.fromkeys((row["poses"], row["level"]) for row in rows):
        own = [row for row in rows if (row["poses"], row["level"]) == (poses, level)]
        made: dict[str, Any] = {"sequence": "all", "poses": poses, "level": level}
        for key in own[0]:
            values = [row[key] for row in own]
            if key not in made:
                made[key] = sum(values) if isinstance(values[0], int) else _mean(values)
        pooled.append(made)
    return pooled


def _mean(values: list[float]) -> float:
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else float("nan")


COLUMNS: dict[str, Callable[[dict[str, Any]], str]] = {
    "HOTA": lambda r: f"{r['hota']:.3f}",
    "DetA": lambda r: f"{r['detection']:.3f}",
    "AssA": lambda r: f"{r['association']:.3f}",
    "warp": lambda r: f"{r['consistency']:.4f}",
    "persist": lambda r: f"{r['persistent']:.3f}",
    "switch": lambda r: f"{r['switches']} ({r['switches_large']})",
    "frag": lambda r: f"{r['fragmentations']}",
    "tracks": lambda r: f"{r['tracks']}/{r['truth_tracks']}",
    "ids": lambda r: f"{r['ids']}",
    "HOTA bare": lambda r: f"{r['hota_untracked']:.3f}",
    "warp bare": lambda r: f"{r['consistency_untracked']:.4f}",
    "switch bare": lambda r: f"{r['switches_untracked']}",
    "planes": lambda r: f"{r['matched_planes']:.3f}",
    "points": lambda r: f"{r['matched_points']:.3f}",
    "planes, points bare": lambda r: (
        f"{r['matched_planes_untracked']:.3f} {r['matched_points_untracked']:.3f}"
    ),
    "NEES": lambda r: f"{r['fused_nees']:.2f} ({r['fused_planes']})",
}


def _table(level: str, rows: list[dict[str, Any]]) -> Table:
    table = Table(title=f"Tracks of {level}s", title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("sequence", no_wrap=True)
    table.add_column("poses", no_wrap=True)
    shown = {}
    for head, cell in COLUMNS.items():
        try:
            shown[head] = [cell(row) for row in rows]
        except KeyError:  # a figure that this kind of data set does not have
            continue
        if level == "surface" or head != "NEES":
            table.add_column(head, justify="right", no_wrap=True)
        else:
            del shown[head]
    for i, row in enumerate(rows):
        table.add_row(row["sequence"], row["poses"], *(cells[i] for cells in shown.values()))
    return table
