"""ROC and FROC of scores whose curves are known."""

from __future__ import annotations

import numpy as np
import pytest
import synthetic
from sklearn.metrics import roc_auc_score

from palpate.study.statistics.detection import GRID, RATES, froc, roc
from palpate.study.statistics.estimate import Bootstrap


def test_the_interval_of_the_auc_holds_the_truth_as_often_as_it_says() -> None:
    held, widths = 0, []
    for seed in range(60):
        tables, true = synthetic.binormal(np.random.default_rng(seed), 40, 60, 1.2)
        populations = tables.patients["population"].to_numpy(dtype=str)
        curve = roc(tables.variants[0], Bootstrap.draw(populations, folds=200, seed=seed))
        assert curve is not None
        assert curve.auc.low is not None
        assert curve.auc.high is not None
        held += curve.auc.low <= true <= curve.auc.high
        widths.append(curve.auc.high - curve.auc.low)
    assert 52 <= held <= 60
    q1, q2 = true / (2 - true), 2 * true**2 / (1 + true)
    variance = (true * (1 - true) + 39 * (q1 - true**2) + 59 * (q2 - true**2)) / (40 * 60)
    assert np.mean(widths) == pytest.approx(2 * 1.96 * np.sqrt(variance), rel=0.12), "Hanley and McNeil's standard error"


def test_replicates_are_the_auc_of_the_drawn_patients() -> None:
    tables, _ = synthetic.binormal(np.random.default_rng(0), 15, 20, 1.0)
    curve, cases = roc(tables.variants[0], tables.bootstrap), tables.variants[0].cases
    assert curve is not None
    for fold in range(5):
        count = tables.bootstrap.counts[fold][cases["patient"]]
        drawn = cases.loc[cases.index.repeat(count)]
        assert curve.replicates[fold] == pytest.approx(roc_auc_score(drawn["ill"], drawn["worst_score"]), abs=1e-12)


def test_the_band_of_the_roc_is_about_the_true_curve() -> None:
    tables, true = synthetic.binormal(np.random.default_rng(3), 300, 300, 1.5)
    curve = roc(tables.variants[0], tables.bootstrap)
    assert curve is not None
    inner = (GRID > 0.02) & (GRID < 0.9)
    here = np.interp(GRID, curve.false_rate, curve.true_rate)
    assert (curve.low[inner] <= here[inner] + 0.02).all()
    assert (curve.high[inner] >= here[inner] - 0.02).all()
    assert np.trapezoid(curve.low, GRID) < true < np.trapezoid(curve.high, GRID)


def _by_hand() -> synthetic.Tables:
    """Four examinations, three lumps; areas by falling confidence: hit, false, hit, false, false; the third lump is not hit."""
    cases = [synthetic.case(i, "lumps", palpable=1) for i in range(3)] + [synthetic.case(3, "healthy")]
    ids = [case["case_id"] for case in cases]
    hits = [synthetic.finding(ids[0], 0.9, 0), synthetic.finding(ids[1], 0.7, 0)]
    false = [synthetic.finding(ids[3], 0.8, -1), synthetic.finding(ids[3], 0.3, -1), synthetic.finding(ids[0], 0.2, -1)]
    lumps = [
        synthetic.lump(ids[i], confidence=confidence, found=confidence > 0.5) for i, confidence in enumerate((0.9, 0.7, 0.0))
    ]
    return synthetic.tables(cases, hits + false, lumps)


def test_froc_by_hand() -> None:
    tables = _by_hand()
    curve = froc(tables.variants[0], tables.bootstrap)
    assert curve is not None
    assert curve.at_zero.value == pytest.approx(1 / 3)
    assert curve.at[1 / 4].value == pytest.approx(2 / 3), "one false finding in four examinations, at the confidence 0.7"
    assert curve.at[1 / 8].value == pytest.approx(1 / 3), "between none and one in four: the hit above it"
    assert curve.at[8.0].value == pytest.approx(2 / 3), "level beyond the last"
    assert curve.mean.value == pytest.approx((1 / 3 + 6 * 2 / 3) / 7)
    assert curve.mean.n == 3


def test_equal_confidences_count_at_once() -> None:
    cases = [synthetic.case(0, "lumps", palpable=1), synthetic.case(1, "healthy")]
    areas = [synthetic.finding(cases[0]["case_id"], 0.6, 0), synthetic.finding(cases[1]["case_id"], 0.6, -1)]
    tables = synthetic.tables(cases, areas, [synthetic.lump(cases[0]["case_id"], confidence=0.6, found=True)])
    curve = froc(tables.variants[0], tables.bootstrap)
    assert curve is not None
    assert curve.at_zero.value == 0.0
    assert curve.at[1 / 4].value == pytest.approx(0.5), "half way from none to one of both"


def test_a_failed_examination_of_a_healthy_person_is_a_false_finding_at_every_threshold() -> None:
    tables = _by_hand()
    frames = tables.variants[0]
    before = froc(frames, tables.bootstrap)
    frames.cases.loc[frames.cases["population"] == "healthy", "failed"] = True
    after = froc(frames, tables.bootstrap)
    assert before is not None
    assert after is not None
    assert after.at_zero.value == 0.0
    assert after.at[RATES[1]].value == pytest.approx(1 / 3)
