"""Paired comparisons, intervals, ROC, FROC and surfaces of detectability, of scores whose statistics are known."""

from typing import Any

import numpy as np
import pytest
import statsmodels.api as sm
import synthetic
from scipy.stats import binomtest, norm
from sklearn.metrics import roc_auc_score

from palpate.study.statistics.comparison import Comparison, compare
from palpate.study.statistics.detectability import FELT, Surface, fit, surface
from palpate.study.statistics.detection import by_contrast, froc, rates, roc
from palpate.study.statistics.estimate import Bootstrap, bound, percentiles, wilson
from palpate.study.statistics.reading import Tables


def _two(gain: float, seed: int, n: int = 60) -> Tables:
    """Two methods whose scores share a part per patient; the second separates lumps `gain` better."""
    rng = np.random.default_rng(seed)
    cases: list[dict[str, Any]] = []
    findings, lumps = [], []
    for population, ill in (("lumps", 1), ("healthy", 0)):
        for number in range(n):
            shared = rng.normal()
            for method, separation in (("palpate", 1.0), ("other", 1.0 + gain)):
                score = float(norm.cdf(0.9 * shared + 0.436 * rng.normal() + (ill - 0.5) * separation))
                false = int(not ill and score > 0.5)
                case = synthetic.case(number, population, method=method, score=score, palpable=ill, false_findings=false)
                cases.append(case)
                findings.append(synthetic.finding(case["case_id"], score, ill - 1))
                if ill:
                    lumps.append(synthetic.lump(case["case_id"], confidence=score, found=score > 0.5))
    return synthetic.tables(cases, findings, lumps)


def _compared(tables: Tables) -> Comparison:
    return compare(tables.variants[0], tables.variants[1], tables.bootstrap)


def test_the_interval_of_the_difference_has_its_nominal_coverage() -> None:
    held = 0
    true = norm.cdf(1.8 / np.sqrt(2)) - norm.cdf(1.0 / np.sqrt(2))
    for seed in range(12):
        tables = _two(0.8, seed)
        auc = compare(*tables.variants, Bootstrap.draw(tables.patients["population"].to_numpy(dtype=str), 200, seed)).auc
        held += auc.low <= true <= auc.high
    assert 10 <= held <= 12


def test_pairing_sees_what_two_separate_samples_would_not() -> None:
    paired = _compared(_two(0.4, 2, n=150)).auc
    assert paired.low > 0
    assert paired.high - paired.low < 0.1


def test_mcnemar_is_the_exact_binomial_test_of_discordant_patients() -> None:
    both = _compared(_two(1.0, 3))
    assert (both.reference, both.other, both.patients) == ("palpate", "other", 120)
    compared = both.sensitivity
    a, b = compared.only_reference, compared.only_other
    assert b > a
    assert compared.p == pytest.approx(binomtest(min(a, b), a + b).pvalue)
    assert compared.difference.value == pytest.approx((b - a) / 60)


def test_methods_that_agree_everywhere_may_still_differ_in_patients_not_seen() -> None:
    cases, lumps = [], []
    for number in range(40):
        for method in ("surface", "elastic"):
            case = synthetic.case(number, "lumps", method=method, palpable=1, score=1.0, peak_force_n=9.0 + number % 3)
            cases.append(case)
            lumps.append(synthetic.lump(case["case_id"], confidence=1.0, found=True))
    compared = _compared(synthetic.tables(cases, [], lumps))
    assert compared.sensitivity.difference.high == pytest.approx(0.0876, abs=1e-3)
    found = compared.quantities["lumps_found"]
    assert found.equivalent
    assert found.high_90 > 0


@pytest.mark.parametrize(
    ("shift", "noise", "n", "equivalent"),
    [(0.1, 0.5, 40, True), (0.8, 2.0, 40, False), (3.0, 0.5, 40, False), (0.1, 2.0, 6, False)],
)
def test_equivalence_is_shown_only_within_the_margin_and_by_enough(shift: float, noise: float, n: int, equivalent: bool) -> None:
    rng = np.random.default_rng(8)
    cases = []
    for number in range(n):
        force = 9 + rng.normal()
        cases.append(synthetic.case(number, "lumps", method="a", peak_force_n=force))
        cases.append(synthetic.case(number, "lumps", method="b", peak_force_n=force + shift + noise * rng.normal()))
    found = _compared(synthetic.tables(cases, [], [])).quantities["peak_force_n"]
    assert found.equivalent is equivalent
    assert (found.p_equivalence < 0.05) is equivalent


def test_the_wilson_interval_of_twenty_in_twenty() -> None:
    rate = wilson(20, 20, "patients")
    assert rate.low == pytest.approx(0.8389, abs=1e-4)
    assert rate.high == 1.0


def test_findings_of_one_patient_are_drawn_together() -> None:
    """Ten equal findings a patient say no more than one."""
    rng = np.random.default_rng(2)
    each = rng.normal(size=30)
    bootstrap = Bootstrap.draw(["a"] * 30)
    one = bootstrap.quantile(each, np.arange(30), 0.5)
    ten = bootstrap.quantile(np.repeat(each, 10), np.repeat(np.arange(30), 10), 0.5)
    assert one.std() == pytest.approx(ten.std(), rel=1e-9)


def test_a_rate_of_one_has_no_interval_of_width_zero() -> None:
    found = bound(1.0, np.ones(1000), 40, "lumps", 20)
    assert found.low == wilson(20, 20, "patients").low
    assert "Wilson" in found.interval


def test_replicates_that_mostly_do_not_exist_give_no_interval() -> None:
    assert percentiles(np.where(np.arange(100) < 60, np.nan, 1.0)) is None


def test_no_false_finding_in_a_hundred_healthy_has_an_upper_limit() -> None:
    cases = [synthetic.case(number, "healthy") for number in range(100)]
    tables = synthetic.tables(cases, [], [])
    false = rates(tables.variants[0], tables.bootstrap).false_findings_of_healthy
    assert false.value == 0.0
    assert false.high == pytest.approx(-np.log(0.025) / 100, rel=1e-6)


def test_the_interval_of_the_auc_has_the_width_of_hanley_and_mcneil() -> None:
    widths = []
    for seed in range(12):
        tables, true = synthetic.binormal(np.random.default_rng(seed), 40, 60, 1.2)
        populations = tables.patients["population"].to_numpy(dtype=str)
        auc = roc(tables.variants[0], Bootstrap.draw(populations, folds=200, seed=seed)).auc
        widths.append(auc.high - auc.low)
    q1, q2 = true / (2 - true), 2 * true**2 / (1 + true)
    variance = (true * (1 - true) + 39 * (q1 - true**2) + 59 * (q2 - true**2)) / (40 * 60)
    assert np.mean(widths) == pytest.approx(2 * 1.96 * np.sqrt(variance), rel=0.12)


def test_replicates_are_the_auc_of_the_drawn_patients() -> None:
    tables, _ = synthetic.binormal(np.random.default_rng(0), 15, 20, 1.0)
    curve, cases = roc(tables.variants[0], tables.bootstrap), tables.variants[0].cases
    for fold in range(5):
        count = tables.bootstrap.counts[fold][cases["patient"]]
        drawn = cases.loc[cases.index.repeat(count)]
        assert curve.replicates[fold] == pytest.approx(roc_auc_score(drawn["ill"], drawn["worst_score"]), abs=1e-12)


def _by_hand() -> synthetic.Tables:
    """Four examinations, three lumps; areas by falling confidence: hit, false, hit, false, false; the third lump is not hit."""
    cases = [synthetic.case(i, "lumps", palpable=1) for i in range(3)] + [synthetic.case(3, "healthy")]
    ids = [case["case_id"] for case in cases]
    hits = [synthetic.finding(ids[0], 0.9, 0), synthetic.finding(ids[1], 0.7, 0)]
    false = [synthetic.finding(ids[3], 0.8, -1), synthetic.finding(ids[3], 0.3, -1), synthetic.finding(ids[0], 0.2, -1)]
    lumps = [synthetic.lump(case, confidence=c, found=c > 0.5) for case, c in zip(ids[:3], (0.9, 0.7, 0.0), strict=True)]
    return synthetic.tables(cases, hits + false, lumps)


def test_froc_by_hand() -> None:
    tables = _by_hand()
    curve = froc(tables.variants[0], tables.bootstrap)
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
    assert curve.at_zero.value == 0.0
    assert curve.at[1 / 4].value == pytest.approx(0.5), "half way from none to one of both"


def test_lumps_are_counted_in_the_class_of_what_they_feel_like() -> None:
    cases, lumps = [], []
    made = [(1.2, False, 0.1), (1.4, True, 0.9), (1.4, False, 0.3), (0.5, True, 0.8), (3.0, True, 0.9)]
    for number, (contrast, found, score) in enumerate(made):
        cases.append(synthetic.case(number, "lumps", palpable=1, score=score))
        lumps.append(synthetic.lump(cases[-1]["case_id"], felt_contrast=contrast, found=found, confidence=score))
    cases += [synthetic.case(number, "healthy", score=0.2) for number in range(4)]
    tables = synthetic.tables(cases, [], lumps)
    rows = by_contrast(tables.variants[0], tables.bootstrap)
    assert list(rows) == ["below 1.3", "1.3 to 1.5", "1.5 to 2", "2 and more"]
    assert [(row.found.value, row.found.n) for row in rows.values()] == [(0.0, 1), (0.5, 2), (None, 0), (1.0, 2)]
    assert [row.auc and row.auc.value for row in rows.values()] == pytest.approx([0.0, 1.0, None, 1.0])


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


def test_a_lapse_is_fitted_only_if_there_is_one() -> None:
    assert _fitted(3, 1500, lapse=0.08, folds=2).lapse == pytest.approx(0.08, abs=0.03)
    assert _fitted(3, 1500, lapse=0.0, folds=2).lapse == 0.0


def test_no_threshold_beyond_the_lumps_of_the_study() -> None:
    beyond = _fitted(5, 400).threshold("felt_radius_m", felt_contrast=1.05, depth_m=0.12)
    assert (beyond.value, "above" in beyond.interval) == (None, True)


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
