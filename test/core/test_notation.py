"""docs/notation.md cannot go stale: what it names exists, and every equation is there."""

import ast
import importlib
import re
from pathlib import Path

import pytest

from rcseg_core import SegmenterConfig
from rcseg_core.config import describe

HERE = Path(__file__).resolve().parent
TEXT = (HERE.parents[1] / "docs" / "notation.md").read_text()
NAMES = sorted(set(re.findall(r"`([^`]+)`", TEXT)))
TESTS = [name for name in NAMES if "::" in name]
SETTINGS = [name for name in NAMES if re.fullmatch(r"[a-z_]+\.[a-z_]+ = \w+", name)]
CORE = HERE.parents[1] / "rcseg_core"
MODULES = {path.stem for path in CORE.glob("*.py")} | {path.parent.name for path in CORE.glob("*/*.py")}
CODE = [name for name in NAMES if re.fullmatch(r"\w+(\.\w+)+", name) and name.split(".")[0] in MODULES]


def rows(title):
    """Cells of the table under a heading."""
    part = TEXT.split(f"## {title}")[1].split("\n## ")[0]
    lines = [line for line in part.splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]


@pytest.mark.parametrize("name", CODE)
def test_code_exists(name):
    """Longest importable module first, then attributes (of dataclasses: fields)."""
    parts = name.split(".")
    for cut in range(len(parts), 0, -1):
        try:
            found = importlib.import_module("rcseg_core." + ".".join(parts[:cut]))
        except ModuleNotFoundError:
            continue
        break
    for attribute in parts[cut:]:
        fields = getattr(found, "__dataclass_fields__", {})
        assert hasattr(found, attribute) or attribute in fields, f"{name}: no {attribute}"
        found = getattr(found, attribute, None)
    assert cut < len(parts), f"{name} is a module, not a function"


@pytest.mark.parametrize("name", TESTS)
def test_tests_exist(name):
    file, function = name.split("::")
    tree = ast.parse((HERE / file).read_text())
    assert function in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


@pytest.mark.parametrize("name", SETTINGS)
def test_switches_exist_and_take_their_value(name):
    key, value = name.split(" = ")
    config = SegmenterConfig().replace({key: value})
    assert key in {parameter.key for parameter in describe(config)}


def test_the_literal_form_is_what_the_table_says():
    literal = {parameter.key: parameter.value for parameter in describe(SegmenterConfig.literal())}
    default = {parameter.key: parameter.value for parameter in describe(SegmenterConfig())}
    departs = {key for key in literal if literal[key] != default[key]}
    table = "\n".join(" | ".join(row) for row in rows("Where the default departs from the paper"))
    for key in departs:
        value = str(literal[key]).lower()
        assert f"`{key} = {value}`" in table, f"{key} = {value} is not in docs/notation.md"


def test_every_equation_and_step_has_code_and_test():
    equations = rows("Equations")
    assert [row[0] for row in equations] == [str(number) for number in range(1, 24)]
    steps = rows("Steps of the algorithm (section 2) and of the initial partition (section 5)")
    assert {row[0] for row in steps} >= {*map(str, range(1, 10)), *(f"5.{step}" for step in range(1, 6))}
    for row in equations + steps:
        code, tests = row[-2:]
        assert any(name in code for name in CODE), row
        assert any(name in tests for name in TESTS), row
    assert len(CODE) > 50 and len(TESTS) > 50 and len(SETTINGS) >= 7


def test_every_paper_symbol_of_the_configuration_is_explained():
    known = TEXT.replace("\\|", "|")
    for parameter in describe(SegmenterConfig()):
        if parameter.symbol:
            assert parameter.symbol.split(" (")[0] in known, parameter.key
