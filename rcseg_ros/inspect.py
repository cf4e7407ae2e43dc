"""`rcseg inspect`: what a result bag holds, frame by frame and region by region, as tables."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from rcseg_core.errors import InputError
from rcseg_ros.bag import Recording
from rcseg_ros.conversions import header_of
from rcseg_ros.result_bag import NAMESPACE

REGIONS_TOPIC = f"{NAMESPACE}/regions"
_KINDS = {1: "inverse depth", 2: "xyz", 3: "rgb"}


def inspect_bag(path: Path, frame: int | None, console: Console) -> None:
    """Print the topics and frames of a result bag; with `frame`, that frame's regions.

    Raises
    ------
    InputError
        If it is no result bag, or has no such frame.
    """
    with Recording(path) as recording:
        if REGIONS_TOPIC not in recording.topics:
            raise InputError(f"{path}: no topic {REGIONS_TOPIC}; this is no result of rcseg replay")
        if frame is None:
            _print_contents(recording, console)
            return
        for index, message in enumerate(_region_arrays(recording)):
            if index == frame:
                console.print(_region_table(message, frame))
                return
        raise InputError(f"{path}: no frame {frame}; it has {recording.topics[REGIONS_TOPIC].count}, from 0")


def _region_arrays(recording: Recording) -> Iterator[Any]:
    for raw in recording.messages([REGIONS_TOPIC]):
        yield recording.decode(raw)


def _print_contents(recording: Recording, console: Console) -> None:
    topics = Table("topic", "type", title=str(recording.path), title_justify="left")
    topics.add_column("messages", justify="right")
    for topic in recording.topics.values():
        topics.add_row(topic.name, topic.type, str(topic.count))
    console.print(topics)
    frames = Table(title="frames (--frame N shows the regions of one)", title_justify="left")
    for name in ("frame", "stamp [s]", "size", "regions", "surfaces", "pixels in regions"):
        frames.add_column(name, justify="right")
    for index, message in enumerate(_region_arrays(recording)):
        covered = sum(region.pixel_count for region in message.regions) / (message.height * message.width)
        surfaces = len({region.surface for region in message.regions})
        stamp_s = f"{header_of(message).stamp_ns / 1e9:.3f}"
        size = f"{message.width}x{message.height}"
        frames.add_row(str(index), stamp_s, size, str(len(message.regions)), str(surfaces), f"{covered:.1%}")
    console.print(frames)


def _region_table(message: Any, frame: int) -> Table:
    title = f"frame {frame}: {len(message.regions)} regions; metres, sensor frame {message.header.frame_id}"
    table = Table(title=title, title_justify="left")
    for name in (
        "label",
        "surface",
        "pixels",
        "box rows",
        "box cols",
        "centroid",
        "normal",
        "range",
        "rms",
        "color",
    ):
        table.add_column(name, justify="right")
    for region in message.regions:
        box, patch = region.pixels, region.range_patch
        table.add_row(
            str(region.label),
            str(region.surface),
            str(region.pixel_count),
            f"{box.row_min}-{box.row_max}",
            f"{box.col_min}-{box.col_max}",
            _vector(region.centroid),
            _vector(region.normal),
            f"{_KINDS.get(patch.kind, '?')} {patch.degree}",
            f"{math.sqrt(max(float(patch.covariance[0]), 0.0)):.2g}",
            "({:.0f} {:.0f} {:.0f})".format(*region.mean_color),
        )
    return table


def _vector(value: Any) -> str:
    return f"({value.x:.3f} {value.y:.3f} {value.z:.3f})"
