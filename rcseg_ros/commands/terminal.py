"""What the command line shows: progress with frames a second, and the tables at the end."""

from __future__ import annotations

import math
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from rcseg_core import Segmentation, SegmenterConfig
from rcseg_core.calibration.views import SURFACES
from rcseg_core.config import describe
from rcseg_core.errors import InputError
from rcseg_ros.bench.report import BENCH, print_bench, write_bench
from rcseg_ros.bench.run import BenchOptions
from rcseg_ros.bench.run import run_bench as bench
from rcseg_ros.commands.calibrate import Calibrated, CalibrateRequest, calibrate_recording
from rcseg_ros.commands.replay import ReplayRequest, ReplaySummary, replay
from rcseg_ros.commands.view import Viewer, ViewRequest, has_to_segment, view
from rcseg_ros.commands.viewers import FoxgloveViewer, PageViewer
from rcseg_ros.console import at_least
from rcseg_ros.evaluation.references import Reference, write_reference
from rcseg_ros.recordings.staging import StagedFolder
from rcseg_ros.settings import bounds
from rcseg_ros.warmup import compiled, fill_cache, warm_up

if TYPE_CHECKING:
    from rcseg_ros.evaluation.evaluate import Report

INTERRUPTED = 130  # exit code after Ctrl-C
CALIBRATION_WIDTH = 100
LOG_EVERY_S = 5.0  # progress where there is no terminal
CONSOLE = Console(highlight=False)
_PROGRESS = Console(stderr=True)


def prepare(config: SegmenterConfig) -> None:
    """Compile or load the kernels; tell when it takes long."""
    warm_up(config, lambda text: CONSOLE.print(text))


def run_warmup() -> None:
    """Fill the cache of compiled kernels; tell how far it is, how long it took and where it lies."""
    start = perf_counter()
    with _beats() as at:
        try:
            kept = fill_cache(at)
        except KeyboardInterrupt:
            CONSOLE.print(f"{len(compiled())} kernels compiled and kept; the next run goes on from there")
            raise
    number, seconds = len(compiled()), perf_counter() - start
    what = f"{_count(number, 'kernel')} compiled" if number else "nothing to compile, all was there"
    CONSOLE.print(f"{what}, in {seconds:.1f} s")
    CONSOLE.print(f"{kept.megabytes:.1f} MB kept in {kept.folder}", soft_wrap=True)
    CONSOLE.print("They stay until rcseg, Numba or Python is updated, or the processor is another.")


@contextmanager
def _beats() -> Iterator[Callable[[str, int, int], None]]:
    """Take what comes next in a warm-up, and tell it again and again: one case may take a minute."""
    start, over = perf_counter(), threading.Event()
    case = ("", 0, 1)

    def at(*given: Any) -> None:
        nonlocal case
        case = given

    def tell() -> None:
        every_s = 0.5 if _PROGRESS.is_terminal else LOG_EVERY_S
        while not over.wait(every_s):
            name, done, total = case
            text = (
                f"{name} ({done + 1} of {total}), {perf_counter() - start:.0f} s, {len(compiled())} kernels"
            )
            if _PROGRESS.is_terminal:
                status.update(text)
            else:
                _PROGRESS.print(f"compiling: {text}", soft_wrap=True)

    with _PROGRESS.status("compiling", spinner="line") as status:
        teller = threading.Thread(target=tell, daemon=True)
        teller.start()
        try:
            yield at
        finally:
            over.set()
            teller.join()


def run_replay(request: ReplayRequest, verbose: bool = False) -> int:
    """Replay with a progress bar and a table; return the exit code."""
    explain = _explain if verbose else lambda line: None
    with _progress_bar(request.bag.name) as on_frame:
        summary = replay(request, on_frame, explain, prepare)
    for warning in summary.warnings:
        print(f"rcseg: warning: {warning}", file=sys.stderr)
    if summary.frames:
        CONSOLE.print(_summary_table(summary))
        CONSOLE.print(_notes(request, summary), soft_wrap=True)
    if summary.interrupted:
        return INTERRUPTED
    if summary.damage:
        saved = f"{_count(len(summary.frames), 'frame')} before it written to {request.output}"
        raise InputError(f"{'; '.join(summary.damage)}; {saved}")
    return 0


def run_calibrate(request: CalibrateRequest) -> int:
    """Measure a sensor with a progress bar and a table; return the exit code."""
    with _progress_bar(request.bag.name) as on_frame:
        done = calibrate_recording(request, on_frame, lambda: prepare(SURFACES))
    if done is None:
        return INTERRUPTED
    at_least(CONSOLE, CALIBRATION_WIDTH).print(_calibration_table(done))
    CONSOLE.print(_calibration_notes(request, done), soft_wrap=True)
    if done.damage:
        raise InputError(f"{'; '.join(done.damage)}; what came before it is in {request.output}")
    return INTERRUPTED if done.interrupted else 0


def _calibration_table(done: Calibrated) -> Table:
    """Standard deviations of one pixel by depth; a dash where a part was not measured."""
    table = Table(title="range error of one pixel, mm; in brackets % of depth", title_justify="left")
    parts = ("white", "correlated", "systematic", "temporal", "fixed")
    for name in ("depth \\[m]", "pixels", "random", *parts):
        table.add_column(name, justify="right", no_wrap=True)
    for one in done.found.bins:
        values = (getattr(one, part) for part in parts)
        table.add_row(
            f"{one.depth_m:.2f}",
            str(one.pixels),
            f"{1e3 * one.random:.2f} ({100 * one.random / one.depth_m:.2f})",
            *("-" if math.isnan(x) else f"{1e3 * x:.2f}" for x in values),
        )
    return table


def _calibration_notes(request: CalibrateRequest, done: Calibrated) -> str:
    found = done.found
    a, b, c = found.law
    lines = [
        "random = white and correlated; fixed = all that does not change from frame to frame",
        f"law of one pixel: sigma = {a:.3g} + {b:.3g} w + {c:.3g} w^2 of inverse depth w, in 1/m",
        f"{found.correlation:.1f} px make one measurement; systematic {found.systematic:.2f} sigma, the bend "
        f"over the image {found.bend:.2f} sigma rms",
        found.how,
    ]
    if found.static_frames:
        lines.insert(
            3,
            f"from frame to frame: {found.temporal:.2f} sigma, {found.temporal_correlation:.1f} px make one "
            "measurement",
        )
    if found.one_depth:
        lines.append("all is at about one depth: the law is taken as constant in inverse depth")
    if done.unusable:
        lines.append(f"{_count(done.unusable, 'frame')} could not be used, the first: {done.first_error}")
    lines.append(f"written to {request.output}, picture in {request.picture}")
    return "\n".join(lines)


def _explain(line: str) -> None:
    CONSOLE.print(line, soft_wrap=True, markup=False)


def report_faults(report: Report, reference: Reference | None, check: Path | None, renew: Path | None) -> int:
    """Say where an evaluation is worse than its reference, and renew the file; return the exit code."""
    faults = {} if reference is None else reference.faults(report)
    for name, texts in faults.items():
        for text in texts:
            CONSOLE.print(f"{name}: {text}", soft_wrap=True)
    if check is not None and not faults:
        CONSOLE.print(f"Nothing is worse than {check} says.")
    if renew is not None:
        write_reference(renew, report)
        CONSOLE.print(f"Figures written to {renew}.")
    return 1 if check is not None and faults else 0


def run_view(request: ViewRequest, host: str, port: int, foxglove_port: int | None) -> int:
    """Serve the views until Ctrl-C, or until the recording has been shown once; return the exit code."""
    segments = request.bag is not None and has_to_segment(request)
    viewers: list[Viewer] = [PageViewer(host, port)]
    try:
        if foxglove_port is not None:
            viewers.append(FoxgloveViewer(host, foxglove_port, request.node))
        if segments:
            prepare(request.config)
        for viewer in viewers:
            CONSOLE.print(f"Serving {viewer.address}", highlight=True)
        CONSOLE.print("Ctrl-C ends it")
        view(request, viewers, lambda text: _PROGRESS.print(text, soft_wrap=True))
    except KeyboardInterrupt:
        pass  # the way to end a view
    finally:
        for viewer in viewers:
            viewer.close()
    return 0


def run_bench(options: BenchOptions, config: SegmenterConfig, output: Path | None, force: bool) -> None:
    """Measure, print tables and, with `output`, write files and plots there."""
    with ExitStack() as stack:
        stage = stack.enter_context(StagedFolder(output, force, BENCH)) if output is not None else None
        with _PROGRESS.status("measuring", spinner="line") as status:
            report = bench(options, config, status.update, prepare)
        print_bench(report, CONSOLE)
        if stage is not None:
            stage.path.mkdir()
            write_bench(report, stage.path)
            stage.commit()
            CONSOLE.print(f"figures and plots in {output}", soft_wrap=True)


@contextmanager
def _progress_bar(name: str) -> Iterator[Callable[[int, int], None]]:
    """A bar with frames a second and the time left, on a terminal; nothing elsewhere."""
    if not _PROGRESS.is_terminal:
        yield lambda done, total: None
        return
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]} frames/s, left"),
        TimeRemainingColumn(),
        console=_PROGRESS,
        transient=True,
    ) as progress:
        task = progress.add_task(name, total=None, rate="-")

        def on_frame(done: int, total: int) -> None:
            rate = progress.tasks[task].speed or 0.0
            progress.update(task, completed=done, total=total, rate=f"{rate:.1f}")

        yield on_frame


def _summary_table(summary: ReplaySummary) -> Table:
    frames = summary.frames
    table = Table(title=_count(len(frames), "frame"), title_justify="left")
    columns = {"median": median, "least": min, "most": max} if len(frames) > 1 else {"": max}
    table.add_column("")
    for name in columns:
        table.add_column(name, justify="right")

    def row(name: str, values: Iterable[float | None], form: str) -> None:
        known = [value for value in values if value is not None]
        if known:
            table.add_row(name, *(form.format(summarize(known)) for summarize in columns.values()))

    row("regions", (f["regions"] for f in frames), "{:.0f}")
    row("surfaces", (f["surfaces"] for f in frames), "{:.0f}")
    row("pixels with range", (f["valid_share"] for f in frames), "{:.1%}")
    row("pixels in regions", (f["labelled_share"] for f in frames), "{:.1%}")
    for stage in frames[0]["stages_ms"]:
        row(f"{stage} \\[ms]", (f["stages_ms"].get(stage) for f in frames), "{:.1f}")
    row("segment, all stages \\[ms]", (f["segment_ms"] for f in frames), "{:.1f}")
    for kind in sorted({kind for f in frames for kind in f.get("truth", {})}):
        judged = [f["truth"][kind] for f in frames if kind in f.get("truth", {})]
        row(
            f"correct of truth, {kind}", (t["correct"] / max(t["truth_regions"], 1) for t in judged), "{:.1%}"
        )
        row(f"variation of information, {kind} \\[bit]", (t["voi_bits"] for t in judged), "{:.3f}")
    return table


def _notes(request: ReplayRequest, summary: ReplaySummary) -> str:
    inputs = summary.inputs
    sources = [inputs.range, inputs.color or "its own colour", inputs.camera_info or "no camera_info"]
    lost = [f"{count} {reason}" for reason, count in (summary.rejected + summary.dropped).items()]
    lines = [
        f"from {', '.join(sources)}",
        *(f"camera: {how}" for how in summary.geometries),
        _rate(summary),
        f"left out: {', '.join(lost)}" if lost else "nothing left out",
        f"results in {request.output}",
    ]
    if summary.gap:
        lines.insert(3, f"frames without colour: {summary.gap}")
    if summary.first_error:
        lines.insert(3, f"first rejected frame: {summary.first_error}")
    return "\n".join(lines)


def _rate(summary: ReplaySummary) -> str:
    rate, most = summary.frames_per_second, summary.segment_only_per_second
    workers = _count(summary.workers, "worker")
    return (
        f"{rate:.1f} frames/s with reading and writing, {rate / most:.0%} of the {most:.1f} that {workers} "
        "could reach with segment() alone"
    )


def print_regions(result: Segmentation, folder: Path) -> None:
    """One line on what was found and where it is."""
    surfaces = int(result.surface_labels.max(initial=0))
    CONSOLE.print(
        f"{len(result.regions)} regions on {surfaces} surfaces; written to {folder}", soft_wrap=True
    )


def print_config(config: SegmenterConfig) -> None:
    """Every parameter as a table."""
    table = Table(show_lines=False)
    for name in ("parameter", "value", "default", "bounds and unit", "symbol", "meaning"):
        table.add_column(name, overflow="fold", no_wrap=name == "parameter")
    for parameter in describe(config):
        changed = parameter.value != parameter.default
        value = f"[bold]{_text(parameter.value)}[/bold]" if changed else _text(parameter.value)
        cells = (value, _text(parameter.default), bounds(parameter), parameter.symbol, parameter.doc)
        table.add_row(parameter.key, *cells)
    CONSOLE.print(table)


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _text(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
