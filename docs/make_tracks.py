"""The picture of docs/ros.md: two frames of a journey, thirty apart, coloured by tracks.

python docs/make_tracks.py
"""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from rcseg_core import segment
from rcseg_core.result.drawing import write_png
from rcseg_core.synthetic import make_journey
from rcseg_core.tracking import Tracker, Tracks
from rcseg_ros.results.markers import track_color

SEED, FRAMES, FIRST, SECOND = 12, 60, 4, 34
TARGET = Path(__file__).parent / "pictures" / "tracks.png"
LEAST_PX = 150


def drawn(color: np.ndarray, tracks: Tracks) -> np.ndarray:
    """(H, W, 3) the colour image under the colours and ids of its surfaces."""
    ids = tracks.labels("surface")
    palette = np.zeros((ids.max() + 1, 3))
    for track in np.unique(ids[ids > 0]):
        palette[track] = 255 * track_color(int(track))
    picture = np.where(ids[..., None] > 0, 0.5 * color + 0.5 * palette[ids], color).astype(np.uint8)
    for track in np.unique(ids[ids > 0]).tolist():
        mask = (ids == track).astype(np.uint8)
        if mask.sum() < LEAST_PX:
            continue
        depth = cv2.distanceTransform(np.pad(mask, 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
        row, col = np.unravel_index(int(depth.argmax()), depth.shape)
        for thickness, ink in ((3, (0, 0, 0)), (1, (255, 255, 255))):
            place = (int(col) - 5 * len(str(track)), int(row) + 5)
            cv2.putText(
                picture, str(track), place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, ink, thickness, cv2.LINE_AA
            )
    return picture


def main() -> None:
    tracker, pictures = Tracker(), []
    for number, frame in enumerate(islice(make_journey(FRAMES, SEED, width=320, height=240), SECOND + 1)):
        if number < FIRST:
            continue
        seen = frame.scene.frame
        tracks = tracker.update(segment(seen), frame.stamp_ns, frame.scene.pose)
        if number in (FIRST, SECOND):
            pictures.append(drawn(seen.color, tracks))
    write_png(TARGET, np.concatenate(pictures, axis=1))


if __name__ == "__main__":
    main()
