"""Small faults of Python sources, by their syntax trees; `mutants.py` puts them in."""

from __future__ import annotations

import ast
from dataclasses import dataclass
from pathlib import Path

OTHER = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Add, ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult, ast.Mod: ast.FloorDiv, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
    ast.And: ast.Or, ast.Or: ast.And, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}  # fmt: skip
#: Comparisons whose other one is their negation.
TOTAL = (ast.Eq, ast.NotEq, ast.Is, ast.IsNot, ast.In, ast.NotIn)
#: Texts, and checks of what the type checker cannot see: not the business of tests.
APART = (ast.JoinedStr, ast.Raise, ast.Assert, ast.AnnAssign)


@dataclass(frozen=True)
class Fault:
    """One fault of a module: its number there, and where and what it is."""

    module: str
    number: int
    line: int
    before: str
    after: str
    text: str  # the whole line

    def __str__(self) -> str:
        return f"{self.module}:{self.line}  {self.before}  ->  {self.after}  in  {self.text}"


def places(tree: ast.AST) -> list[tuple[ast.AST, int]]:
    """Nodes of functions where a fault can be put, a constant in two ways (`one more`, `one less`)."""
    found: list[tuple[ast.AST, int]] = []
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef):
            for statement in function.body:
                found += _within(statement)
    return list(dict.fromkeys(found))


def _within(node: ast.AST) -> list[tuple[ast.AST, int]]:
    if isinstance(node, APART):
        return []
    found = [(node, way) for way in _ways(node)]
    for inner in ast.iter_child_nodes(node):
        found += _within(inner)
    return found


def _ways(node: ast.AST) -> tuple[int, ...]:
    if isinstance(node, ast.Compare):
        return (0,) if type(node.ops[0]) in OTHER else ()
    if isinstance(node, ast.BinOp | ast.BoolOp | ast.AugAssign):
        return (0,) if type(node.op) in OTHER else ()
    if isinstance(node, ast.Constant):
        return {int: (1, -1), float: (1, -1), bool: (0,)}.get(type(node.value), ())
    if isinstance(node, ast.If | ast.IfExp | ast.While):
        test = node.test
        same = isinstance(test, ast.Compare) and len(test.ops) == 1 and isinstance(test.ops[0], TOTAL)
        return () if same or isinstance(test, ast.Constant) else (0,)
    if isinstance(node, ast.Return):
        return (0,) if node.value is not None and not _is_none(node.value) else ()
    return (0,) if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call) else ()


def _is_none(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and node.value is None


def _change(node: ast.AST, way: int) -> None:
    """Put the fault into the node."""
    if isinstance(node, ast.Compare):
        node.ops[0] = OTHER[type(node.ops[0])]()
    elif isinstance(node, ast.BinOp | ast.BoolOp | ast.AugAssign):
        node.op = OTHER[type(node.op)]()
    elif isinstance(node, ast.Constant):
        node.value = node.value + way if way else not node.value
    elif isinstance(node, ast.If | ast.IfExp | ast.While):
        node.test = ast.UnaryOp(ast.Not(), node.test)
    elif isinstance(node, ast.Return | ast.Expr):
        node.value = ast.Constant(None)


def plain(file: Path) -> str:
    """A source without a fault, written as those with one are: without its comments."""
    return ast.unparse(ast.parse(file.read_text("utf-8")))


def count_faults(root: Path, module: str) -> int:
    """How many faults can be put into a module."""
    return len(places(ast.parse((root / module).read_text("utf-8"))))


def fault(root: Path, module: str, number: int) -> Fault:
    """One of them, from 0 on."""
    source = (root / module).read_text("utf-8")
    node, way = places(ast.parse(source))[number]
    before = _text(node)
    _change(node, way)
    return Fault(
        module, number, node.lineno, before, _text(node), source.splitlines()[node.lineno - 1].strip()
    )


def _text(node: ast.AST) -> str:
    text = ast.unparse(ast.fix_missing_locations(node))
    return text.splitlines()[0][:80]


def spoilt(root: Path, fault: Fault) -> str:
    """The source with that fault."""
    tree = ast.parse((root / fault.module).read_text("utf-8"))
    _change(*places(tree)[fault.number])
    return ast.unparse(ast.fix_missing_locations(tree))
