"""How well planes, spheres and cylinders are recognised on synthetic scenes whose truth is exact.

python benchmarks/shapes.py [--seeds 100:110] [--structured-light]

A surface counts when it has 600 pixels at least and 95 % of them lie on one true surface. Errors of radii are
those against a fit to the exact points, over the standard errors that were stated: 1 is as it should be.
"""

import argparse
import time
from collections import Counter

import numpy as np

from rcseg_core import segment
from rcseg_core.shapes.fitting import fit_shape, start_cylinder, start_sphere
from rcseg_core.synthetic import make_scene

FAMILIES = ("room", "blocks", "curved", "billiard")
LEAST_PX, LEAST_PURITY = 600, 0.95


def true_kind(normals: np.ndarray) -> str:
    """Exact unit normals (m, 3) are one direction, a great circle, or neither."""
    values = np.linalg.eigvalsh(normals.T @ normals / len(normals))
    return "plane" if values[1] < 1e-6 else "cylinder" if values[0] < 1e-6 else "sphere"


def distances(points: np.ndarray, found) -> np.ndarray:
    """Of points (m, 3) from a recognised shape, m."""
    values = found.parameters
    if found.kind == "plane":
        return points @ values["normal"] - values["distance"]
    local = points - values["center" if found.kind == "sphere" else "point"]
    if found.kind == "cylinder":
        local = local - (local @ values["axis"])[:, None] * values["axis"]
    return np.linalg.norm(local, axis=1) - values["radius"]


def true_radius(kind: str, points: np.ndarray, normals: np.ndarray) -> float:
    """Radius of the shape on which exact points lie."""
    weight = np.full(len(points), 1 / len(points))
    start = start_sphere(points, weight) if kind == "sphere" else start_cylinder(points, normals, weight)
    spread = np.tile(1e-6 * np.eye(3), (len(points), 1, 1))
    return fit_shape(start, points, spread, np.full(len(points), 1e9))[0].radius


def judge(family: str, seed: int, options: dict) -> tuple[Counter, list[float], list[float], float]:
    """(true kind, found kind) counts; rms misses over sigma; errors of radii over theirs; milliseconds."""
    scene = make_scene(family, seed, **options)
    result = segment(scene.frame)
    _ = result.regions
    start = time.thread_time()
    surfaces = result.surfaces
    spent_ms = 1e3 * (time.thread_time() - start)
    kinds, misses, scores = Counter(), [], []
    for surface in surfaces:
        mask = result.surface_labels == surface.label
        counts = np.bincount(scene.surface_labels[mask])
        if surface.pixel_count < LEAST_PX or counts[1:].max(initial=0) <= LEAST_PURITY * surface.pixel_count:
            continue
        mask &= scene.surface_labels == 1 + counts[1:].argmax()
        points, normals = scene.clean_points[mask], scene.normals[mask].astype(float)
        kind, found = true_kind(normals), surface.primitive
        kinds[kind, found.kind] += 1
        if found.kind == kind:
            sigma = np.median(scene.sigma_range[mask])
            misses.append(float(np.sqrt(np.mean(distances(points, found) ** 2)) / sigma))
            if kind != "plane":
                error = float(found.parameters["radius"]) - true_radius(kind, points, normals)
                scores.append(error / float(found.standard_errors["radius"]))
    return kinds, misses, scores, spent_ms


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="100:110", help="first:last+1")
    parser.add_argument("--structured-light", action="store_true", help="see the scenes through a Kinect")
    arguments = parser.parse_args()
    first, last = map(int, arguments.seeds.split(":"))
    print(
        "| scenes | right | wrong | none | rms miss / sigma: median, p95 | radius error / stated, rms | ms |"
    )
    print("|---|---|---|---|---|---|---|")
    for family in FAMILIES:
        options = {"structured_light": True} if arguments.structured_light and family != "billiard" else {}
        judged = [judge(family, seed, options) for seed in range(first, last)]
        kinds = sum((k for k, *_ in judged), Counter())
        right = sum(n for (true, found), n in kinds.items() if true == found)
        none = sum(n for (_, found), n in kinds.items() if found == "none")
        misses = np.concatenate([m for _, m, *_ in judged])
        scores = np.concatenate([s for *_, s, _ in judged])
        calibration = f"{np.sqrt(np.mean(scores**2)):.2f} of {len(scores)}" if len(scores) else ""
        print(
            f"| {family} | {right} | {kinds.total() - right - none} | {none} "
            f"| {np.median(misses):.3f}, {np.quantile(misses, 0.95):.3f} | {calibration} "
            f"| {np.median([ms for *_, ms in judged]):.1f} |",
            flush=True,
        )
        wrong = {f"{true} as {found}": n for (true, found), n in kinds.items() if true != found}
        if wrong:
            print(f"  {wrong}")


if __name__ == "__main__":
    main()
