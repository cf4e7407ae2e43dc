"""The configuration from a YAML file and `--set` options, and back to a YAML file that can be given again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import yaml

from rcseg_core import SegmenterConfig
from rcseg_core.config import Parameter, describe
from rcseg_core.errors import ConfigError, InputError
from rcseg_ros.frames.expansion import load_yaml


def load_config(path: Path | None, settings: Sequence[str], preset: str | None = None) -> SegmenterConfig:
    """A preset, changed by a YAML file, changed by ``group.name=value`` settings.

    The file is what `rcseg config --yaml` writes, or a ROS parameter file, the node's own groups left out. A
    file that names every parameter leaves nothing of the preset.

    Parameters
    ----------
    preset : name of a preset; None: the one that a ROS parameter file names, else the defaults

    Raises
    ------
    InputError
        If the file cannot be read as YAML.
    ConfigError
        Unknown preset or parameter, wrong type or value out of bounds.
    """
    nested, named = ({}, None) if path is None else _read(path)
    base = SegmenterConfig.preset(preset or "balanced")
    try:
        if preset is None and named is not None:
            base = SegmenterConfig.preset(named)
        config = SegmenterConfig.from_dict(nested, base)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    changes = {}
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not equals:
            raise ConfigError(f"--set {setting}: expected group.name=value, for example grouping.max_gap=3")
        changes[key.strip()] = value.strip()
    return config.replace(changes)


def _read(path: Path) -> tuple[dict[str, Any], Any]:
    """Groups of a file, and the preset that it names or None."""
    try:
        nested = load_yaml(path.read_text("utf-8"))
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a YAML file: {' '.join(str(error).split())}") from None
    if nested is None:
        return {}, None
    if not isinstance(nested, dict):
        raise ConfigError(f"{path}: a configuration is a mapping of groups, got {type(nested).__name__}")
    ros = [
        node["ros__parameters"]
        for node in nested.values()
        if isinstance(node, dict) and "ros__parameters" in node
    ]
    if not ros:
        return nested, None
    given = {key: value for node in ros for key, value in node.items()}
    groups = {field.name for field in fields(SegmenterConfig)}
    return {key: value for key, value in given.items() if key in groups}, given.get("preset")


def config_yaml(config: SegmenterConfig) -> str:
    """The whole configuration as YAML, each line with its unit, bounds and meaning."""
    lines, group = [], ""
    for parameter in describe(config):
        head, name = parameter.key.split(".")
        if head != group:
            group = head
            lines.append(f"{group}:")
        value = yaml.safe_dump(parameter.value, default_flow_style=True).splitlines()[0]
        lines.append(f"  {name}: {value}  # {'; '.join(filter(None, (parameter.doc, bounds(parameter))))}")
    return "\n".join(lines) + "\n"


def bounds(parameter: Parameter) -> str:
    """What a value may be, for people."""
    if parameter.choices:
        return " | ".join(parameter.choices)
    limits = "" if parameter.low is None else f"{parameter.low:g} to {parameter.high:g}"
    return f"{limits} {parameter.unit}".strip()
