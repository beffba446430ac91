"""The psychometric surface of lumps that were found by a known one."""

import numpy as np
import pytest
import statsmodels.api as sm
import synthetic

from palpate.study.statistics.detectability import FELT, Surface, fit, observed, surface
from palpate.study.statistics.estimate import Bootstrap

HERE = {"felt_contrast": 1.6, "depth_m": 0.010}


def _fitted(seed: int, n: int, lapse: float = 0.0, folds: int = 200) -> Surface:
    tables = synthetic.psychometric(np.random.default_rng(seed), n, lapse)
    return surface(tables.variants[0], FELT, Bootstrap.draw(["lumps"] * n, folds, seed))


def test_without_a_lapse_it_is_the_logistic_regression_of_statsmodels() -> None:
    rng = np.random.default_rng(4)
    z = np.column_stack((np.ones(500), rng.normal(size=(500, 2))))
    found = rng.random(500) < 1 / (1 + np.exp(-(z @ [0.3, 1.0, -0.7])))
    count = rng.integers(0, 4, 500).astype(float)
    reference = sm.GLM(found.astype(float), z, family=sm.families.Binomial(), freq_weights=count).fit().params
    assert fit(z, found, count, False)[0][:-1] == pytest.approx(reference, abs=5e-4), "the prior weighs next to nothing"


def test_the_interval_of_the_smallest_lump_has_its_nominal_coverage() -> None:
    held = 0
    true = synthetic.true_radius(0.9, **HERE)
    for seed in range(12):
        smallest = _fitted(seed, 250, folds=80).threshold("felt_radius_m", **HERE)
        held += smallest.low <= true <= smallest.high
    assert 10 <= held <= 12


def test_the_smallest_lump_is_found_with_ninety_per_cent() -> None:
    found = _fitted(1, 800)
    smallest = found.threshold("felt_radius_m", **HERE)
    assert smallest.value == pytest.approx(synthetic.true_radius(0.9, **HERE), abs=0.0015)
    at = {name: np.array([value]) for name, value in HERE.items()} | {"felt_radius_m": np.array([smallest.value or 0.0])}
    assert found.probability(at)[0][0] == pytest.approx(0.9, abs=1e-6)


def test_deeper_lumps_are_found_less_and_their_threshold_is_the_deepest() -> None:
    found = _fitted(2, 800)
    deepest = found.threshold("depth_m", felt_contrast=1.6, felt_radius_m=0.018)
    shallower = {
        "felt_contrast": np.array([1.6]),
        "felt_radius_m": np.array([0.018]),
        "depth_m": np.array([deepest.value - 0.003]),
    }
    assert found.probability(shallower)[0][0] > 0.9


def test_a_lapse_is_fitted_only_if_there_is_one() -> None:
    assert _fitted(3, 1500, lapse=0.08, folds=2).lapse == pytest.approx(0.08, abs=0.03)
    assert _fitted(3, 1500, lapse=0.0, folds=2).lapse == 0.0


def test_no_threshold_beyond_the_lumps_of_the_study() -> None:
    found = _fitted(5, 400)
    beyond = found.threshold("felt_radius_m", felt_contrast=1.05, depth_m=0.12)
    assert beyond.value is None
    assert "above" in beyond.interval


def test_lumps_that_are_all_found_give_no_surface() -> None:
    tables = synthetic.psychometric(np.random.default_rng(6), 100)
    tables.variants[0].lumps["found"] = True
    assert surface(tables.variants[0], FELT, tables.bootstrap) is None


def test_found_and_missed_lumps_that_do_not_overlap_give_a_finite_surface() -> None:
    tables = synthetic.psychometric(np.random.default_rng(7), 100)
    lumps = tables.variants[0].lumps
    lumps["found"] = lumps["felt_radius_m"] > 0.017
    found = surface(tables.variants[0], FELT, Bootstrap.draw(["lumps"] * 100, 50))
    assert np.isfinite(found.weights).all()
    assert found.threshold("felt_radius_m").value == pytest.approx(0.017, abs=0.002)


def test_bins_hold_the_known_probability() -> None:
    tables = synthetic.psychometric(np.random.default_rng(8), 3000)
    lumps = tables.variants[0].lumps
    rows = observed(tables.variants[0], "felt_radius_m", tables.bootstrap)
    assert sum(row.n for _, row in rows) == 3000
    edges = np.quantile(lumps["felt_radius_m"], np.linspace(0, 1, len(rows) + 1))
    held = 0
    for (_, row), low, high in zip(rows, edges[:-1], edges[1:], strict=True):
        own = lumps[lumps["felt_radius_m"].between(low, high)]
        held += row.low <= synthetic.true_probability(own).mean() <= row.high
    assert held >= len(rows) - 1
