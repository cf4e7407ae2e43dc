"""`rcseg inspect`: what a result bag holds, frame by frame and region by region, as tables."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from rcseg_core.errors import InputError
from rcseg_ros.bag import Recording
from rcseg_ros.conversions import header_of
from rcseg_ros.result_bag import NAMESPACE

REGIONS_TOPIC = f"{NAMESPACE}/regions"
TABLE_WIDTH = 150
_SHAPES: dict[int, tuple[str, tuple[tuple[str, int], ...]]] = {
    0: ("none", ()),
    1: ("plane", (("normal", 3), ("distance", 1))),
    2: ("sphere", (("centre", 3), ("radius", 1))),
    3: ("cylinder", (("point", 3), ("axis", 3), ("radius", 1))),
}
"""Name and parameters by the constants of Primitive.msg."""
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
                if console.width < TABLE_WIDTH:  # long lines are better than cut figures
                    console = Console(file=console.file, width=TABLE_WIDTH, highlight=False)
                console.print(_region_table(message, frame))
                if hasattr(message, "surfaces"):  # recordings of older versions have none
                    console.print(_surface_table(message))
                    console.print(_noise_text(message))
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
        "lasts",
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
            f"{getattr(region, 'persistence', math.nan):.3g}",
            "({:.0f} {:.0f} {:.0f})".format(*region.mean_color),
        )
    return table


def _surface_table(message: Any) -> Table:
    title = f"{len(message.surfaces)} surfaces; metres, standard errors after +-"
    table = Table(title=title, title_justify="left")
    for name in ("surface", "pixels", "shape", "parameters", "rms", "rms/sigma", "misfit", "regions"):
        table.add_column(name, justify="left" if name in ("shape", "parameters", "regions") else "right")
    for surface in message.surfaces:
        shape = surface.primitive
        known = shape.kind != 0
        labels = [str(label) for label in surface.regions]
        table.add_row(
            str(surface.label),
            str(surface.pixel_count),
            _SHAPES.get(shape.kind, ("?", ()))[0],
            _shape_text(shape),
            f"{shape.rms:.2g}" if known else "",
            f"{shape.rms_sigma:.2f}" if known else "",
            f"{shape.misfit:.2g}" if known else "",
            " ".join(labels[:8]) + (f" and {len(labels) - 8} more" if len(labels) > 8 else ""),
        )
    return table


def _shape_text(shape: Any) -> str:
    """Names and values of the parameters; the standard error of each length, of a vector the largest."""
    values = np.asarray(shape.parameters)
    count = len(values)
    errors = np.sqrt(np.maximum(np.diag(np.asarray(shape.covariance).reshape(count, count)), 0.0))
    at, parts = 0, []
    for name, size in _SHAPES.get(shape.kind, ("?", ()))[1]:
        numbers = " ".join(f"{value:.3f}" for value in values[at : at + size])
        shown = f"({numbers})" if size > 1 else f"{values[at]:.4f}"
        parts.append(f"{name} {shown} +- {errors[at : at + size].max():.2g}")
        at += size
    return ", ".join(parts)


def _noise_text(message: Any) -> str:
    noise = message.noise
    where = "" if math.isnan(noise.depth) else f" at the median depth of {noise.depth:.2f} m"
    red, green, blue = noise.color_sigma
    return (
        f"noise ({noise.source}): range {1e3 * noise.sigma:.2f} mm{where}, "
        f"{noise.range_correlation:.1f} px make one measurement; "
        f"colour {red:.1f} {green:.1f} {blue:.1f} levels, {noise.color_correlation:.1f} px. "
        f"Level 1 of the merge tree is {1e3 * noise.tolerance:.2f} mm there"
    )


def _vector(value: Any) -> str:
    return f"({value.x:.3f} {value.y:.3f} {value.z:.3f})"
