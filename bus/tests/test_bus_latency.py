"""The histogram of ages against numpy's quantiles."""

import numpy as np
import pytest

from palpate_bus.runtime.wallclock import BIN_NS, LatencyHistogram


def test_quantiles_are_those_of_the_values_to_within_a_bin() -> None:
    values = (np.random.default_rng(1).lognormal(0.0, 0.7, 5000) * 1e6).astype(int).tolist()
    ages = LatencyHistogram()
    for value in values:
        ages.add(value)
    for part in (0.5, 0.99):
        assert ages.quantile(part) == pytest.approx(np.quantile(values, part), abs=2 * BIN_NS, rel=0.01)
    told = ages.as_ms()
    assert told["max"] == round(max(values) / 1e6, 3)
    assert told["mean"] == pytest.approx(np.mean(values) / 1e6, abs=1e-3)
    assert told["p50"] < told["p99"] < told["max"]


def test_none_and_the_odd_ones() -> None:
    ages = LatencyHistogram()
    assert ages.as_ms() == {"mean": 0.0, "p50": 0.0, "p99": 0.0, "max": 0.0}
    ages.add(-5_000_000)
    assert ages.quantile(0.99) == 0
    ages.add(10**10)
    assert ages.as_ms()["max"] == 1e4
    assert ages.quantile(1.0) == 100_000_000, "beyond the last bin only the largest is known"
