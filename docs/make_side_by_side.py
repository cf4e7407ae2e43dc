"""Draws recorded frames as an earlier version of rcseg saw them, beside what it sees now.

git worktree add ../rcseg_before 1e3ad72
python docs/make_side_by_side.py DATA ../rcseg_before

Writes docs/pictures/before_after_*.jpg: the colour, the surfaces before, the surfaces now; by kind (plane,
sphere, cylinder, none), with the degree of the range patch written on surfaces of 600 px and more.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from rcseg_core.datasets import load_frame
from rcseg_core.result.drawing import Image, contact_sheet, kinds_picture

HERE = Path(__file__).resolve().parent
FRAMES = (
    "uois_realsense_0",
    "uois_realsense_4",
    "mosd_learn40",
    "hard_tabletop_28",
    "hard_tabletop_56",
    "structured_room_911",
    "structured_room_914",
    "icl_evops_0",
    "pcl_office1",
    "pcl_seq_1",
)
LEAST_PX = 600
WIDTH_PX = 1440

#: Runs in either checkout, with its own rcseg_core.
SEGMENT = """
import sys
import numpy as np
from rcseg_core import segment
from rcseg_core.datasets import load_frame
data, out, *names = sys.argv[1:]
for name in names:
    result = segment(load_frame(data + "/" + name).frame)
    largest = {}
    for region in result.regions:
        largest.setdefault(region.surface, region.range_patch.degree)
    kinds = [surface.primitive.kind for surface in result.surfaces]
    degrees = [largest[surface.label] for surface in result.surfaces]
    np.savez(out + "/" + name.replace("/", "_"), labels=result.surface_labels, kinds=kinds, degrees=degrees)
"""


def main(data: str, before: str) -> None:
    with tempfile.TemporaryDirectory() as scratch:
        sheets = {}
        for title, checkout in (("before", Path(before)), ("now", HERE.parent)):
            out = Path(scratch) / title
            out.mkdir()
            environment = {**os.environ, "PYTHONPATH": str(checkout.resolve())}
            command = [sys.executable, "-c", SEGMENT, str(Path(data).resolve()), str(out), *FRAMES]
            subprocess.run(command, cwd=checkout, env=environment, check=True)
            sheets[title] = out
        for name in FRAMES:
            frame = load_frame(Path(data) / name).frame
            panels = [("colour", frame.color)] + [
                (title, drawn(out / f"{name.replace('/', '_')}.npz")) for title, out in sheets.items()
            ]
            sheet = contact_sheet(panels, columns=3, panel_width=WIDTH_PX // 3)
            path = HERE / "pictures" / f"before_after_{name.replace('/', '_')}.jpg"
            cv2.imwrite(str(path), sheet[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])


def drawn(path: Path) -> Image:
    """Surfaces by kind, degrees in their middles."""
    held = np.load(path)
    labels, degrees = held["labels"], held["degrees"]
    picture = np.ascontiguousarray(kinds_picture(labels, held["kinds"].tolist()))
    for label, degree in enumerate(degrees, start=1):
        rows, cols = np.nonzero(labels == label)
        if rows.size < LEAST_PX:
            continue
        middle = np.argmin((rows - rows.mean()) ** 2 + (cols - cols.mean()) ** 2)
        place = (int(cols[middle]) - 8, int(rows[middle]) + 8)
        for color, width in (((0, 0, 0), 5), ((255, 255, 255), 2)):
            cv2.putText(picture, str(degree), place, cv2.FONT_HERSHEY_SIMPLEX, 0.8, color, width)
    return picture


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(*sys.argv[1:])
