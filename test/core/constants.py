"""The numbers that steer the algorithm from outside of its configuration, found in the sources.

python test/core/constants.py    # lists them with the comment that stands above each
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

CORE = Path(__file__).resolve().parents[2] / "rcseg_core"
#: What segment() passes through.
ROOMS = (
    "compute",
    "signal",
    "models",
    "decision",
    "graph",
    "pixels",
    "partition",
    "stages",
    "resampling",
    "shapes",
)
FILES = [*sorted(path for room in ROOMS for path in (CORE / room).glob("*.py")), CORE / "pipeline.py"]


def named(path: Path) -> dict[str, tuple[str, str]]:
    """Value and comment of each constant of a module that is made of numbers alone."""
    text = path.read_text("utf-8")
    lines = text.splitlines()
    found = {}
    for node in ast.parse(text).body:
        if not isinstance(node, ast.Assign) or len(node.targets) != 1:
            continue
        target = node.targets[0]
        names = target.elts if isinstance(target, ast.Tuple) else [target]
        values = node.value.elts if isinstance(node.value, ast.Tuple) and len(names) > 1 else [node.value]
        above = node.lineno - 2
        while above >= 0 and lines[above].startswith("#:"):
            above -= 1
        comment = " ".join(line.removeprefix("#:").strip() for line in lines[above + 1 : node.lineno - 1])
        for name, value in zip(names, values, strict=False):
            text_of = ast.get_source_segment(text, value) or ""
            number = any(
                isinstance(part, ast.Constant) and type(part.value) in (int, float)
                for part in ast.walk(value)
            )
            if isinstance(name, ast.Name) and re.fullmatch(r"_?[A-Z][A-Z0-9_]+", name.id) and number:
                found[name.id] = (text_of, comment)
    return found


def all_named() -> dict[str, tuple[str, str]]:
    """The same of all rooms, by `room.module.NAME`."""
    found = {}
    for path in FILES:
        module = ".".join(path.relative_to(CORE).with_suffix("").parts)
        found |= {f"{module}.{name}": what for name, what in named(path).items()}
    return found


if __name__ == "__main__":
    for name, (value, comment) in all_named().items():
        print(f"{name} = {value}: {comment}")
