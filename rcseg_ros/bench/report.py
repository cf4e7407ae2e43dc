"""What a bench leaves: tables on the screen, bench.json, bench.csv, bench.md, stages.png and pixels.png."""

from __future__ import annotations

import json
from collections.abc import Sequence
from math import isnan
from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from rcseg_core.evaluation.metrics import REPORT_TOLERANCE
from rcseg_ros.bench.run import FRAME, REGIONS, SEGMENT, VGA_PIXELS, BenchReport, Group
from rcseg_ros.console import at_least
from rcseg_ros.evaluation.reports import write_csv
from rcseg_ros.recordings.segmenting import plain

BENCH = "bench.json"
TABLE_WIDTH = 150


def write_bench(report: BenchReport, folder: Path) -> None:
    """All figures as JSON, the rows as CSV too, a table for a document, and two plots."""
    (folder / BENCH).write_text(json.dumps(plain(report.document()), indent=1) + "\n", "utf-8")
    write_csv(folder / "bench.csv", [row for group in report.groups for row in group.rows()])
    tables = [markdown(report), presets_markdown(report)]
    (folder / "bench.md").write_text("\n".join(filter(None, tables)), "utf-8")
    plot_stages(folder / "stages.png", near_vga(report.groups))
    plot_pixels(folder / "pixels.png", report.groups)


def near_vga(groups: Sequence[Group]) -> list[Group]:
    """Of each family the size that is nearest to 640x480."""
    chosen = {}
    for name in dict.fromkeys(group.name for group in groups):
        sizes = {(g.width, g.height): abs(g.pixels - VGA_PIXELS) for g in groups if g.name == name}
        chosen[name] = min(sizes, key=lambda size: sizes[size])
    return [g for g in groups if (g.width, g.height) == chosen[g.name]]


def print_bench(report: BenchReport, console: Console) -> None:
    """Whole frames and peers; stages; fresh processes; growth."""
    console = at_least(console, TABLE_WIDTH)
    machine = report.machine
    console.print(
        f"{machine['processor']}, {machine['cores']} cores, load before {machine['load_before']:.2f}; "
        f"Python {machine['python']}, numpy {machine['numpy']}, Numba {machine['numba']}, "
        f"OpenCV {machine['opencv']}"
    )
    console.print(_wholes(report))
    console.print(_stages(near_vga(report.groups)))
    if report.presets:
        console.print(_presets(report))
    if any(group.probe for group in report.groups):
        console.print(_fresh(report))
    for threads in report.options.threads:
        for name, growth in report.growth(threads).items():
            console.print(
                f"{name}, threads {threads}: from 320x240 up the time grows as the pixels x {growth:.2f}"
            )
    if len(report.options.threads) > 1:
        frames = ", ".join(report.differing)
        console.print(f"labels differ by threads: {frames}" if frames else "labels: the same by all threads")


def markdown(report: BenchReport) -> str:
    """The table of whole frames and peers, as docs/performance.md shows it."""
    peers = list(dict.fromkeys(peer for group in report.groups for peer in group.peers))
    heads = [
        "frames",
        "size",
        "threads",
        "n",
        SEGMENT,
        "with regions",
        "Python calls",
        *peers,
        "MB added",
        "start to labels, s",
    ]
    lines = [heads, ["---"] * 3 + ["---:"] * (len(heads) - 3)]
    for group in report.groups:
        cells = [*_name(group), str(group.frames), _spread(group, SEGMENT), _spread(group, FRAME)]
        cells.append(_calls(group))
        for peer in peers:
            ran = peer in group.ratios
            cells.append(f"{group.median(peer):.1f}, x{group.ratio(peer):.2f}" if ran else "")
        probe = group.probe
        cells += (
            [f"{probe['memory_added_mb']:.0f}", f"{probe['start_to_labels_s']:.2f}"] if probe else ["", ""]
        )
        lines.append(cells)
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def presets_markdown(report: BenchReport) -> str:
    """The table of the presets, as docs/performance.md shows it; empty where none were compared."""
    if not report.presets:
        return ""
    heads, rows = _preset_cells(report)
    lines = [heads, ["---"] * 3 + ["---:"] * (len(heads) - 3), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _preset_cells(report: BenchReport) -> tuple[list[str], list[list[str]]]:
    """Heads and rows of the presets: time, the multiple of the first peer, accuracy."""
    peer = next((peer for group in report.groups for peer in group.peers), "a peer")
    tolerance = f"correct at {REPORT_TOLERANCE:.0%}"
    heads = ["preset", "frames", "size", "n", "segment(), ms", f"of {peer}", tolerance, "noise regions"]
    rows = []
    for found in (row.row() for row in report.presets):
        share = "" if found["correct"] is None else f"{found['correct']:.3f} of {found['truth_regions']}"
        rows.append(
            [
                found["preset"], found["group"], f"{found['width']}x{found['height']}", str(found["frames"]),
                f"{found['median_ms']:.1f} ({found['p95_ms']:.1f})",
                "" if found["ratio"] is None else f"x{found['ratio']:.2f}",
                share,
                "" if found["noise_regions"] is None else str(found["noise_regions"]),
            ]
        )  # fmt: skip
    return heads, rows


def _presets(report: BenchReport) -> Table:
    heads, rows = _preset_cells(report)
    table = _table("Presets: median (p95), and accuracy of the regions", heads[:3], heads[3:])
    for cells in rows:
        table.add_row(*cells)
    return table


def _calls(group: Group) -> str:
    return f"{np.median(group.calls):.0f}" if group.calls else ""


def _wholes(report: BenchReport) -> Table:
    peers = list(dict.fromkeys(peer for group in report.groups for peer in group.peers))
    title = "Milliseconds a frame: median (p95); of peers the median, and segment() as a multiple of it"
    heads = (SEGMENT, "with regions", "Python calls", *peers)
    table = _table(title, ("frames", "size", "threads", "n"), heads)
    for group in report.groups:
        cells = [_spread(group, SEGMENT), _spread(group, FRAME), _calls(group)]
        for peer in peers:
            ran = peer in group.ratios
            cells.append(f"{group.median(peer):.1f}  x{group.ratio(peer):.2f}" if ran else "")
        table.add_row(*_name(group), str(group.frames), *cells)
    return table


def _spread(group: Group, what: str) -> str:
    (row,) = (r for r in group.rows() if r["what"] == what)
    return f"{row['median_ms']:.1f} ({row['p95_ms']:.1f})"


def _stages(groups: Sequence[Group]) -> Table:
    heads = [f"{g.name} {g.width}x{g.height} t{g.threads}" for g in groups]
    table = _table("Milliseconds by stage: medians (t: threads)", ("stage",), heads)
    for stage in _stage_names(groups):
        cells = [f"{g.median(stage):.1f}" if stage in g.stages else "" for g in groups]
        table.add_row(stage, *cells)
    return table


def _fresh(report: BenchReport) -> Table:
    title = "One frame in a fresh process, kernels from the cache: seconds, and peak memory above the imports"
    heads = ("start to labels", "import", "1st segment()", "2nd segment()", "MB added", "MB before")
    keys = (
        "start_to_labels_s",
        "import_s",
        "first_segment_s",
        "second_segment_s",
        "memory_added_mb",
        "memory_before_mb",
    )
    table = _table(title, ("frames", "size"), heads)
    rows = [(_name(group)[:2], group.probe) for group in report.groups if group.probe]
    if report.cold:
        rows.append((("empty cache", ""), report.cold))
    for names, figures in rows:
        seconds = [f"{figures[key]:.2f}" for key in keys[:4]]
        megabytes = ["" if isnan(figures[key]) else f"{figures[key]:.0f}" for key in keys[4:]]
        table.add_row(*names, *seconds, *megabytes)
    return table


def _name(group: Group) -> tuple[str, str, str]:
    return group.name, f"{group.width}x{group.height}", str(group.threads)


def _table(title: str, names: Sequence[str], figures: Sequence[str]) -> Table:
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for name in names:
        table.add_column(name, no_wrap=True)
    for head in figures:
        table.add_column(head, justify="right")
    return table


def _stage_names(groups: Sequence[Group]) -> list[str]:
    names = list(dict.fromkeys(stage for group in groups for stage in group.stages))
    return [*(name for name in names if name != REGIONS), REGIONS]


def plot_stages(path: Path, groups: Sequence[Group]) -> None:
    """One bar a group, one piece a stage: medians, which add up to about the whole."""
    import matplotlib
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 1.6 + 0.45 * len(groups)), layout="constrained")
    axes = figure.subplots()
    heads = [f"{g.name} {g.width}x{g.height}, {g.threads} thread{'s' * (g.threads > 1)}" for g in groups]
    left = [0.0] * len(groups)
    colors = matplotlib.colormaps["tab20"].colors  # type: ignore[attr-defined]
    for i, stage in enumerate(_stage_names(groups)):
        widths = [g.median(stage) if stage in g.stages else 0.0 for g in groups]
        axes.barh(heads, widths, left=left, label=stage, color=colors[i % len(colors)])
        left = [a + b for a, b in zip(left, widths, strict=True)]
    axes.invert_yaxis()
    axes.set(xlabel="milliseconds a frame (medians by stage)")
    figure.legend(loc="outside right upper", fontsize="small")
    figure.savefig(path, dpi=120)


def plot_pixels(path: Path, groups: Sequence[Group]) -> None:
    """segment() over pixels, one line a family and number of threads; peers on the first family dotted."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 5), layout="constrained")
    axes = figure.subplots()
    most = max(group.threads for group in groups)
    colors = {name: f"C{i}" for i, name in enumerate(dict.fromkeys(g.name for g in groups))}
    for name, threads in dict.fromkeys((g.name, g.threads) for g in groups):
        mine = sorted((g for g in groups if (g.name, g.threads) == (name, threads)), key=lambda g: g.pixels)
        style = "o-" if threads == most else "o--"
        label = f"{name}, threads {threads}"
        times = [g.median(SEGMENT) for g in mine]
        axes.plot([g.pixels for g in mine], times, style, color=colors[name], label=label)
        if name == groups[0].name and threads == most:
            for i, peer in enumerate(dict.fromkeys(peer for g in mine for peer in g.peers)):
                points = [(g.pixels, g.median(peer)) for g in mine if peer in g.peers]
                axes.plot(
                    *zip(*points, strict=True), "v^sd"[i % 4] + ":", color="0.5", label=f"{peer}, {name}"
                )
    first = min(groups, key=lambda g: g.pixels)
    ends = [first.pixels, max(g.pixels for g in groups)]
    start_ms = first.median(SEGMENT)
    axes.plot(ends, [start_ms, start_ms * ends[1] / ends[0]], color="0.8", label="as the pixels")
    axes.set(xscale="log", yscale="log", xlabel="pixels", ylabel="milliseconds a frame (median)")
    sizes = {g.pixels: f"{g.width}x{g.height}" for g in groups}
    axes.set_xticks(list(sizes), list(sizes.values()))
    axes.set_xticks([], minor=True)
    axes.grid(alpha=0.3, which="both")
    figure.legend(loc="outside right upper", fontsize="small")
    figure.savefig(path, dpi=120)
