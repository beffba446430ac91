"""study.json and study.html of synthetic studies; reading of their tables and errors of findings."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import synthetic

from palpate.quick.errors import LEAST_EXAMINATIONS
from palpate.study.statistics.accuracy import calibration, finding_errors
from palpate.study.statistics.detection import by_population, rates, roc
from palpate.study.statistics.estimate import Bootstrap
from palpate.study.statistics.reading import Tables, read_tables, tables_of
from palpate.study.summary import StudySummary, summarise
from palpate_errors import UserError

FOLDS = 30
COMMAND = "palpate study toy --split test"


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two methods on 40 patients with a lump and 30 without, one case failed."""
    folder = tmp_path_factory.mktemp("study")
    rng = np.random.default_rng(9)
    cases, findings, lumps = [], [], []
    for population, count in (("lumps", 40), ("healthy", 30)):
        for number in range(count):
            radius, contrast, depth = rng.uniform(0.005, 0.025), rng.uniform(1.1, 2), rng.uniform(0, 0.02)
            for method in ("palpate", "<other> & co"):
                case = synthetic.case(number, population, method=method, palpable=int(population == "lumps"))
                if population == "lumps":
                    row = synthetic.lump(case["case_id"], felt_radius_m=radius, felt_contrast=contrast, depth_m=depth)
                    score = float(synthetic.true_probability(pd.DataFrame([row]))[0] * 0.8 + 0.2 * rng.random())
                    lumps.append(row | {"confidence": score, "found": score > 0.5})
                    findings.append(synthetic.finding(case["case_id"], score, 0))
                    case["score"] = score
                elif number % 5 == 0:
                    findings.append(synthetic.finding(case["case_id"], 0.6, -1))
                    case |= {"score": 0.6, "false_findings": 1}
                cases.append(case)
    cases[-1] |= {"status": "failed", "completed": False, "score": np.nan}
    synthetic.write(folder, synthetic.frames(cases, findings, lumps))
    summarise(folder, COMMAND, FOLDS)
    return folder


def test_every_figure_has_its_sample_size_and_interval(study: Path) -> None:
    summary = StudySummary.model_validate_json((study / "study.json").read_bytes())
    assert (summary.patients, summary.reference) == ({"healthy": 30, "lumps": 40}, "palpate")
    for row in summary.methods.values():
        for estimate in (row.auc, row.froc_mean, row.rates.lump_sensitivity, row.rates.specificity, row.errors.place_mean_m):
            assert estimate.low <= estimate.value <= estimate.high
            assert estimate.n >= 20
    assert [row.rates.failed for row in summary.methods.values()] == [0, 1]
    assert summary.human["found"] == 0.44


def test_the_page_holds_everything_and_loads_nothing(study: Path) -> None:
    text = (study / "study.html").read_text(encoding="utf-8")
    assert not re.findall(r"""(?:src|<link[^>]*href)=["']?(?!data:|#)""", text)
    parts = {"figures", "roc", "froc", "comparisons", "equivalence", "reliability"}
    assert parts <= set(re.findall(r'<\w+[^>]* id="(\w+)"', text))
    assert text.count("<svg") >= 6
    assert "<other>" not in text
    assert "prefers-color-scheme: dark" in text


def test_the_same_tables_give_the_same_bytes(study: Path) -> None:
    before = [(study / name).read_bytes() for name in ("study.json", "study.html")]
    summarise(study, COMMAND, FOLDS)
    assert [(study / name).read_bytes() for name in ("study.json", "study.html")] == before


@pytest.mark.parametrize("behind", [LEAST_EXAMINATIONS - 1, LEAST_EXAMINATIONS])
def test_a_quick_study_of_healthy_people_has_a_page_and_may_be_quoted_if_its_loop_was_fitted(tmp_path: Path, behind: int) -> None:
    cases = [synthetic.case(i, "healthy", tier="quick", loop_examinations=behind) for i in range(3)]
    synthetic.write(tmp_path, synthetic.frames(cases, [], []))
    summarise(tmp_path, COMMAND, FOLDS)
    row = StudySummary.model_validate_json((tmp_path / "study.json").read_bytes()).methods["palpate"]
    assert row.auc is None
    assert row.rates.specificity.value == 1.0
    assert ("Not to be quoted" in (tmp_path / "study.html").read_text(encoding="utf-8")) == (behind < LEAST_EXAMINATIONS)


FAILED = {"status": "failed", "completed": False, "score": np.nan, "palpable": np.nan, "not_palpable": np.nan}


def test_a_failed_case_counts_as_a_miss_or_a_false_finding() -> None:
    cases = [synthetic.case(i, "lumps", palpable=1, score=0.9) for i in range(4)]
    cases += [synthetic.case(i, "healthy", score=0.1) for i in range(4)]
    lumps = [synthetic.lump(case["case_id"], found=True, confidence=0.9) for case in cases[:4]]
    for i in (0, 4):
        cases[i] |= FAILED
    tables = synthetic.tables(cases, [], lumps)
    after = rates(tables.variants[0], tables.bootstrap)
    assert (after.sensitivity.value, after.specificity.value, after.failed) == (0.75, 0.75, 2)
    assert (after.lump_sensitivity.value, after.false_findings_of_healthy.value) == (0.75, 0.25)
    auc = roc(tables.variants[0], tables.bootstrap).auc.value
    assert auc == pytest.approx(9 / 16), "each failed case is beyond all others on the wrong side"


def test_an_examination_that_did_not_come_to_its_end_counts_as_failed() -> None:
    cases = [synthetic.case(0, "lumps", palpable=1, completed=False), synthetic.case(1, "lumps", palpable=1)]
    lumps = [synthetic.lump(case["case_id"], found=True, confidence=0.9) for case in cases]
    tables = synthetic.tables(cases, [synthetic.finding(cases[0]["case_id"], 0.9, 0)], lumps)
    found = rates(tables.variants[0], tables.bootstrap)
    assert (found.failed, found.not_completed, found.sensitivity.value) == (0, 1, 0.5)
    assert tables.variants[0].findings.empty


def test_a_patient_of_a_failed_case_is_known_from_another_method() -> None:
    """The patient has two lumps, of which one cannot be felt."""
    ok, bad = (synthetic.case(0, "lumps", method=m, palpable=1, not_palpable=1) for m in ("a", "b"))
    bad |= FAILED
    lumps = [synthetic.lump(case["case_id"], lump=i) for case in (ok, bad) for i in range(2)]
    tables = synthetic.tables([ok, bad], [], lumps)
    assert [variant.cases["lumps"].sum() for variant in tables.variants] == [1, 1]


def test_a_patient_known_from_nowhere_has_all_their_lumps() -> None:
    case = synthetic.case(0, "lumps") | FAILED
    lumps = [synthetic.lump(case["case_id"], lump=i, palpable=None, felt_contrast=np.nan) for i in range(2)]
    frames = synthetic.frames([case], [], [])
    tables = tables_of(frames[0], frames[1], pd.DataFrame(lumps))
    assert tables.variants[0].cases["lumps"].tolist() == [2]


def test_a_patient_whose_lump_cannot_be_felt_is_left_out() -> None:
    cases = [synthetic.case(0, "lumps", not_palpable=1), synthetic.case(1, "lumps", palpable=1), synthetic.case(0, "healthy")]
    tables = synthetic.tables(cases, [], [])
    found = rates(tables.variants[0], tables.bootstrap)
    assert (found.left_out, found.sensitivity.n, found.specificity.n) == (1, 1, 1)


def test_levels_of_errors_are_variants_and_populations_are_not() -> None:
    cases = [synthetic.case(0, "healthy", errors=level) for level in ("typical", "camera.noise_m=poor")]
    assert [v.name for v in synthetic.tables(cases, [], []).variants] == ["typical", "camera.noise_m=poor"]
    cases = [synthetic.case(0, "still", errors="none"), synthetic.case(0, "healthy", errors="typical")]
    tables = synthetic.tables(cases, [], [])
    assert [v.name for v in tables.variants] == ["palpate"]
    assert set(by_population(tables.variants[0], tables.bootstrap)) == {"still", "healthy"}


def test_two_cases_of_one_patient_by_one_method_are_refused() -> None:
    cases = [synthetic.case(3, "healthy"), synthetic.case(3, "healthy", case_id="again")]
    with pytest.raises(UserError, match="number 3"):
        synthetic.tables(cases, [], [])


def test_tables_that_are_missing_or_of_another_version_are_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"cases\.parquet"):
        read_tables(tmp_path)
    frames = synthetic.frames([synthetic.case(0, "healthy")], [], [])
    with pytest.raises(UserError, match="confidence"):
        read_tables(synthetic.write(tmp_path, (frames[0], frames[1].drop(columns="confidence"), frames[2])))
    with pytest.raises(UserError, match="no case"):
        read_tables(synthetic.write(tmp_path, (frames[0].iloc[:0], frames[1], frames[2])))


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
    errors = finding_errors(tables.variants[0], tables.bootstrap)
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
    errors = finding_errors(tables.variants[0]._replace(findings=findings), tables.bootstrap)
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


def test_confidences_that_are_too_sure() -> None:
    found = calibration(_areas(600, 2.0).variants[0], Bootstrap.draw(["lumps"] * 600, 80))
    assert found.slope.value == pytest.approx(0.5, abs=0.08)
    assert found.slope.high < 0.8
    assert (found.expected_error.low or 0) > 0.05
