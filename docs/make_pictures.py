"""Makes the pictures of the bundled recordings that README.md shows.

python docs/make_pictures.py
"""

from pathlib import Path

import numpy as np

from rcseg_core import RangeColorFrame, SegmenterConfig, segment
from rcseg_core.result.drawing import contact_sheet, depth_picture, edges_picture, overlay, write_png
from rcseg_ros.frames.assembly import assemble_frame
from rcseg_ros.recordings.bag import Recording
from rcseg_ros.recordings.topics import find_topics

HERE = Path(__file__).resolve().parent


def first_frame(bag: Path) -> RangeColorFrame:
    with Recording(bag) as recording:
        inputs = find_topics(recording, {})
        return assemble_frame(*(recording.first(name) for name in inputs.names()))


def main() -> None:
    for name in ("arc2017", "motorcycle", "tabletop"):
        frame = first_frame(HERE.parent / "bags" / name)
        result = segment(frame, SegmenterConfig())
        points, color = result.reconstruct()
        unknown = np.isnan(points[..., 2])
        color[unknown] = 0
        panels = [
            ("colour", frame.color),
            ("depth", depth_picture(frame.depth_m)),
            ("edges: depth red, orientation green, colour blue", edges_picture(result.edges)),
            (f"{len(result.regions)} regions", overlay(frame.color, result.labels)),
            (f"{result.surface_labels.max()} surfaces", overlay(frame.color, result.surface_labels)),
            ("reconstructed from the parameters alone", color),
        ]
        sheet = contact_sheet(panels, columns=3, panel_width=320)
        write_png(HERE / "pictures" / f"{name}.png", sheet)


if __name__ == "__main__":
    main()
