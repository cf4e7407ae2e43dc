"""Time and memory of tracking: `Tracker.update` with about fifty surfaces, and its growth over frames.

    python benchmarks/tracking.py
    python benchmarks/tracking.py --frames 100000

Segmentation and the shapes of surfaces are not counted: they are found once for a few frames, which are then
tracked over and over. For memory every other frame is elsewhere, so that all tracks are lost in each.
"""

from __future__ import annotations

import argparse
import resource
from time import thread_time

import numpy as np

from rcseg_core import RangeColorFrame, Segmentation, segment
from rcseg_core.synthetic import default_camera
from rcseg_core.tracking import Tracker

FRAME_NS = 33_333_333


def boxes(shift_px: int, height: int = 480, width: int = 640) -> RangeColorFrame:
    """A wall with 48 boxes of different depth and colour before it."""
    places, noise = np.random.default_rng(0), np.random.default_rng(shift_px + 1)
    depth, color = np.full((height, width), 2.0), np.full((height, width, 3), 120.0)
    for row in range(6):
        for col in range(8):
            top, left = int((row + 0.2) * height / 6), int((col + 0.2) * width / 8) + shift_px
            part = slice(top, top + height // 10), slice(left, left + 3 * width // 40)
            depth[part], color[part] = places.uniform(1.2, 1.7), places.uniform(40, 220, 3)
    depth += noise.normal(0, 1.4e-3, depth.shape) * depth**2
    color += noise.normal(0, 3, color.shape)
    camera = default_camera(width, height)
    return RangeColorFrame.from_depth(
        depth.astype(np.float32), np.clip(color, 0, 255).astype(np.uint8), camera
    )


def time_updates(results: list[Segmentation], posed: bool, rounds: int = 60) -> tuple[float, str]:
    """Median milliseconds of processor time, and what told the motion."""
    tracker, times = Tracker(), []
    for i in range(rounds):
        start = thread_time()
        tracks = tracker.update(results[i % len(results)], i * FRAME_NS, np.eye(4) if posed else None)
        times.append(thread_time() - start)
    return 1e3 * float(np.median(times[len(results) :])), tracks.motion


def grow(result: Segmentation, frames: int) -> None:
    """Print the memory of the process while all tracks are lost over and over."""
    tracker, far = Tracker(), np.eye(4)
    for i in range(frames):
        far[0, 3] = 100.0 * i
        tracks = tracker.update(result, i * FRAME_NS, far)
        if i % max(frames // 10, 1) == 0:
            megabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            print(
                f"frame {i}: {megabytes:.0f} MB, {len(tracks.tracks)} tracks, last id {tracks.tracks[-1].id}"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=0, help="frames of the test of memory; 0: none")
    options = parser.parse_args()
    results = [segment(boxes(shift)) for shift in range(3)]
    for result in results:
        result.world()
        len(result.surfaces), len(result.objects)
    print(f"{len(results[0].surfaces)} surfaces, {len(results[0].regions)} regions at 640x480")
    for posed in (True, False):
        milliseconds, motion = time_updates(results, posed)
        print(f"update with {'exact poses' if posed else 'no poses'} ({motion}): {milliseconds:.2f} ms")
    if options.frames:
        grow(segment(boxes(0, 96, 128)), options.frames)


if __name__ == "__main__":
    main()
