"""Errors and calibration of findings whose errors are known."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import synthetic

from palpate.study.statistics.accuracy import calibration, finding_errors, guarding
from palpate.study.statistics.estimate import Bootstrap
from palpate.study.statistics.reading import Tables, tables_of


def _matched(n: int, seed: int = 0) -> Tables:
    """Radius too great by 1 mm with 0.5 mm of noise; ratio 5 % too small with 3 %; bands that hold it in 80 %."""
    rng = np.random.default_rng(seed)
    cases = [synthetic.case(i, "lumps", palpable=1) for i in range(n)]
    findings = []
    for i, case in enumerate(cases):
        radius, ratio = rng.uniform(0.01, 0.02), rng.uniform(1.2, 2.0)
        felt = radius + rng.normal(0.001, 0.0005)
        findings.append(
            synthetic.finding(
                case["case_id"], 0.9, 0, place_error_m=rng.rayleigh(0.003), area_true_m2=np.pi * radius**2,
                area_m2=np.pi * felt**2, ratio_true=ratio, ratio=ratio * np.exp(rng.normal(np.log(0.95), 0.03)),
                ratio_lower=ratio * (1.1 if i % 5 == 0 else 0.8), ratio_upper=ratio * 1.2,
            )
        )  # fmt: skip
    return synthetic.tables(cases, findings, [])


def test_bias_and_limits_of_agreement() -> None:
    tables = _matched(400)
    errors = finding_errors(tables.variants[0], tables.bootstrap).figures
    for line, true in ((errors.radius_m.bias, 1e-3), (errors.radius_m.lower, 1e-3 - 0.98e-3), (errors.radius_m.upper, 1.98e-3)):
        assert line.value == pytest.approx(true, abs=1e-4)
        assert line.low <= true <= line.high
        assert line.high - line.low < 3e-4
    assert errors.log_ratio.bias.value == pytest.approx(np.log(0.95), abs=0.005)
    assert errors.ratio_held.value == pytest.approx(0.8)
    assert errors.place_mean_m.value == pytest.approx(0.003 * np.sqrt(np.pi / 2), rel=0.1)


def test_candidates_and_false_findings_are_no_matched_findings() -> None:
    tables = _matched(30)
    findings = tables.variants[0].findings.copy()
    findings.loc[findings.index[:10], "reported"] = False
    findings.loc[findings.index[10:15], "lump"] = -1
    errors = finding_errors(replace(tables.variants[0], findings=findings), tables.bootstrap).figures
    assert errors.place_mean_m.n == 15


def _areas(n: int, power: float, seed: int = 0) -> Tables:
    """Areas that hit with probability p and say the confidence whose log odds are `power` times those of p."""
    rng = np.random.default_rng(seed)
    cases, findings = [], []
    for i in range(n):
        case = synthetic.case(i, "lumps", palpable=1)
        odds = rng.normal(0, 1.5, 2)
        hit = rng.random(2) < 1 / (1 + np.exp(-odds))
        said = 1 / (1 + np.exp(-power * odds))
        findings += [synthetic.finding(case["case_id"], float(p), int(h) - 1) for p, h in zip(said, hit, strict=True)]
        cases.append(case)
    return synthetic.tables(cases, findings, [])


def test_confidences_that_are_right() -> None:
    held, less = 0, 0
    for seed in range(10):
        calibrated = calibration(_areas(200, 1.0, seed).variants[0], Bootstrap.draw(["lumps"] * 200, 80, seed))
        found = calibrated.figures
        held += found.slope.low <= 1.0 <= found.slope.high
        less += (found.expected_error.value or 0) < found.expected_error_by_chance
        assert sum(part.n for _, part in calibrated.bins) == 400
    assert held >= 8
    assert less >= 8


def test_confidences_that_are_too_sure() -> None:
    calibrated = calibration(_areas(600, 2.0).variants[0], Bootstrap.draw(["lumps"] * 600, 80))
    found = calibrated.figures
    assert found.slope.value == pytest.approx(0.5, abs=0.08)
    assert found.slope.high < 0.8
    assert (found.expected_error.value or 0) > 2 * found.expected_error_by_chance


def test_probabilities_of_a_tensed_muscle_are_judged_by_the_areas_on_muscles() -> None:
    rng = np.random.default_rng(0)
    cases = [synthetic.case(i, "guarding") for i in range(400)]
    findings = []
    for case in cases:
        stated = float(rng.uniform(0.0, 1.0))
        findings.append(synthetic.finding(case["case_id"], 0.1, -1, guarding=stated, on_guarding=bool(rng.random() < stated)))
    tables = synthetic.tables(cases, findings, [])
    calibrated = guarding(tables.variants[0], Bootstrap.draw(["guarding"] * 400, 80))
    assert calibrated.figures.slope.value == pytest.approx(1.0, abs=0.2)
    assert abs(calibrated.figures.in_the_large.value or 0) < 0.05


def test_without_muscles_or_in_an_older_table_there_is_no_such_calibration() -> None:
    without = _areas(20, 1.0)
    assert guarding(without.variants[0], without.bootstrap) is None
    findings = [{k: v for k, v in synthetic.finding("a", 0.4, -1).items() if "guarding" not in k}]
    older = tables_of(
        pd.DataFrame([synthetic.case(0, "a") | {"case_id": "a"}]), pd.DataFrame(findings), synthetic.frames([], [], [])[2]
    )
    assert guarding(older.variants[0], older.bootstrap) is None


def test_no_area_no_calibration() -> None:
    tables = synthetic.tables([synthetic.case(0, "healthy")], [], [])
    assert calibration(tables.variants[0], tables.bootstrap) is None
