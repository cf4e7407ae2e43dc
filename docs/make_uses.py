"""Makes the pictures of docs/uses: what a robot takes of a synthetic room and of the recording tabletop.

python docs/make_uses.py
"""

from __future__ import annotations

from pathlib import Path

import cv2
import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from make_pictures import first_frame

from rcseg_core import PinholeCamera, RangeColorFrame, Segmentation, segment
from rcseg_core.result.drawing import contact_sheet, overlay, write_png
from rcseg_core.synthetic.terrain import make_terrain
from rcseg_core.world import CATEGORIES, GROUND, OBSTACLE, World
from rcseg_ros.results.colors import CATEGORY_COLORS
from rcseg_ros.results.markers import BOX_CORNERS, BOX_EDGES
from rcseg_ros.results.world import on_plane, ring_of

HERE = Path(__file__).resolve().parent
PICTURES = HERE / "pictures"
SEED = 7
INSET_M = 0.06


def blended(color: np.ndarray, over: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """The image in grey, with colours over those pixels that are shown."""
    picture = np.repeat(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2)
    picture[shown] = 0.4 * picture[shown] + 0.6 * over[shown]
    return picture


def classes_picture(frame: RangeColorFrame, world: World) -> np.ndarray:
    table = np.array([CATEGORY_COLORS[name] for name in CATEGORIES])
    return blended(frame.color, table[world.class_mask], world.class_mask > 0)


def ground_picture(frame: RangeColorFrame, world: World) -> np.ndarray:
    table = np.array([(0, 0, 0), (70, 190, 80), (220, 70, 60)])
    return blended(frame.color, table[world.ground], world.ground > 0)


def lines(
    picture: np.ndarray, camera: PinholeCamera, points: np.ndarray, color: tuple[int, ...], closed: bool
):
    """Draw a polyline of (n, 3) points in front of the camera."""
    if points[:, 2].min() > 0.05:
        pixels = points[:, :2] / points[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        cv2.polylines(picture, [np.rint(8 * pixels).astype(np.int32)], closed, color, 2, cv2.LINE_AA, 3)


def polygons_picture(frame: RangeColorFrame, result: Segmentation, world: World, names: tuple[str, ...]):
    picture = (0.6 * frame.color).astype(np.uint8)
    for surface, category in zip(result.surfaces, world.categories, strict=True):
        if category.name not in names or surface.plane is None:
            continue
        color = tuple(int(c) for c in CATEGORY_COLORS[category.name])
        for polygon in world.boundaries[surface.label - 1].polygons:
            for ring in (polygon.exterior, *polygon.interiors):
                flat = ring_of(ring, counter_clockwise=True)
                lines(picture, frame.camera, on_plane(surface.plane.pose, flat), color, True)
    return picture


def objects_picture(frame: RangeColorFrame, world: World) -> np.ndarray:
    picture = overlay(frame.color, world.object_labels)
    for one in world.objects:
        corners = BOX_CORNERS * one.box3d.size @ one.box3d.pose[:3, :3].T + one.box3d.pose[:3, 3]
        for edge in BOX_EDGES:
            lines(picture, frame.camera, corners[list(edge)], (60, 230, 255), False)
    return picture


def from_above(world: World, points: np.ndarray) -> np.ndarray:
    """(n, 2) coordinates on the ground of (n, 3) points: to the right, and ahead."""
    up = world.up.vector
    ahead = np.array([0.0, 0.0, 1.0]) - up[2] * up
    ahead /= np.linalg.norm(ahead)
    return points @ np.stack([np.cross(ahead, up), ahead], axis=1)


def axes(title: str):
    figure, one = plt.subplots(figsize=(5.2, 4.6), dpi=110)
    one.set(title=title, xlabel="right, m", ylabel="ahead, m", aspect="equal")
    one.grid(alpha=0.25)
    return figure, one


def saved(figure, name: str) -> None:
    figure.tight_layout()
    figure.savefig(PICTURES / name)
    plt.close(figure)


def nav2(frame: RangeColorFrame, result: Segmentation) -> None:
    world = result.world()
    panels = [
        ("colour", frame.color),
        (
            "classes: floor green, horizontal blue, inclined yellow, vertical orange",
            classes_picture(frame, world),
        ),
        ("~/ground_points green, ~/obstacle_points red", ground_picture(frame, world)),
    ]
    write_png(PICTURES / "use_nav2.png", contact_sheet(panels, columns=3, panel_width=420))
    figure, one = axes("from above: what the costmap is given")
    for kind, color in ((GROUND, "#46be50"), (OBSTACLE, "#dc463c")):
        at = from_above(world, frame.points[world.ground == kind][::7])
        one.scatter(*at.T, s=1, color=color, linewidths=0)
    saved(figure, "use_nav2_above.png")


def footsteps(frame: RangeColorFrame, result: Segmentation) -> None:
    world, up_facing = result.world(), ("floor", "horizontal", "inclined")
    figure, one = axes(f"planes that face up, and insets of {INSET_M * 100:.0f} cm")
    for surface, category in zip(result.surfaces, world.categories, strict=True):
        if category.name not in up_facing or surface.plane is None:
            continue
        color = CATEGORY_COLORS[category.name] / 255
        for polygon in world.boundaries[surface.label - 1].polygons:
            inner = polygon.buffer(-INSET_M, join_style="mitre")
            parts = [p for p in getattr(inner, "geoms", [inner]) if not p.is_empty]
            for part, style in [(polygon, {"fill": False}), *((p, {"alpha": 0.5, "lw": 0}) for p in parts)]:
                path = []
                for ring in (part.exterior, *part.interiors):
                    flat = ring_of(ring, counter_clockwise=ring is part.exterior)
                    path.append(from_above(world, on_plane(surface.plane.pose, flat)))
                codes = [c for ring in path for c in (1, *[2] * (len(ring) - 1), 79)]
                vertices = np.concatenate([np.vstack([ring, ring[:1]]) for ring in path])
                shape = matplotlib.path.Path(vertices, codes)
                one.add_patch(matplotlib.patches.PathPatch(shape, color=color, **style))
    one.autoscale_view()
    saved(figure, "use_footsteps.png")
    picture = polygons_picture(frame, result, world, up_facing)
    write_png(
        PICTURES / "use_footsteps_image.png", cv2.resize(picture, (560, 420), interpolation=cv2.INTER_AREA)
    )


def manipulation(frame: RangeColorFrame, result: Segmentation) -> None:
    world = result.world()
    panels = [
        ("colour", frame.color),
        (
            "horizontal surfaces: their prisms go to MoveIt",
            polygons_picture(frame, result, world, ("floor", "horizontal")),
        ),
        (f"{len(world.objects)} objects with boxes", objects_picture(frame, world)),
    ]
    write_png(PICTURES / "use_manipulation.png", contact_sheet(panels, columns=3, panel_width=420))


def plane_slam(result: Segmentation) -> None:
    planes = [(s.pixel_count, s.plane) for s in result.surfaces if s.plane is not None]
    figure, (left, right) = plt.subplots(1, 2, figsize=(8.4, 3.6), dpi=110)
    for part, color in (("random", "#508ce6"), ("total", "#e19646")):
        errors = np.array([np.sqrt(np.diag(p.covariance_of(part))) for _, p in planes])
        pixels = [count for count, _ in planes]
        left.loglog(pixels, 1e3 * errors[:, :2].max(axis=1), "o", ms=4, color=color, label=part)
        right.loglog(pixels, 1e3 * errors[:, 2], "o", ms=4, color=color, label=part)
    left.set(title="largest tilt error", xlabel="pixels of the plane", ylabel="mrad")
    right.set(title="offset error", xlabel="pixels of the plane", ylabel="mm")
    for one in (left, right):
        one.grid(alpha=0.25, which="both")
        one.legend()
    saved(figure, "use_plane_slam.png")


def main() -> None:
    room = make_terrain(SEED).scene.frame
    result = segment(room)
    nav2(room, result)
    footsteps(room, result)
    table = first_frame(HERE.parent / "bags" / "tabletop")
    result = segment(table)
    manipulation(table, result)
    plane_slam(result)


if __name__ == "__main__":
    main()
