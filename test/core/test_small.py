"""The short forms of numpy's functions against numpy."""

import numpy as np
import pytest

from rcseg_core.compute.small import lower_quantile, median, quantile


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 10, 101, 1000])
@pytest.mark.parametrize("share", [0.0, 0.15, 0.3, 0.5, 0.7, 1.0])
def test_middles_and_quantiles_are_those_of_numpy(count, share):
    values = np.random.default_rng(count).normal(size=count)
    for numbers in (values, np.round(values), np.full(count, 2.5)):  # with ties as well
        before = numbers.copy()
        assert median(numbers) == np.median(numbers)
        assert quantile(numbers, share) == np.quantile(numbers, share)
        assert lower_quantile(numbers, share) == np.quantile(numbers, share, method="lower")
        np.testing.assert_array_equal(numbers, before)
