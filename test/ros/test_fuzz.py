"""A few hostile inputs of each kind, always the same; `make fuzz MINUTES=10` draws new ones."""

from __future__ import annotations

import pytest
from fuzzing import TARGETS
from hypothesis import HealthCheck, Phase, given, settings

FIXED = settings(
    derandomize=True, database=None, deadline=None, suppress_health_check=list(HealthCheck),
    phases=[Phase.explicit, Phase.generate],
)  # fmt: skip


@pytest.mark.parametrize("name", TARGETS)
def test_hostile_inputs_are_taken_or_refused(name):
    strategy, take, examples = TARGETS[name]
    settings(FIXED, max_examples=examples)(given(strategy)(take))()
