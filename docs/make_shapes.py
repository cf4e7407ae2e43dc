"""Makes the picture of recognised shapes: the fitted planes, spheres and cylinders drawn over the images.

python docs/make_shapes.py
"""

from pathlib import Path

import cv2
import numpy as np

from rcseg_core import RangeColorFrame, Segmentation, segment
from rcseg_core.result.drawing import KIND_COLORS, contact_sheet, kinds_picture, write_png
from rcseg_core.synthetic import make_scene
from rcseg_ros.frames.assembly import assemble_frame
from rcseg_ros.recordings.bag import Recording
from rcseg_ros.recordings.topics import find_topics

HERE = Path(__file__).resolve().parent
COLORS = KIND_COLORS | {"plane": (255, 255, 255)}
SCALE = 2
#: Smaller surfaces are not written on, in pixels of the image.
LEAST_PX = 300


def tabletop() -> RangeColorFrame:
    with Recording(HERE.parent / "bags" / "tabletop") as recording:
        inputs = find_topics(recording, {})
        return assemble_frame(*(recording.first(name) for name in inputs.names()))


def circle(center: np.ndarray, axis: np.ndarray, radius: float) -> np.ndarray:
    """(73, 3) points of a circle."""
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    angle = np.linspace(0, 2 * np.pi, 73)[:, None]
    return center + radius * (np.cos(angle) * first + np.sin(angle) * np.cross(axis, first))


def wires(shape, points: np.ndarray) -> list[np.ndarray]:
    """Lines (n, 3) that show a shape where the points (m, 3) of its surface lie."""
    values = shape.parameters
    if shape.kind == "sphere":
        center, radius = values["center"], float(values["radius"])
        ray = center / np.linalg.norm(center)
        distance = np.linalg.norm(center)  # the outline is the circle in which rays touch the ball
        outline = circle(
            center - ray * radius**2 / distance, ray, radius * np.sqrt(1 - (radius / distance) ** 2)
        )
        return [outline]
    if shape.kind == "cylinder":
        point, axis, radius = values["point"], values["axis"], float(values["radius"])
        low, high = np.quantile((points - point) @ axis, [0.01, 0.99])
        ends = [point + low * axis, point + high * axis]
        side = np.cross(axis, point)
        side *= radius / np.linalg.norm(side)
        edges = [np.stack([end + sign * side for end in ends]) for sign in (-1, 1)]
        return [circle(end, axis, radius) for end in ends] + edges
    middle = points.mean(axis=0)
    middle -= values["normal"] * (values["normal"] @ middle - values["distance"])
    length = 0.06 * np.linalg.norm(middle)
    return [
        np.stack([middle, middle + length * values["normal"]]),
        circle(middle, values["normal"], length / 3),
    ]


def text(shape) -> str:
    errors = shape.standard_errors
    name, value = next((n, v) for n, v in shape.parameters.items() if n in ("distance", "radius"))
    return f"{abs(float(value)) * 1e3:.1f} +- {float(errors[name]) * 1e3:.2g} mm"


def drawn(frame: RangeColorFrame, result: Segmentation) -> np.ndarray:
    """The colour image, enlarged, with the shapes and their radius (planes: distance)."""
    camera = frame.camera
    size = (SCALE * frame.width, SCALE * frame.height)
    picture = cv2.resize(frame.color, size, interpolation=cv2.INTER_LINEAR)
    picture = (0.6 * picture).astype(np.uint8)
    points, _ = result.reconstruct()
    for surface in result.surfaces:
        shape = surface.primitive
        if shape.kind == "none" or surface.pixel_count < LEAST_PX:
            continue
        own = points[result.surface_labels == surface.label].astype(float)
        own = own[np.isfinite(own).all(axis=1)]
        for line in wires(shape, own):
            pixels = line[:, :2] / line[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
            corners = np.rint((pixels + 0.5) * SCALE * 8).astype(np.int32)
            cv2.polylines(picture, [corners], False, COLORS[shape.kind], SCALE, cv2.LINE_AA, 3)
        col, row = np.median(np.argwhere(result.surface_labels == surface.label)[:, ::-1], axis=0) * SCALE
        for color, width in (((0, 0, 0), 4), (COLORS[shape.kind], 1)):
            at = (int(col) - 50, int(row) - 8)
            cv2.putText(picture, text(shape), at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, color, width, cv2.LINE_AA)
    return picture


def main() -> None:
    panels = []
    synthetic = make_scene("curved", 1, width=480, height=360)
    for name, frame in (("recording of a tabletop", tabletop()), ("synthetic scene", synthetic.frame)):
        result = segment(frame)
        kinds = kinds_picture(result.surface_labels, [s.primitive.kind for s in result.surfaces])
        panels += [
            (name, frame.color),
            ("plane blue, sphere green, cylinder orange, none grey", kinds),
            ("shapes; radius, or distance of planes", drawn(frame, result)),
        ]
    write_png(HERE / "pictures" / "shapes.png", contact_sheet(panels, columns=3, panel_width=460))


if __name__ == "__main__":
    main()
