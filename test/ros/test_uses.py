"""The configurations of docs/uses: every parameter exists and takes the value; pictures are there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from rcseg_core import SegmenterConfig
from rcseg_core.config import describe
from rcseg_ros.options import NODE_PARAMETERS, refusal

USES = Path(__file__).parents[2] / "docs" / "uses"
PAGES = sorted(USES.glob("*.md"))


def flat(nested, prefix=""):
    for key, value in nested.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_configuration_is_taken(page):
    node = {parameter.key: parameter for parameter in NODE_PARAMETERS}
    core = {parameter.key for parameter in describe(SegmenterConfig())}
    blocks = [yaml.safe_load(text) for text in re.findall(r"```yaml\n(.*?)```", page.read_text(), re.S)]
    given = [dict(flat(block["rcseg"]["ros__parameters"])) for block in blocks if "rcseg" in block]
    assert given, "a page without a configuration"
    for parameters in given:
        assert parameters.keys() <= node.keys() | core
        SegmenterConfig().replace({key: value for key, value in parameters.items() if key in core})
        for key in parameters.keys() & node.keys():
            assert not refusal(node[key], parameters[key])
            assert type(parameters[key]) is node[key].type, key


def test_the_costmaps_read_topics_that_the_node_has():
    text = (USES / "nav2.md").read_text()
    for block in map(yaml.safe_load, re.findall(r"```yaml\n(.*?)```", text, re.S)):
        for key, value in flat(block):
            if key.endswith("topic"):
                assert value in ("/rcseg/ground_points", "/rcseg/obstacle_points")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_somewhere(page):
    found = re.findall(r"\]\(([^)#]+)\)", page.read_text())
    assert found and all((USES / link).exists() for link in found), found
