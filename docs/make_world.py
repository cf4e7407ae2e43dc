"""Makes the picture and the figures of docs/world.md, from synthetic scenes alone.

python docs/make_world.py             the picture docs/pictures/world.png
python docs/make_world.py --figures   polygons, ground, classes and times, printed
"""

import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy import ndimage

from rcseg_core import segment
from rcseg_core.result.drawing import contact_sheet, overlay, write_png
from rcseg_core.synthetic import make_scene, make_terrain
from rcseg_core.world import CATEGORIES, GROUND, OBSTACLE, World

HERE = Path(__file__).resolve().parent
SEEDS, TERRAIN_SEEDS = range(100, 110), range(100, 120)
COLORS = np.array(
    [
        (0, 0, 0), (90, 160, 90), (240, 200, 60), (140, 120, 220), (90, 140, 230), (230, 130, 40),
        (220, 70, 90), (40, 190, 190), (130, 130, 130),
    ],
    np.uint8,
)  # fmt: skip


def mixed(color: np.ndarray, over: np.ndarray) -> np.ndarray:
    return (0.4 * color + 0.6 * over).astype(np.uint8)


def draw_rings(color: np.ndarray, result) -> np.ndarray:
    """The outlines of planes in white, their holes in red, other surfaces' in yellow."""
    out = (0.5 * color).astype(np.uint8)
    for surface in result.surfaces:
        for ring in surface.boundary.rings:
            tint = (
                (255, 220, 80) if surface.plane is None else (255, 80, 80) if ring.hole else (255, 255, 255)
            )
            points = np.round(16 * ring.pixels[:, ::-1]).astype(np.int32)
            cv2.polylines(out, [points], True, tint, 1, cv2.LINE_AA, shift=4)
    return out


def picture() -> None:
    terrain = make_terrain(7).scene
    room = make_scene("room", 24, structured_light=True)
    panels = []
    for name, scene in (("room to drive in", terrain), ("room", room)):
        color, result = scene.frame.color, segment(scene.frame)
        world = result.world()
        ground = np.zeros_like(color)
        ground[world.ground == GROUND], ground[world.ground == OBSTACLE] = (60, 170, 80), (210, 70, 60)
        shown = [CATEGORIES[k] for k in np.unique(world.class_mask) if k]
        panels += [
            (name, color),
            ("classes: " + ", ".join(shown), mixed(color, COLORS[world.class_mask])),
            ("ground green, obstacles red", mixed(color, ground)),
            ("boundaries: planes white, holes red, curved yellow", draw_rings(color, result)),
            (f"objects: {len(world.objects)}", overlay(color, world.object_labels)),
        ]
    write_png(HERE / "pictures" / "world.png", contact_sheet(panels, columns=5))


def polygon_figures() -> None:
    """Planes of clean rooms that were found (IoU .8): area, distance of their outlines from the truth's."""
    areas, distances, sharp, invalid, polygons = [], [], [], 0, 0
    for seed in SEEDS:
        scene = make_scene("room", seed)
        result = segment(scene.frame)
        camera = scene.frame.camera
        rays = camera.rays(*scene.labels.shape).astype(float)
        for surface in result.surfaces:
            polygons += len(surface.polygons)
            invalid += sum(not p.is_valid for p in surface.polygons)
            mine = result.surface_labels == surface.label
            best = int(np.bincount(scene.surface_labels[mine]).argmax())
            truth = scene.surface_labels == best
            iou = np.sum(mine & truth) / np.sum(mine | truth)
            if surface.plane is None or best == 0 or iou < 0.8 or truth.sum() < 1000:
                continue
            normal = scene.normals[truth][0].astype(float)
            distance = float(np.mean(scene.clean_points[truth] @ normal))
            exact = np.sum(distance**2 / np.abs(rays[truth] @ normal) ** 3) / (camera.fx * camera.fy)
            areas.append(sum(p.area for p in surface.polygons) / exact - 1)
            # doubled, a border between pixels lies on one of its own
            border = np.ones(2 * np.array(truth.shape) + 1, bool)
            wide = np.pad(truth, 1)
            for axis in (0, 1):
                differs = np.diff(wide.astype(np.int8), axis=axis) != 0
                rows, cols = np.nonzero(differs)
                border[2 * rows - (axis == 1), 2 * cols - (axis == 0)] = False
            away = ndimage.distance_transform_edt(border) / 2
            for ring in surface.boundary.rings:
                at = np.clip(np.round(2 * ring.pixels + 1).astype(int), 0, np.array(border.shape) - 1)
                found = away[at[:, 0], at[:, 1]]
                distances.append(float(found.max()))
                sharp.append(found)
    areas = np.abs(areas)
    pixels = np.concatenate(sharp)
    print(f"polygons: {polygons}, invalid {invalid}; {len(areas)} planes found at 80 %")
    print(f"  area off by: median {np.median(areas):.4f}, 95 % {np.quantile(areas, 0.95):.4f}, within 2 %: "
          f"{np.mean(areas <= 0.02):.3f}")  # fmt: skip
    print(f"  outline off by px: mean {pixels.mean():.3f}, 99 % {np.quantile(pixels, 0.99):.2f}; rings "
          f"within 2 px all along: {np.mean(np.array(distances) <= 2):.3f}")  # fmt: skip


def ground_figures() -> None:
    """Twenty rooms with ramps, steps and a table; seen floor, true up, an up wrong by 3 degrees."""
    table, named, true_named = [], 0, 0
    for seed in TERRAIN_SEEDS:
        room = make_terrain(seed)
        result, valid = segment(room.scene.frame), room.scene.frame.valid
        axis = np.cross(room.up, [0.0, 0.0, 1.0])
        axis /= np.linalg.norm(axis)
        wrong = np.cos(np.deg2rad(3)) * room.up + np.sin(np.deg2rad(3)) * np.cross(axis, room.up)
        rim = cv2.dilate((room.ground != 2).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        row = []
        for up in (None, room.up, wrong):
            world = result.world(up=up)
            found = world.ground == GROUND
            row += [
                found[room.floor & valid].mean(), found[(room.ground == 1) & valid].mean(),
                found[(room.ground == 2) & valid].sum(), found[(room.ground == 2) & valid & ~rim].sum(),
            ]  # fmt: skip
        table.append(row)
        named += not result.world(up=wrong).tilt.expected
        true_named += not result.world(up=room.up).tilt.expected
    table = np.array(table).reshape(-1, 3, 4)
    print(f"ground, {len(table)} rooms: up wrong by 3 degrees named in {named}, the true one in {true_named}")
    for i, name in enumerate(("up from the floor", "true up", "up wrong by 3 degrees")):
        floor, all_ground, wrong_px, inner = table[:, i].T
        print(f"  {name}: floor found {floor.mean():.4f} (least {floor.min():.4f}), all ground "
              f"{all_ground.mean():.4f} (least {all_ground.min():.4f}), obstacle pixels called ground "
              f"{wrong_px.sum():.0f}, of these beyond one pixel of the border {inner.sum():.0f}")  # fmt: skip


def class_figures() -> None:
    """Classes of the surfaces of rooms, blocks and curved scenes against true normals and solids."""
    rows = []
    for family in ("room", "blocks", "curved"):
        for seed in SEEDS:
            scene = make_scene(family, seed)
            result = segment(scene.frame)
            world, up = result.world(), scene.pose[2, :3]
            for surface, category in zip(result.surfaces, world.categories, strict=True):
                mine = result.surface_labels == surface.label
                if surface.pixel_count < 300 or world.up is None:
                    continue
                best = int(np.bincount(scene.surface_labels[mine]).argmax())
                truth = scene.surface_labels == best
                if best == 0 or np.sum(mine & truth) < 0.8 * mine.sum():
                    continue
                rows.append(
                    (category.probability, true_class(scene, truth, up), category.name, surface.pixel_count)
                )
    right = np.array([truth == name for _, truth, name, _ in rows])
    p = np.array([row[0] for row in rows])
    print(f"classes: {len(rows)} surfaces of 300 px and more, right {right.mean():.4f}")
    for low, high in ((0.0, 0.9), (0.9, 0.98), (0.98, 1.01)):
        some = (p >= low) & (p < high)
        if some.any():
            print(f"  told probability {low:.2f} to {min(high, 1):.2f}: {some.sum()} surfaces, mean told "
                  f"{p[some].mean():.3f}, right {right[some].mean():.3f}")  # fmt: skip


def true_class(scene, truth: np.ndarray, up: np.ndarray) -> str:
    normals = scene.normals[truth].astype(float)
    points = scene.clean_points[truth]
    if np.ptp(normals, axis=0).max() > 1e-3:
        flat = np.linalg.svd(normals - normals.mean(axis=0), compute_uv=False)
        return "cylinder" if flat[2] < 1e-3 * flat[0] else "sphere"
    rising = np.degrees(np.arcsin(np.clip(normals[0] @ up, -1, 1)))
    height = float(np.mean(points @ up)) + scene.pose[2, 3]
    if rising > 80:
        return "floor" if abs(height) < 0.02 else "horizontal"
    return "ceiling" if rising < -80 else "vertical" if abs(rising) < 10 else "inclined"


def time_figures() -> None:
    """Processor time of one thread, all of a world on surfaces that are described already."""
    spent: dict[str, list[float]] = {}
    for seed in SEEDS:
        result = segment(make_scene("room", seed).frame)
        start = time.thread_time()
        surfaces = result.surfaces
        spent.setdefault("describing surfaces", []).append(time.thread_time() - start)
        for run in range(4):
            world = World(replace(surfaces[0]._world.scene, known={}), None)
            for name in ("categories", "class_mask", "boundaries", "ground", "objects"):
                start = time.thread_time()
                list(getattr(world, name))
                if run:
                    spent.setdefault(name, []).append(time.thread_time() - start)
    total = 0.0
    for name, seconds in spent.items():
        total += float(np.median(seconds))
        print(f"  {name}: {1e3 * np.median(seconds):.1f} ms")
    print(f"  together: {1e3 * total:.1f} ms")


if __name__ == "__main__":
    if "--figures" in sys.argv:
        polygon_figures()
        ground_figures()
        class_figures()
        print("times, one thread:")
        time_figures()
    else:
        picture()
