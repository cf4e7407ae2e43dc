"""A few hostile frames, sequences and files of runs, always the same; `make fuzz` draws new ones."""

from __future__ import annotations

import pytest

pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install 'rcseg[test]'")

from fuzzing_results import TARGETS
from hypothesis import given, settings
from test_fuzz import FIXED


@pytest.mark.parametrize("name", TARGETS)
def test_hostile_inputs_are_taken_or_refused(name):
    strategy, take, examples = TARGETS[name]
    settings(FIXED, max_examples=examples)(given(strategy)(take))()
