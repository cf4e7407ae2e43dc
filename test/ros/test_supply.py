"""Dependencies: the oldest that are admitted are written down, and those that are installed are admitted."""

from __future__ import annotations

import re
from importlib.metadata import version
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SETUP = (ROOT / "setup.py").read_text("utf-8")
REQUIRED = dict(
    re.findall(
        r'"([\w-]+)>=([\d.]+)"', SETUP[SETUP.index("install_requires") : SETUP.index("extras_require")]
    )
)


def _numbers(text):
    return [int(part) for part in re.findall(r"\d+", text)[:2]]


def test_the_oldest_versions_are_those_of_setup():
    lines = (ROOT / "constraints" / "oldest.txt").read_text("utf-8").splitlines()
    assert dict(line.removesuffix(".*").split("==") for line in lines if not line.startswith("#")) == REQUIRED
    assert len(REQUIRED) >= 12


@pytest.mark.parametrize("name", REQUIRED)
def test_what_is_installed_is_admitted(name):
    assert _numbers(version(name)) >= _numbers(REQUIRED[name])


@pytest.mark.parametrize("name", REQUIRED)
def test_licences_are_listed(name):
    assert name in (ROOT / "SECURITY.md").read_text("utf-8")
