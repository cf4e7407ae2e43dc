"""docs/inputs.md says what the code says: every reason of refusal, its words, parameters and options."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from rcseg_ros.cli import main
from rcseg_ros.options import NODE_PARAMETERS

REPOSITORY = Path(__file__).resolve().parents[2]
DOCUMENT = (REPOSITORY / "docs" / "inputs.md").read_text("utf-8")
SOURCES = [
    ast.parse(path.read_text("utf-8"))
    for package in ("rcseg_ros", "rcseg_core")
    for path in sorted((REPOSITORY / package).rglob("*.py"))
]


def _section(title):
    return DOCUMENT.split(f"## {title}\n")[1].split("\n## ")[0]


def _rows(text):
    return [
        [cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if "|" in line
    ]


def _words_of_code():
    """All that is written as text in the sources; places that are filled in are gaps."""
    found = []
    for tree in SOURCES:
        for node in ast.walk(tree):
            if isinstance(node, ast.JoinedStr):
                found.append("".join(getattr(part, "value", "\0") if isinstance(part, ast.Constant) else "\0"
                                     for part in node.values))  # fmt: skip
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return "\n".join(found)


def test_every_reason_is_in_the_table_and_no_other():
    calls = (node for tree in SOURCES for node in ast.walk(tree) if isinstance(node, ast.Call))
    reasons = {
        call.args[0].value
        for call in calls
        if getattr(call.func, "id", "") == "MessageError" and isinstance(call.args[0], ast.Constant)
    } | {"invalid_frame", "unusable_frame"}
    table = _section("What is refused").split("A recording as a whole")[0]
    told = {reason for row in _rows(table) for reason in re.findall(r"`([a-z_]+)`", row[0])}
    assert told == reasons | {"truncated_data", "bad_step"}  # which one call tells apart


def test_words_of_refusals_are_those_of_the_code():
    """But for the values in italics and what is left out."""
    code, checked = _words_of_code(), 0
    for row in _rows(_section("What is refused").split("A recording as a whole")[0])[2:]:
        for phrase in row[1].split(" / "):
            for piece in re.split(r"\.\.\.|'|;|:|\*[^*]*\*", phrase):
                words = piece.strip(" ,()")
                if len(words) > 6 and " " in words:
                    checked += 1
                    assert words in code, (row[0], words)
    assert checked > 30


@pytest.fixture(scope="module")
def options():
    import contextlib
    import io

    explained = io.StringIO()
    with contextlib.redirect_stdout(explained):
        for command in ("replay", "segment"):
            assert main([command, "--help"]) == 0
    return explained.getvalue()


def test_parameters_and_options_are_there(options):
    keys = {option.key for option in NODE_PARAMETERS}
    for key in re.findall(r"`((?:input|sync)\.[a-z_]+)", DOCUMENT):
        assert key in keys or any(one.startswith(key) for one in keys), key
    for option in re.findall(r"`(--[a-z-]+)", DOCUMENT):
        assert option in options, option


def test_links_lead_to_headings():
    headings = {re.sub(r"[^a-z -]", "", line.lower()).replace(" ", "-").strip("-")
                for line in re.findall(r"^#+ (.*)$", DOCUMENT, re.MULTILINE)}  # fmt: skip
    for document in ("inputs.md", "ros.md"):
        text = (REPOSITORY / "docs" / document).read_text("utf-8")
        for file, anchor in re.findall(r"\]\(([a-z_./]*)#([a-z-]+)\)", text):
            if (file in ("", "inputs.md") and document == "inputs.md") or file == "inputs.md":
                assert anchor in headings, anchor
        for file in re.findall(r"\]\(([^)#:]+)", text):
            assert (REPOSITORY / "docs" / file).exists(), file
