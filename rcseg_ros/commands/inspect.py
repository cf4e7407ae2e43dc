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
from rcseg_core.world import CATEGORIES
from rcseg_ros.console import at_least
from rcseg_ros.frames.conversions import header_of
from rcseg_ros.recordings.bag import Recording
from rcseg_ros.recordings.result_bag import NAMESPACE

REGIONS_TOPIC, OBJECTS_TOPIC = f"{NAMESPACE}/regions", f"{NAMESPACE}/objects"
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
                console = at_least(console, TABLE_WIDTH)
                console.print(_region_table(message, frame))
                if hasattr(message, "surfaces"):  # recordings of older versions have none
                    console.print(_surface_table(message))
                    for text in _world_texts(recording, message):
                        console.print(text)
                    console.print(_noise_text(message))
                if getattr(message, "geometry", ""):
                    console.print(f"camera: {message.geometry}")
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
    names = (
        "surface",
        "pixels",
        "class",
        "area",
        "shape",
        "parameters",
        "rms",
        "rms/sigma",
        "misfit",
        "regions",
    )
    for name in names:
        left = name in ("class", "shape", "parameters", "regions")
        table.add_column(name, justify="left" if left else "right")
    for surface in message.surfaces:
        shape = surface.primitive
        known = shape.kind != 0
        labels = [str(label) for label in surface.regions]
        table.add_row(
            str(surface.label),
            str(surface.pixel_count),
            *_class_and_area(surface),
            _SHAPES.get(shape.kind, ("?", ()))[0],
            _shape_text(shape) + _plane_text(surface),
            f"{shape.rms:.2g}" if known else "",
            f"{shape.rms_sigma:.2f}" if known else "",
            f"{shape.misfit:.2g}" if known else "",
            " ".join(labels[:8]) + (f" and {len(labels) - 8} more" if len(labels) > 8 else ""),
        )
    return table


def _class_and_area(surface: Any) -> tuple[str, str]:
    """Class with its probability, and the area of its polygons in square metres; recordings of older versions
    have none."""
    if not hasattr(surface, "category"):
        return "", ""
    probability, area = surface.category_probability, sum(polygon.area for polygon in surface.polygons)
    share = "" if math.isnan(probability) else f" {probability:.2f}"
    return CATEGORIES[surface.category] + share, f"{area:.3f}" if area else ""


def _world_texts(recording: Recording, message: Any) -> Iterator[Table | str]:
    """Up, and the objects of the same stamp."""
    up = getattr(message, "up", None)
    if up is not None:
        yield "up: unknown" if math.isnan(up.x) else f"up: {_vector(up)}"
    if OBJECTS_TOPIC not in recording.topics:
        return
    stamp_ns = header_of(message).stamp_ns
    found = (recording.decode(raw) for raw in recording.messages([OBJECTS_TOPIC]) if raw.stamp_ns == stamp_ns)
    for array in found:
        table = Table(title=f"{len(array.objects)} objects; metres", title_justify="left")
        for name in ("object", "pixels", "middle", "size", "surfaces", "stands on"):
            table.add_column(name, justify="right")
        for one in array.objects:
            surfaces = " ".join(str(label) for label in one.surfaces)
            where = _vector(one.box_pose.position), _vector(one.box_size)
            under = f"surface {one.stands_on}" if one.stands_on else "?"
            table.add_row(str(one.label), str(one.pixel_count), *where, surfaces, under)
        yield table


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


def _plane_text(surface: Any) -> str:
    """The three errors of a plane about its centroid, and how much of them is systematic; else nothing."""
    for plane in getattr(surface, "plane", ()):  # recordings of older versions have none
        random, systematic = (np.diag(np.reshape(m, (3, 3))) for m in (plane.covariance, plane.systematic))
        errors = 1e3 * np.sqrt(random + systematic)
        text = f"; tilts +- {errors[0]:.2g}, {errors[1]:.2g} mrad, offset +- {errors[2]:.2g} mm"
        if systematic.any():
            text += f", of which {1e3 * math.sqrt(systematic[2]):.2g} mm in every frame"
        return text
    return ""


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
