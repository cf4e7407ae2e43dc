"""What the node's outputs cost: processor time of this thread to make and to serialise each, one frame.

    python benchmarks/outputs.py [--family room] [--width 640] [--height 480] [--seed 7] [--frames 5]

The median of several frames. What several outputs share counts for the first that needs it, in the order of
the table, which is that of the node; `all but` is the sum without the labels, which the node publishes first.
"""

from __future__ import annotations

import argparse
from statistics import median
from time import thread_time

from rclpy.serialization import serialize_message

from rcseg_core import segment
from rcseg_core.synthetic import make_scene
from rcseg_ros.frames.conversions import Header
from rcseg_ros.results.cdr import Serialized
from rcseg_ros.results.made import ResultMessages
from rcseg_ros.results.messages import make_rcl

BEFORE = ("labels", "surface_labels", "regions", "overlay", "edges", "reconstruction", "markers")
WORLD = (
    "class_mask", "object_labels", "objects", "ground_points", "obstacle_points", "labelled_points",
    "polygons",
)  # fmt: skip


def cost(results: ResultMessages, name: str) -> tuple[float, float, int]:
    """Milliseconds to make and to serialise an output, and its bytes."""
    start = thread_time()
    made = getattr(results, name)
    between = thread_time()
    messages = made if isinstance(made, list) else [made]
    sent = [m.data if isinstance(m, Serialized) else serialize_message(m) for m in messages if m is not None]
    return 1e3 * (between - start), 1e3 * (thread_time() - between), sum(map(len, sent))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--family", default="room")
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=480)
    parser.add_argument("--frames", type=int, default=5)
    given = parser.parse_args()
    rows: dict[str, list[tuple[float, float, int]]] = {}
    for seed in range(given.seed, given.seed + given.frames + 1):
        frame = make_scene(given.family, seed, width=given.width, height=given.height).frame
        result = segment(frame)
        results = ResultMessages(Header(1, "camera"), frame, result, make_rcl)
        steps = (
            ("(regions described)", lambda result=result: result.regions),
            ("(surfaces recognised)", lambda result=result: result.surfaces),
        )
        found = {}
        for name, step in steps:
            start = thread_time()
            step()
            found[name] = (1e3 * (thread_time() - start), 0.0, 0)
        parts = ("categories", "boundaries", "ground", "objects")
        for part in parts:
            start = thread_time()
            getattr(results.world, part)
            found[f"(world: {part})"] = (1e3 * (thread_time() - start), 0.0, 0)
        found |= {name: cost(results, name) for name in BEFORE + WORLD}
        if seed > given.seed:  # the first compiles and loads
            for name, row in found.items():
                rows.setdefault(name, []).append(row)
        counts = f"{len(result.regions)} regions, {len(result.surfaces)} surfaces"
        print(f"seed {seed}: {counts}, {len(result.objects)} objects")
    print(f"{'':24}{'make':>8}{'serialise':>11}  ms {'size':>10} B")
    total = 0.0
    for name, each in rows.items():
        made, sent, size = (median(column) for column in zip(*each, strict=True))
        total += made + sent if name != "labels" else 0.0
        print(f"{name:24}{made:8.2f}{sent:11.2f}     {size:10.0f}")
    added = [n for n in rows if n in WORLD or n.startswith("(world")]
    world = sum(median(a + b for a, b, _ in rows[name]) for name in added)
    print(f"all but labels: {total:.1f} ms; world alone: {world:.1f} ms")


if __name__ == "__main__":
    main()
