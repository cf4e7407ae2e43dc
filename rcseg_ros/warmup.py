"""The compiled kernels: once for a machine and a version, up to a minute or two, announced and never silent.

Numba keeps the compiled code beside the package, or in the user's cache folder where the package cannot be
written (NUMBA_CACHE_DIR names another place). `warm_up` readies one configuration, at the start of a command
or of the node; `fill_cache` readies all that a configuration can call, which is `rcseg warmup`.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from types import SimpleNamespace
from typing import Any

import numpy as np

from rcseg_core import PinholeCamera, RangeColorFrame, SegmenterConfig, segment
from rcseg_core.compute.jit import cache_folder
from rcseg_core.compute.parallel import LEAST_ROWS
from rcseg_core.config import PRESETS, describe
from rcseg_core.errors import InputError
from rcseg_core.registration import render_depth
from rcseg_core.result.seen import region_areas
from rcseg_core.tracking import Tracker
from rcseg_ros.results.messages import region_array

_PATIENCE_S, _BEAT_S = 3.0, 10.0
#: Numbers that switch something on or off; choices and switches themselves are all tried.
_NUMBERS = (("edges.outlier_threshold", 0.0), ("noise.color_sigma", 2.0))
#: Needs a second frame, and calls no kernel.
_LEFT_OUT = {("reflectance.mode", "calibrated")}


@dataclass(frozen=True)
class Cache:
    """What is kept, and where.

    folder : where the kernels lie
    lasting : False where nothing could be written but a temporary folder
    megabytes : of all that lies there for these sources
    """

    folder: Path
    lasting: bool
    megabytes: float


def warm_up(config: SegmenterConfig, announce: Callable[[str], None]) -> float:
    """Segment a small scene, so that all kernels are compiled or loaded; return the seconds that it took.

    `announce` is called only when it takes long: the kernels are being compiled then.
    """
    done = threading.Event()
    start = perf_counter()

    def report() -> None:
        if done.wait(_PATIENCE_S):
            return
        announce("Compiling the kernels for this machine: about a minute, only the first time ...")
        while not done.wait(_BEAT_S):
            announce(f"  still compiling, {perf_counter() - start:.0f} s, {len(compiled())} kernels so far")
        announce(f"  compiled in {perf_counter() - start:.0f} s; kept for the next start")

    reporter = threading.Thread(target=report, daemon=True)
    reporter.start()
    try:
        _use(_small_scene(), config)
    finally:
        done.set()
        reporter.join()
    return perf_counter() - start


def fill_cache(on_case: Callable[[str, int, int], object] = lambda name, done, total: None) -> Cache:
    """Compile all kernels and keep them.

    Parameters
    ----------
    on_case : called with what comes next, how many cases are done, and how many there are

    Raises
    ------
    InputError
        If there is no place to keep them.
    """
    cases = list(_cases())
    for done, (name, frame, config) in enumerate(cases):
        on_case(name, done, len(cases))
        _use(frame(), config)
    on_case("", len(cases), len(cases))
    kept = cache()
    if not kept.lasting:
        raise InputError(
            f"the kernels are compiled, but neither the package nor ~/.cache can be written to keep them "
            f"(they lie in {kept.folder} until a restart): set NUMBA_CACHE_DIR to a folder that can"
        )
    return kept


def cache() -> Cache:
    """Where the compiled kernels of these sources are kept."""
    folders = {Path(cache_folder(module)) for module in _modules()}
    lasting = not any(folder.name.startswith("rcseg-kernels-") for folder in folders)
    size = sum(file.stat().st_size for folder in folders for file in folder.rglob("*") if file.is_file())
    return Cache(Path(os.path.commonpath([folder.parent for folder in folders])), lasting, size / 1e6)


def compiled() -> list[str]:
    """Names of the kernels that this process compiled itself, because the cache did not hold them."""
    return [
        f"{kernel.__module__}.{kernel.__name__}"
        for kernel in _kernels()
        for _ in range(sum(kernel.stats.cache_misses.values()))
    ]


def _kernels() -> list[Any]:
    """All kernels of the modules that are loaded, each once."""
    found = {}
    for module in _modules():
        for value in list(vars(sys.modules[f"rcseg_core.{module}"]).values()):
            if hasattr(value, "signatures") and hasattr(value, "stats"):
                found[id(value)] = value
    return list(found.values())


def _modules() -> list[str]:
    """Loaded modules of the core that use kernels."""
    names = [name.removeprefix("rcseg_core.") for name in list(sys.modules) if name.startswith("rcseg_core.")]
    return [name for name in names if {"kernel", "bare"} & vars(sys.modules[f"rcseg_core.{name}"]).keys()]


def _cases() -> Iterator[tuple[str, Callable[[], RangeColorFrame], SegmenterConfig]]:
    """Name, frame and configuration of what must have been run once."""
    from rcseg_core.synthetic import make_scene

    default = SegmenterConfig()
    for name in PRESETS:
        yield f"preset {name}", _small_scene, SegmenterConfig.preset(name)
    for parameter in describe(default):
        values = parameter.choices or ((not parameter.default,) if parameter.type is bool else ())
        for value in values:
            if value != parameter.default and (parameter.key, value) not in _LEFT_OUT:
                yield f"{parameter.key} = {value}", _small_scene, default.replace({parameter.key: value})
    for key, value in _NUMBERS:
        yield f"{key} = {value}", _small_scene, default.replace({key: value})
    yield "the paper's own form", _small_scene, SegmenterConfig.literal()
    for order in ("surfaces_first", "joint", "range_only"):
        config = default.replace({"grouping.order": order})
        yield f"without a camera, {order}", lambda: replace(_small_scene(), camera=None), config
        yield f"points of 64 bits, {order}", _precise, config
    for family in ("room", "curved", "painting"):
        scene = make_scene(family, 0, width=320, height=240, outliers=0.02, dropout=0.05).frame
        for preset in PRESETS:
            yield f"{family}, preset {preset}", lambda scene=scene: scene, SegmenterConfig.preset(preset)


def _use(frame: RangeColorFrame, config: SegmenterConfig) -> None:
    """Everything that commands and the node ask of a frame and that takes kernels."""
    render_depth(frame.points, frame.camera or PinholeCamera(1.0, 1.0, 0.0, 0.0), frame.height, frame.width)
    result = segment(frame, config)
    region_areas(frame, result.labels, result.regions)
    region_array(frame, result, None, lambda type_name, /, **fields: SimpleNamespace(**fields))
    result.labels_at(0.5)
    result.labels_at(2.0)
    tracker = Tracker(config)
    for stamp_ns, pose in ((0, None), (1, None), (2, np.eye(4))):
        tracker.update(result, stamp_ns, pose)


def _precise() -> RangeColorFrame:
    frame = _small_scene()
    return RangeColorFrame(frame.points.astype(np.float64), frame.color, frame.camera)


def _small_scene() -> RangeColorFrame:
    """Two walls and a ball of different colours, with noise and a hole: every stage has something to do.

    As high as images are that several threads share, which some kernels are for.
    """
    rows, cols = np.mgrid[0 : max(96, LEAST_ROWS + 4), 0:128]
    depth_m = np.where(cols < 64, 1.5, 1.5 + 0.004 * (cols - 64)).astype(np.float32)
    bulge = 20.0**2 - (rows - 48.0) ** 2 - (cols - 40.0) ** 2
    ball = bulge > 0
    depth_m[ball] -= (0.01 * np.sqrt(bulge[ball])).astype(np.float32)
    noise = np.random.default_rng(0)
    depth_m += noise.normal(0, 0.001, depth_m.shape).astype(np.float32)
    depth_m[80:84, 20:24] = np.nan
    color = np.where(
        ball[..., None], (200, 60, 40), np.where((cols < 64)[..., None], (90, 120, 90), (60, 80, 170))
    )
    color = np.clip(color + noise.normal(0, 2, color.shape), 0, 255).astype(np.uint8)
    return RangeColorFrame.from_depth(depth_m, color, PinholeCamera(110.0, 110.0, 63.5, 47.5))
