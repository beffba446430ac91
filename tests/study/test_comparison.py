"""Paired comparisons of methods whose difference is known."""

from typing import Any

import numpy as np
import pytest
import synthetic
from scipy.stats import binomtest, norm

from palpate.study.statistics.comparison import Comparison, compare
from palpate.study.statistics.estimate import Bootstrap
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
