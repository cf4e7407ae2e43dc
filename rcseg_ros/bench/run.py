"""`rcseg bench`: milliseconds by stage and by frame, memory, time to the first labels, and peers beside it.

On a machine that does other work too, only ratios within one run mean something. So each round segments a
frame and then runs every peer on it, and a ratio is the median over the rounds of one time by the other.
"""

from __future__ import annotations

import json
import os
import platform
import sys
import tempfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, islice
from pathlib import Path
from time import perf_counter
from typing import Any

import cv2
import numba
import numpy as np

from rcseg_core import RangeColorFrame, SegmenterConfig, segment
from rcseg_core.compute import parallel
from rcseg_core.datasets import find_frames, load_frame
from rcseg_core.errors import InputError
from rcseg_core.synthetic import make_scene
from rcseg_ros.bench.peers import Peer, installed_peers
from rcseg_ros.bench.presets import PresetRow, compare_presets, judged_scenes
from rcseg_ros.bench.probe import fresh_process

SYNTHETIC, RECORDED = "synthetic", "recorded"
SEGMENT, FRAME, REGIONS = "segment()", "frame", "regions"
"""What is timed beside the stages: segment() alone; with the regions described; that description."""
SLOW_S = 1.0
"""A peer that takes longer than this runs once for each frame and not in every round."""
ALL = parallel.cores()
VGA_PIXELS = 640 * 480


@dataclass(frozen=True)
class BenchOptions:
    """What is measured.

    Attributes
    ----------
    sources : "synthetic", and paths of frames or of folders of frames
    families, sizes, seeds : of the synthetic scenes; sizes as (width, height)
    match : glob on the names of recorded frames, which keep their size
    repeat : rounds for each frame, after one that does not count
    threads : numbers of threads, one after another
    peers : run other segmenters too
    probe : measure memory and the first labels in fresh processes, one for each group
    cold : probe with an empty cache of compiled kernels too, once
    presets : configurations to compare, by name; synthetic scenes of the size nearest to 640x480
    """

    sources: tuple[str, ...] = (SYNTHETIC,)
    families: tuple[str, ...] = ("room", "blocks", "curved")
    sizes: tuple[tuple[int, int], ...] = ((160, 120), (320, 240), (640, 480), (1280, 960))
    seeds: tuple[int, ...] = (100, 101, 102)
    match: str = "*"
    repeat: int = 7
    threads: tuple[int, ...] = tuple(sorted({1, ALL}))
    peers: bool = True
    probe: bool = True
    cold: bool = False
    presets: Mapping[str, SegmenterConfig] = field(default_factory=dict)


@dataclass
class Group:
    """The frames of one family and size: their times with one number of threads, by what was timed."""

    name: str
    width: int
    height: int
    threads: int
    frames: int = 0
    milliseconds: dict[str, list[float]] = field(default_factory=dict)
    ratios: dict[str, list[float]] = field(default_factory=dict)
    stages: tuple[str, ...] = ()
    probe: dict[str, float] = field(default_factory=dict)
    calls: list[int] = field(default_factory=list)
    """Python functions that segment() called, one number a frame."""

    @property
    def pixels(self) -> int:
        return self.width * self.height

    def median(self, what: str) -> float:
        return float(np.median(self.milliseconds[what]))

    def ratio(self, peer: str) -> float:
        """segment() over the peer: the median over the rounds; NaN where the peer did not run."""
        return float(np.median(self.ratios[peer])) if peer in self.ratios else float("nan")

    @property
    def peers(self) -> tuple[str, ...]:
        return tuple(self.ratios)

    def rows(self) -> list[dict[str, Any]]:
        """One row for each thing that was timed."""
        kinds = {SEGMENT: "whole", FRAME: "whole", **dict.fromkeys(self.peers, "peer")}
        return [
            {
                "group": self.name,
                "width": self.width,
                "height": self.height,
                "threads": self.threads,
                "frames": self.frames,
                "kind": kinds.get(what, "stage"),
                "what": what,
                "runs": len(times),
                "median_ms": float(np.median(times)),
                "p95_ms": float(np.percentile(times, 95)),
                "ratio": self.ratio(what),
                "python_calls": int(np.median(self.calls)) if self.calls and what == SEGMENT else None,
            }
            for what, times in self.milliseconds.items()
        ]


@dataclass
class BenchReport:
    """What a run found."""

    options: BenchOptions
    config: SegmenterConfig
    machine: dict[str, Any]
    groups: list[Group] = field(default_factory=list)
    cold: dict[str, float] = field(default_factory=dict)
    differing: list[str] = field(default_factory=list)
    """Frames whose labels depend on the number of threads."""
    presets: list[PresetRow] = field(default_factory=list)

    def growth(self, threads: int) -> dict[str, float]:
        """By family: time over pixels, largest size against 320x240; 1 grows as the pixels do."""
        found = {}
        for name in dict.fromkeys(g.name for g in self.groups):
            mine = [g for g in self.groups if g.name == name and g.threads == threads and g.width >= 320]
            if len(mine) > 1:
                small, large = (f(mine, key=lambda g: g.pixels) for f in (min, max))
                if small.pixels < large.pixels:
                    times = large.median(SEGMENT) / small.median(SEGMENT)
                    found[name] = times / (large.pixels / small.pixels)
        return found

    def document(self) -> dict[str, Any]:
        """All figures, for JSON."""
        return {
            "machine": self.machine,
            "options": self.options,
            "config": self.config.to_dict(),
            "rows": [row for group in self.groups for row in group.rows()],
            "fresh_processes": [
                {"group": g.name, "width": g.width, "height": g.height, **g.probe}
                for g in self.groups
                if g.probe
            ],
            "cold_cache": self.cold,
            "growth": {str(n): self.growth(n) for n in self.options.threads},
            "labels_differ_by_threads": self.differing,
            "presets": [row.row() for row in self.presets],
        }


def parse_sizes(text: str) -> tuple[tuple[int, int], ...]:
    """Sizes from `160x120,640x480`; errors as `parse_size`."""
    from rcseg_ros.evaluation.options import parse_size

    return tuple(dict.fromkeys(parse_size(part.strip()) for part in text.split(",")))


def parse_threads(text: str) -> tuple[int, ...]:
    """Numbers of threads from `1`, `all` or `1,all`.

    Raises
    ------
    InputError
    """
    numbers = []
    for part in (part.strip() for part in text.split(",")):
        number = ALL if part == "all" else int(part) if part.isdigit() else 0
        if not 1 <= number <= ALL:
            raise InputError(f"--threads {text}: expected all, or numbers from 1 to {ALL}, with commas")
        numbers.append(number)
    return tuple(dict.fromkeys(numbers))


def run_bench(
    options: BenchOptions,
    config: SegmenterConfig,
    on_step: Callable[[str], object] = lambda text: None,
    prepare: Callable[[SegmenterConfig], object] = lambda config: None,
) -> BenchReport:
    """Measure.

    Parameters
    ----------
    on_step : is told what comes next
    prepare : called with each configuration once all sources are found and the first frame is read, so that
        kernels are compiled before anything is timed

    Raises
    ------
    InputError
        For frames that cannot be found or read.
    """
    peers = installed_peers() if options.peers else ()
    report = BenchReport(options, config, describe_machine())
    groups: dict[tuple[str, int, int, int], Group] = {}
    frames = _frames(options)
    first = list(islice(frames, 1))
    for each in (config, *options.presets.values()):
        prepare(each)
    try:
        for source, name, frame in chain(first, frames):
            on_step(f"{name} {frame.width}x{frame.height}")
            checks = set()
            for threads in options.threads:
                set_threads(threads)
                key = (source, frame.width, frame.height, threads)
                if key not in groups:
                    groups[key] = Group(*key)
                    report.groups.append(groups[key])
                    if options.probe and threads == options.threads[0]:
                        groups[key].probe = _probe(frame, config)
                usable = [p for p in peers if threads == ALL or p.one_thread]
                checks.add(_measure(groups[key], frame, config, options.repeat, usable))
            if len(checks) > 1:
                report.differing.append(f"{name} {frame.width}x{frame.height}")
            if options.cold and not report.cold:
                on_step("compiling everything in an empty cache: a minute or two")
                report.cold = _probe(frame, config, cold=True)
        if options.presets:
            set_threads(max(options.threads))
            peer = peers[0] if peers else None
            frames = _preset_frames(options)
            report.presets = compare_presets(options.presets, frames, options.repeat, peer, on_step)
    finally:
        set_threads(ALL)
    return report


def set_threads(number: int) -> None:
    """Let the kernels and OpenCV use so many threads."""
    parallel.set_threads(number)
    cv2.setNumThreads(number)


def describe_machine() -> dict[str, Any]:
    """What figures depend on: processor, cores, other load, versions."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "processor": models[0] if models else platform.processor(),
        "cores": ALL,
        "load_before": os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan"),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "numba": numba.__version__,
        "opencv": cv2.__version__,
    }


def _frames(options: BenchOptions) -> Iterator[tuple[str, str, RangeColorFrame]]:
    """Group, name and frame; synthetic ones family by family, size by size."""
    recorded = {one: find_frames(one, options.match) for one in options.sources if one != SYNTHETIC}
    for source in options.sources:
        if source != SYNTHETIC:
            for name, path in recorded[source]:
                yield RECORDED, name, load_frame(path, name=name).frame
            continue
        for family in options.families:
            for width, height in options.sizes:
                for seed in options.seeds:
                    scene = make_scene(family, seed, width=width, height=height)
                    yield family, f"{family}_{seed:03d}", scene.frame


def _preset_frames(options: BenchOptions) -> Iterator[tuple[str, str, RangeColorFrame, Any]]:
    """What presets are compared on: synthetic scenes of one size, recorded frames without a judge."""
    size = min(options.sizes, key=lambda s: abs(s[0] * s[1] - VGA_PIXELS))
    for source in options.sources:
        if source == SYNTHETIC:
            yield from judged_scenes(options.families, options.seeds, size)
        else:
            for name, path in find_frames(source, options.match):
                yield RECORDED, name, load_frame(path, name=name).frame, None


def _measure(
    group: Group, frame: RangeColorFrame, config: SegmenterConfig, repeat: int, peers: Sequence[Peer]
) -> int:
    """Rounds of this frame into `group`; a checksum of the labels."""
    calls = [(peer.name, call) for peer in peers if (call := peer.make(frame)) is not None]
    segment(frame, config).regions  # noqa: B018  described on first use: the round that does not count
    slow = {name for name, call in calls if _seconds(call) > SLOW_S}
    for round_ in range(repeat):
        start = perf_counter()
        result = segment(frame, config)
        middle = perf_counter()
        result.regions  # noqa: B018
        end = perf_counter()
        whole = {SEGMENT: middle - start, FRAME: end - start}
        stages = {**result.timings, REGIONS: end - middle}
        others = {name: _seconds(call) for name, call in calls if round_ == 0 or name not in slow}
        for what, seconds in {**whole, **stages, **others}.items():
            group.milliseconds.setdefault(what, []).append(1e3 * seconds)
        for name, seconds in others.items():
            group.ratios.setdefault(name, []).append(whole[SEGMENT] / seconds)
    group.stages = tuple(dict.fromkeys([*group.stages, *stages]))
    group.frames += 1
    group.calls.append(python_calls(lambda: segment(frame, config)))
    return zlib.crc32(result.labels.tobytes())


def python_calls(call: Callable[[], object]) -> int:
    """Python functions that a call enters on this thread: a figure that no other load changes."""
    entered = 0

    def count(frame: object, event: str, argument: object) -> None:
        nonlocal entered
        entered += event == "call"

    before = sys.getprofile()
    sys.setprofile(count)
    try:
        call()
    finally:
        sys.setprofile(before)
    return entered


def _seconds(call: Callable[[], object]) -> float:
    start = perf_counter()
    call()
    return perf_counter() - start


def _probe(frame: RangeColorFrame, config: SegmenterConfig, *, cold: bool = False) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        frame_path, config_path = Path(folder) / "frame.npz", Path(folder) / "config.json"
        arrays = {"points": frame.points, "color": frame.color}
        if (camera := frame.camera) is not None:
            arrays["K"] = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        np.savez(frame_path, **arrays)
        config_path.write_text(json.dumps(config.to_dict()), "utf-8")
        return fresh_process(frame_path, config_path, cold=cold)
