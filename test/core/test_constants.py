"""docs/constants.md names every number that steers from outside of the configuration, and no other."""

import re
from pathlib import Path

from constants import all_named

TEXT = (Path(__file__).resolve().parents[2] / "docs" / "constants.md").read_text("utf-8")
#: More of these want a reason that outweighs the wish for fewer.
MOST_THAT_STEER = 39


def listed(kind):
    part = TEXT.split(f"\n## {kind}\n")[1].split("\n## ")[0]
    return re.findall(r"^\| `([\w.]+)` \| .+ \| (.+) \|$", part, re.MULTILINE)


def kinds():
    return dict(re.findall(r"^\| (\w+) \| .+ \| (\d+) \|$", TEXT, re.MULTILINE))


def test_every_constant_is_listed_once_and_with_a_reason():
    rows = [row for kind in kinds() for row in listed(kind)]
    assert sorted(name for name, _ in rows) == sorted(all_named())
    assert all(reason.strip() for _, reason in rows)


def test_the_page_counts_them_right_and_no_more_steer_than_before():
    assert {kind: len(listed(kind)) for kind in kinds()} == {kind: int(n) for kind, n in kinds().items()}
    assert len(listed("steers")) <= MOST_THAT_STEER
