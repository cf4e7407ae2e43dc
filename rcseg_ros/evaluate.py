"""`rcseg evaluate`: segment every frame of a data set, compare with its truth, and write what came out.

The data set is `synthetic` (seeds 0-99 are for tuning, 100 and up for reporting) or a folder of recorded
frames. An interrupted run still writes the frames that were finished.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from rcseg_core import RangeColorFrame, Segmentation, SegmenterConfig, segment
from rcseg_core.datasets import find_frames, load_frame
from rcseg_core.drawing import contact_sheet, depth_picture, edges_picture, labels_picture, overlay, write_png
from rcseg_core.errors import InputError
from rcseg_core.evaluation import choose_labels, evaluate_frame, evaluate_scene
from rcseg_core.hoover import TOLERANCES
from rcseg_core.metrics import REPORT_TOLERANCE, SceneMetrics
from rcseg_core.pooling import Pooled, pool
from rcseg_core.synthetic import FAMILIES, SCANNER_FAMILIES, make_scene
from rcseg_ros.reports import plot_correct, print_report, write_csv
from rcseg_ros.segmenting import plain
from rcseg_ros.settings import config_yaml
from rcseg_ros.staging import StagedFolder

METRICS = "metrics.json"
SYNTHETIC = "synthetic"
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
    """What is judged and at which overlap the tables show it.

    Raises
    ------
    InputError
    """

    level: str
    tolerance: float

    def __post_init__(self) -> None:
        if self.level not in ("regions", "surfaces"):
            raise InputError(f"--labels {self.level}: expected regions or surfaces")
        if not 0.5 < self.tolerance <= 1:
            raise InputError(f"--tolerance {self.tolerance}: expected a share above 0.5 and at most 1")

    @property
    def tolerances(self) -> tuple[float, ...]:
        """The sweep, with the table's own tolerance in it."""
        return tuple(sorted({*TOLERANCES, self.tolerance}))


@dataclass(frozen=True)
class Case:
    """One frame to judge: its group for pooling, and the functions that need its result."""

    name: str
    group: str
    frame: RangeColorFrame
    truth: Any
    judge: Callable[[Segmentation], SceneMetrics]


@dataclass
class Report:
    """What a run found: figures by frame and pooled, and seconds by frame."""

    frames: list[SceneMetrics] = field(default_factory=list)
    groups: list[str] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def add(self, case: Case, metrics: SceneMetrics, seconds: float) -> None:
        self.frames.append(metrics)
        self.groups.append(case.group)
        self.seconds.append(seconds)

    @property
    def pooled(self) -> list[Pooled]:
        """One entry for each group, in the order of appearance."""
        return [
            pool(name, [m for m, group in zip(self.frames, self.groups, strict=True) if group == name])
            for name in dict.fromkeys(self.groups)
        ]

    def milliseconds(self, group: str) -> list[float]:
        return [1e3 * s for s, name in zip(self.seconds, self.groups, strict=True) if name == group]


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


def run_evaluate(
    dataset: str,
    *,
    config: SegmenterConfig,
    console: Console,
    warm_up: Callable[[SegmenterConfig], object] | None = None,
    output: Path | None = None,
    force: bool = False,
    synthetic: SyntheticOptions | None = None,
    level: str = "regions",
    tolerance: float = REPORT_TOLERANCE,
    match: str = "*",
    pictures: bool = True,
) -> Report:
    """Evaluate a data set; print tables and, with `output`, write JSON, CSV, a plot and one picture a frame.

    Parameters
    ----------
    dataset : "synthetic", or the path of a frame or of a folder of frames
    warm_up : called before the first frame, so that compiling does not count as segmenting
    output : folder to write, optional; must not exist, or with `force` be an earlier result
    level : "regions" or "surfaces": the label image that is judged
    tolerance : overlap of Hoover's classes in the tables
    match : glob on the names of recorded frames
    pictures : False leaves the pictures out

    Raises
    ------
    InputError, ConfigError
        Before anything is segmented, as far as that can be known.
    """
    view = View(level, tolerance)
    if dataset == SYNTHETIC:
        options = synthetic or SyntheticOptions()
        total = len(options.families) * len(options.seeds)
        cases = _synthetic_cases(options, view)
    else:
        options = None
        total = len(find_frames(dataset, match))
        cases = _recorded_cases(dataset, match, view)
    settings = {
        "dataset": dataset,
        "level": level,
        "tolerance": tolerance,
        "match": match,
        "synthetic": options,
    }
    if warm_up is not None:
        warm_up(config)
    report = Report()
    if output is None:
        _run(cases, total, config, None, view, report)
    else:
        with StagedFolder(output, force, METRICS) as stage:
            folder = stage.path / "pictures" if pictures else stage.path
            folder.mkdir(parents=True)
            (stage.path / "config.yaml").write_text(config_yaml(config), "utf-8")
            try:
                _run(cases, total, config, folder if pictures else None, view, report)
            finally:
                if report.frames:
                    write_report(report, stage.path, settings, config, tolerance)
                    stage.commit()
    print_report(report, console, tolerance)
    return report


def _synthetic_cases(options: SyntheticOptions, view: View) -> Iterator[Case]:
    for family in options.families:
        for seed in options.seeds:
            scene = make_scene(
                family,
                seed,
                width=options.width,
                height=options.height,
                outliers=options.outliers,
                dropout=options.dropout,
                structured_light=options.structured_light,
            )

            def judge(result: Segmentation, scene: Any = scene) -> SceneMetrics:
                return evaluate_scene(scene, result, level=view.level, tolerances=view.tolerances)

            truth = scene.labels if view.level == "regions" else scene.surface_labels
            yield Case(f"{family}_{seed:03d}", family, scene.frame, truth, judge)


def _recorded_cases(dataset: str, match: str, view: View) -> Iterator[Case]:
    for name, path in find_frames(dataset, match):
        frame = load_frame(path, name=name)

        def judge(result: Segmentation, frame: Any = frame) -> SceneMetrics:
            return evaluate_frame(frame, result, level=view.level, tolerances=view.tolerances)

        group = "without truth" if frame.truth is None else frame.kind
        yield Case(name, group, frame.frame, frame.truth, judge)


def _run(
    cases: Iterator[Case],
    total: int,
    config: SegmenterConfig,
    pictures: Path | None,
    view: View,
    report: Report,
) -> None:
    screen = Console(stderr=True)
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=screen,
        transient=True,
        disable=not screen.is_terminal,
    )
    with bar:
        task = bar.add_task("evaluating", total=total)
        for case in cases:
            bar.update(task, description=case.name)
            start = perf_counter()
            result = segment(case.frame, config)
            seconds = perf_counter() - start
            report.add(case, case.judge(result), seconds)
            if pictures is not None:
                path = pictures / (case.name.replace("/", "_") + ".png")
                write_png(path, frame_picture(case, result, report.frames[-1], view))
            bar.advance(task)


def frame_picture(case: Case, result: Segmentation, metrics: SceneMetrics, view: View) -> Any:
    """Image, depth, edges, labels, surfaces, reconstruction and truth side by side, RGB."""
    points, color = result.reconstruct()
    depth_m = case.frame.depth_m
    panels = [
        (case.name, case.frame.color),
        ("depth", depth_picture(depth_m)),
        ("edges: depth red, orientation green, colour blue", edges_picture(result.edges)),
        ("reconstructed colour", color),
        (f"regions: {len(result.regions)}", labels_picture(result.labels)),
        (f"surfaces: {int(result.surface_labels.max())}", labels_picture(result.surface_labels)),
        (_summary(metrics, view.tolerance), overlay(case.frame.color, choose_labels(result, view.level))),
        ("reconstructed depth", depth_picture(points[..., 2])),
    ]
    if case.truth is not None:
        panels.append(("truth", labels_picture(case.truth)))
    return contact_sheet(panels, columns=4 if case.truth is None else 5)


def _summary(metrics: SceneMetrics, tolerance: float) -> str:
    if metrics.labels is not None:
        result = metrics.labels.at(tolerance)
        return f"{result.correct} of {result.truth_regions} correct, {result.noise} noise"
    if metrics.parts is not None:
        return f"{metrics.parts.parts_per_object:.1f} parts, best IoU {metrics.parts.best_iou:.2f}"
    return f"{metrics.regions} regions"


def write_report(
    report: Report, folder: Path, settings: dict[str, Any], config: SegmenterConfig, tolerance: float
) -> None:
    """metrics.json, frames.csv, pooled.csv and, where there is region truth, correct.png."""
    pooled = report.pooled
    frames = [
        {**metrics.row(tolerance), "milliseconds": 1e3 * seconds}
        for metrics, seconds in zip(report.frames, report.seconds, strict=True)
    ]
    document = {
        "settings": settings,
        "config": config.to_dict(),
        "pooled": [group.row(tolerance) for group in pooled],
        "correct_over_tolerance": {
            group.name: {f"{t:g}": group.correct(t) for t in group.counts} for group in pooled if group.counts
        },
        "frames": frames,
    }
    (folder / METRICS).write_text(json.dumps(plain(document), indent=1) + "\n", "utf-8")
    write_csv(folder / "frames.csv", frames)
    write_csv(folder / "pooled.csv", [group.row(tolerance) for group in pooled])
    if any(group.counts for group in pooled):
        plot_correct(folder / "correct.png", pooled)
