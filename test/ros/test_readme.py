"""What README.md says is true: its Python runs, its files are there, its commands and options exist."""

import re
from pathlib import Path

import numpy as np
import pytest
from recordings import scene

from rcseg_ros.cli import main

REPOSITORY = Path(__file__).resolve().parents[2]
README = (REPOSITORY / "README.md").read_text("utf-8")


def test_the_python_example_runs():
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    frame = scene(0)
    names = {"depth_m": frame.depth_m, "color": frame.color, "level": 2.0}
    exec(compile(code, "README.md", "exec"), names)
    assert names["result"].labels.max() == len(names["result"].regions)
    assert names["points"].shape == frame.points.shape
    value = names["region"].range_patch.evaluate(np.array([10]), np.array([10]))
    assert 0.5 < 1 / value.item() < 2


def test_linked_files_are_there():
    links = re.findall(r"\]\(([^)#:]+)\)", README)
    assert links
    for link in links:
        assert (REPOSITORY / link).is_file(), link


@pytest.mark.parametrize("command", ["replay", "segment", "evaluate", "config", "inspect"])
def test_commands_have_the_options_that_are_named(command, capsys):
    assert f"rcseg {command}" in README
    assert main([command, "--help"]) == 0
    explained = capsys.readouterr().out
    for line in re.findall(rf"rcseg {command}[^`\n]*", README):
        for option in re.findall(r"--[a-z-]+", line):
            assert option in explained, (command, option)


def test_make_targets_exist():
    makefile = (REPOSITORY / "Makefile").read_text("utf-8")
    for target in set(re.findall(r"`?make ([a-z]+)", README)):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), target
    assert (REPOSITORY / ".ci" / "run").read_text("utf-8").strip().endswith("make test")
