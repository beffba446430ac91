"""Intervals against what is known of them."""

from __future__ import annotations

import numpy as np
import pytest
import synthetic

from palpate.study.statistics.detection import rates
from palpate.study.statistics.estimate import Bootstrap, bounded, percentiles, wilson


def test_wilson_of_twenty_in_twenty_says_what_twenty_patients_can_say() -> None:
    rate = wilson(20, 20, "patients")
    assert rate.low == pytest.approx(0.8389, abs=1e-4)
    assert rate.high == 1.0


def test_every_resampling_has_as_many_patients_of_each_population() -> None:
    populations = ["a"] * 7 + ["b"] * 3
    counts = Bootstrap.draw(populations, folds=50).counts
    assert (counts[:, :7].sum(axis=1) == 7).all()
    assert (counts[:, 7:].sum(axis=1) == 3).all()
    assert len(np.unique(counts, axis=0)) > 40


def test_the_same_seed_draws_the_same() -> None:
    a, b, other = (Bootstrap.draw(["a"] * 9, seed=seed).counts for seed in (3, 3, 4))
    assert (a == b).all()
    assert (a != other).any()


def test_replicates_of_a_mean_spread_as_the_standard_error() -> None:
    values = np.random.default_rng(1).normal(size=200)
    replicates = Bootstrap.draw(["a"] * 200, folds=4000).ratio(values, np.ones(200))
    assert replicates.mean() == pytest.approx(values.mean(), abs=0.01)
    assert replicates.std() == pytest.approx(values.std() / np.sqrt(200), rel=0.05)


def test_findings_of_one_patient_are_drawn_together() -> None:
    """Ten equal findings a patient say no more than one."""
    rng = np.random.default_rng(2)
    each = rng.normal(size=30)
    bootstrap = Bootstrap.draw(["a"] * 30)
    one = bootstrap.quantile(each, np.arange(30), 0.5)
    ten = bootstrap.quantile(np.repeat(each, 10), np.repeat(np.arange(30), 10), 0.5)
    assert one.std() == pytest.approx(ten.std(), rel=1e-9)


def test_a_rate_of_one_has_no_interval_of_width_zero() -> None:
    found = bounded(1.0, np.ones(1000), 40, "lumps", 20)
    assert found.low == wilson(20, 20, "patients").low
    assert "Wilson" in found.interval


def test_replicates_that_mostly_do_not_exist_give_no_interval() -> None:
    assert percentiles(np.where(np.arange(100) < 60, np.nan, 1.0)) is None


def test_the_interval_of_lumps_found_holds_the_truth_as_often_as_it_says() -> None:
    """Two lumps a patient that are found or missed together: an interval over lumps instead of patients would be too narrow."""
    held = 0
    for seed in range(200):
        found = np.random.default_rng(seed).random(60) < 0.7
        both = 2.0 * found
        bootstrap = Bootstrap.draw(["a"] * 60, folds=300, seed=seed)
        low, high = percentiles(bootstrap.ratio(both, np.full(60, 2.0))) or (1, 0)
        held += low <= 0.7 <= high
    assert 180 <= held <= 199


def test_no_false_finding_in_a_hundred_healthy_does_not_say_none() -> None:
    cases = [synthetic.case(number, "healthy") for number in range(100)]
    tables = synthetic.tables(cases, [], [])
    false = rates(tables.variants[0], tables.bootstrap).false_findings_of_healthy
    assert false.value == 0.0
    assert false.high == pytest.approx(-np.log(0.025) / 100, rel=1e-6)
