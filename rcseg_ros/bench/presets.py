"""The presets side by side: milliseconds and accuracy of each, on the same frames in the same rounds.

Each round runs every preset and then the peer on one frame, so that ratios hold on a machine with other
work. Accuracy is that of the regions of synthetic scenes, pooled over the seeds; recorded frames have no such
truth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np

from rcseg_core import RangeColorFrame, Segmentation, SegmenterConfig, segment
from rcseg_core.evaluation.frames import evaluate_scene
from rcseg_core.evaluation.metrics import REPORT_TOLERANCE
from rcseg_core.synthetic import make_scene
from rcseg_ros.bench.peers import Peer

Judge = Callable[[Segmentation], Any]


@dataclass
class PresetRow:
    """One preset on the frames of one family.

    Attributes
    ----------
    milliseconds : of segment(), one a frame and round
    ratios : the same over the peer's time in the same round; empty without a peer
    correct, truth, noise : regions found correctly, that there are, and found where there is none; None of
        recorded frames
    """

    preset: str
    group: str
    width: int
    height: int
    frames: int = 0
    milliseconds: list[float] = field(default_factory=list)
    ratios: list[float] = field(default_factory=list)
    correct: int | None = None
    truth: int | None = None
    noise: int | None = None

    def judge(self, found: Any) -> None:
        """Add the Hoover classes of one scene."""
        self.correct = (self.correct or 0) + found.correct
        self.truth = (self.truth or 0) + found.truth_regions
        self.noise = (self.noise or 0) + found.noise

    def row(self) -> dict[str, Any]:
        """Plain figures; None where there are none."""
        share = None if not self.truth or self.correct is None else self.correct / self.truth
        return {
            "preset": self.preset,
            "group": self.group,
            "width": self.width,
            "height": self.height,
            "frames": self.frames,
            "median_ms": float(np.median(self.milliseconds)),
            "p95_ms": float(np.percentile(self.milliseconds, 95)),
            "ratio": float(np.median(self.ratios)) if self.ratios else None,
            "correct": share,
            "correct_regions": self.correct,
            "truth_regions": self.truth,
            "noise_regions": self.noise,
        }


def compare_presets(
    presets: Mapping[str, SegmenterConfig],
    frames: Iterator[tuple[str, str, RangeColorFrame, Judge | None]],
    repeat: int,
    peer: Peer | None,
    on_step: Callable[[str], object],
) -> list[PresetRow]:
    """Measure every preset on every frame.

    Parameters
    ----------
    frames : group, name, frame, and what counts the regions of a result against truth, where there is any
    repeat : rounds for each frame, after one that does not count
    """
    rows: dict[tuple[str, str, int, int], PresetRow] = {}
    for group, scene, frame, judge in frames:
        on_step(f"presets on {scene} {frame.width}x{frame.height}")
        keys = {preset: (preset, group, frame.width, frame.height) for preset in presets}
        for preset, config in presets.items():  # the round that does not count, but can be judged
            row = rows.setdefault(keys[preset], PresetRow(*keys[preset]))
            row.frames += 1
            result = segment(frame, config)
            if judge is not None:
                row.judge(judge(result))
        call = None if peer is None else peer.make(frame)
        for _ in range(repeat):
            seconds = {name: _seconds(partial(segment, frame, config)) for name, config in presets.items()}
            of_peer = None if call is None else _seconds(call)
            for preset, s in seconds.items():
                rows[keys[preset]].milliseconds.append(1e3 * s)
                if of_peer is not None:
                    rows[keys[preset]].ratios.append(s / of_peer)
    return sorted(rows.values(), key=lambda row: list(presets).index(row.preset))


def judged_scenes(
    families: tuple[str, ...], seeds: tuple[int, ...], size: tuple[int, int]
) -> Iterator[tuple[str, str, RangeColorFrame, Judge]]:
    """Synthetic scenes with the function that counts a result's regions at the tolerance of the reports."""
    for family in families:
        for seed in seeds:
            scene = make_scene(family, seed, width=size[0], height=size[1])

            def judge(result: Segmentation, scene: Any = scene) -> Any:
                return evaluate_scene(scene, result).labels.at(REPORT_TOLERANCE)

            yield family, f"{family}_{seed:03d}", scene.frame, judge


def _seconds(call: Callable[[], object]) -> float:
    start = perf_counter()
    call()
    return perf_counter() - start
