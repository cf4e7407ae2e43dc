"""`rcseg evaluate`: segment every frame of a data set, compare with its truth, and write what came out.

The data set is `synthetic` (seeds 0-99 are for tuning, 100 and up for reporting) or recorded: frames with or
without truth and recordings, mixed in one folder. An interrupted run still writes what was finished.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import chain, islice
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from rcseg_core import RangeColorFrame, Segmentation, SegmenterConfig, segment
from rcseg_core.errors import InputError
from rcseg_core.evaluation.frames import evaluate_frame, evaluate_scene
from rcseg_core.evaluation.metrics import REPORT_TOLERANCE, SceneMetrics
from rcseg_core.evaluation.plane_evaluation import PLANES, planes_of_frame, planes_of_scene
from rcseg_core.evaluation.pooling import Pooled, pool
from rcseg_core.evaluation.uncertainty import ErrorCheck, check_uncertainty, summarise
from rcseg_core.synthetic import make_scene
from rcseg_ros.evaluation.album import Album
from rcseg_ros.evaluation.options import LEVELS, OBJECTS, SyntheticOptions, View, parse_level
from rcseg_ros.evaluation.references import Reference
from rcseg_ros.evaluation.reports import plot_correct, print_report, write_csv
from rcseg_ros.evaluation.uncertainty_report import print_uncertainty
from rcseg_ros.frames.reading import DEFAULT_READING, Reading
from rcseg_ros.recordings.recorded import Source, find_sources, group_of
from rcseg_ros.recordings.segmenting import plain
from rcseg_ros.recordings.staging import staged
from rcseg_ros.settings import config_yaml

METRICS = "metrics.json"
SYNTHETIC = "synthetic"


@dataclass(frozen=True)
class Case:
    """One frame to judge: its group for pooling, its truth by level, and the judge of its result on one.

    `check` compares stated errors with the truth, where that is exact.
    """

    name: str
    group: str
    frame: RangeColorFrame
    truth: Mapping[str, NDArray[np.int32] | None]
    judge: Callable[[Segmentation, str], SceneMetrics]
    has_color: bool = True
    check: Callable[[Segmentation], list[ErrorCheck]] | None = None


@dataclass
class Report:
    """What a run found: figures by frame and level, seconds by frame, what hand-set points say, and how the
    stated errors compare with the true ones."""

    frames: list[SceneMetrics] = field(default_factory=list)
    groups: dict[str, str] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    face_faults: dict[str, list[str]] = field(default_factory=dict)
    checks: list[ErrorCheck] = field(default_factory=list)

    def add(self, case: Case, metrics: Sequence[SceneMetrics], seconds: float) -> None:
        self.frames.extend(metrics)
        self.groups[case.name] = case.group
        self.seconds[case.name] = seconds

    @property
    def levels(self) -> list[str]:
        return list(dict.fromkeys(metrics.level for metrics in self.frames))

    @property
    def pooled(self) -> list[Pooled]:
        """One entry for each level and group, in the order of appearance."""
        return [
            pool(group, [m for m in self.frames if m.level == level and self.groups[m.name] == group])
            for level in self.levels
            for group in dict.fromkeys(self.groups.values())
        ]

    def frame_rows(self, tolerance: float) -> list[dict[str, Any]]:
        """Figures of every frame and level, with milliseconds."""
        return [
            {**m.row(tolerance), "group": self.groups[m.name], "milliseconds": 1e3 * self.seconds[m.name]}
            for m in self.frames
        ]

    def pooled_rows(self, tolerance: float) -> list[dict[str, Any]]:
        """Figures of every group and level, with the median of the milliseconds."""
        return [
            {**group.row(tolerance), "milliseconds": median(self.milliseconds(group.name))}
            for group in self.pooled
        ]

    def milliseconds(self, group: str) -> list[float]:
        return [1e3 * s for name, s in self.seconds.items() if self.groups[name] == group]


def run_evaluate(
    dataset: str,
    *,
    config: SegmenterConfig,
    console: Console,
    warm_up: Callable[[SegmenterConfig], object] | None = None,
    output: Path | None = None,
    force: bool = False,
    synthetic: SyntheticOptions | None = None,
    level: str = "auto",
    tolerance: float = REPORT_TOLERANCE,
    match: str = "*",
    pictures: bool = True,
    reference: Reference | None = None,
    planes: bool = False,
    uncertainty: bool = False,
    reading: Reading = DEFAULT_READING,
) -> Report:
    """Evaluate a data set; print tables and, with `output`, write JSON, CSV, a plot, pictures and a page.

    Parameters
    ----------
    dataset : "synthetic", or the path of a frame, of a recording, or of a folder of such
    warm_up : called before the first frame, so that compiling does not count as segmenting
    output : folder to write, optional; must not exist, or with `force` be an earlier result
    level : "regions", "surfaces", "both", "objects" or "auto": the label images that are judged,
        see `parse_level`
    tolerance : overlap of Hoover's classes in the tables
    match : glob on the names of recorded frames
    pictures : False leaves the pictures and the page out
    reference : its points on faces are looked up in the surfaces of each frame
    planes : judge recognised planes by the rules of EVOPS
    uncertainty : compare stated errors with the truth of synthetic scenes
    reading : what recorded data do not tell of their units

    Raises
    ------
    InputError, ConfigError
        Before anything is segmented, as far as that can be known.
    """
    if uncertainty and dataset != SYNTHETIC:
        raise InputError(
            f"--uncertainty: {dataset} has no exact truth of its shapes; give `{SYNTHETIC}` as the data set"
        )
    levels = parse_level(level, synthetic=dataset == SYNTHETIC, planes=planes, uncertainty=uncertainty)
    view = View(levels, tolerance, uncertainty)
    if dataset == SYNTHETIC:
        options = synthetic or SyntheticOptions()
        total = len(options.families) * len(options.seeds)
        cases = _synthetic_cases(options, view)
    else:
        options = None
        sources = find_sources(dataset, match, reading)
        total = sum(source.frames for source in sources)
        cases = _recorded_cases(sources, view)
    settings = {
        "dataset": dataset,
        "levels": view.levels,
        "tolerance": tolerance,
        "match": match,
        "synthetic": options,
        "uncertainty": uncertainty,
    }
    report = Report()
    with staged(output, force, METRICS) as stage:  # a folder that cannot be written is told at once
        first = list(islice(cases, 1))  # and so is a frame that cannot be read
        if warm_up is not None:
            warm_up(config)
        run = partial(_run, chain(first, cases), total, config, view=view, report=report, reference=reference)
        if stage is None:
            run(album=None)
        else:
            stage.path.mkdir()
            (stage.path / "config.yaml").write_text(config_yaml(config), "utf-8")
            album = Album(stage.path) if pictures else None
            try:
                run(album=album)
            finally:
                if report.seconds:
                    write_report(report, stage.path, settings, config, tolerance)
                    if album is not None:
                        album.finish(report, tolerance)
                    stage.commit()
    print_report(report, console, tolerance)
    if uncertainty:
        print_uncertainty(report.checks, console)
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

            def judge(result: Segmentation, level: str, scene: Any = scene) -> SceneMetrics:
                if level == PLANES:
                    return planes_of_scene(scene, result)
                return evaluate_scene(scene, result, level=level, tolerances=view.tolerances)

            truth = {
                "regions": scene.labels, "surfaces": scene.surface_labels, OBJECTS: scene.object_labels,
            }  # fmt: skip
            check = partial(check_uncertainty, scene) if view.uncertainty else None
            yield Case(f"{family}_{seed:03d}", family, scene.frame, truth, judge, check=check)


def _recorded_cases(sources: Sequence[Source], view: View) -> Iterator[Case]:
    for source in sources:
        for frame in source.read():

            def judge(result: Segmentation, level: str, frame: Any = frame) -> SceneMetrics:
                if level == PLANES:
                    return planes_of_frame(frame, result)
                return evaluate_frame(frame, result, level=level, tolerances=view.tolerances)

            truth = {level: frame.truth_of(level) for level in (*LEVELS, OBJECTS)}
            yield Case(frame.name, group_of(frame.name), frame.frame, truth, judge, frame.has_color)


def _run(
    cases: Iterator[Case],
    total: int,
    config: SegmenterConfig,
    album: Album | None,
    view: View,
    report: Report,
    reference: Reference | None,
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
            metrics = [case.judge(result, level) for level in view.levels]
            report.add(case, metrics, seconds)
            if case.check is not None:
                report.checks.extend(case.check(result))
            if reference is not None:
                report.face_faults[case.name] = reference.face_faults(case.name, result.surface_labels)
            if album is not None:
                album.add(case, result, metrics, view.tolerance)
            bar.advance(task)


def write_report(
    report: Report, folder: Path, settings: dict[str, Any], config: SegmenterConfig, tolerance: float
) -> None:
    """metrics.json, frames.csv, pooled.csv; where they have something to say correct.png, uncertainty.csv."""
    frames, pooled = report.frame_rows(tolerance), report.pooled_rows(tolerance)
    document = {
        "settings": settings,
        "config": config.to_dict(),
        "pooled": pooled,
        "correct_over_tolerance": {
            level: {
                group.name: {f"{t:g}": group.correct(t) for t in group.counts}
                for group in report.pooled
                if group.counts and group.level == level
            }
            for level in report.levels
        },
        "frames": frames,
        "blobs": {m.name: m.blobs for m in report.frames if m.blobs},
        "face_faults": {name: faults for name, faults in report.face_faults.items() if faults},
    }
    if settings["uncertainty"]:
        document["uncertainty"] = {"pooled": summarise(report.checks), "checks": report.checks}
        write_csv(folder / "uncertainty.csv", summarise(report.checks))
    (folder / METRICS).write_text(json.dumps(plain(document), indent=1) + "\n", "utf-8")
    write_csv(folder / "frames.csv", frames)
    write_csv(folder / "pooled.csv", pooled)
    if any(group.counts for group in report.pooled):
        plot_correct(folder / "correct.png", report.pooled)
