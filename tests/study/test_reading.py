"""Tables of studies: failed cases count against a method, and unusable tables are refused."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import synthetic

from palpate.study.statistics.detection import by_population, rates, roc
from palpate.study.statistics.reading import read_tables, tables_of
from palpate_errors import UserError

FAILED = {"status": "failed", "completed": False, "score": np.nan, "palpable": np.nan, "not_palpable": np.nan}


def test_a_failed_case_counts_as_a_miss_or_a_false_finding() -> None:
    cases = [synthetic.case(i, "lumps", palpable=1, score=0.9) for i in range(4)]
    cases += [synthetic.case(i, "healthy", score=0.1) for i in range(4)]
    lumps = [synthetic.lump(case["case_id"], found=True, confidence=0.9) for case in cases[:4]]
    whole = synthetic.tables(cases, [], lumps)
    for i in (0, 4):
        cases[i] |= FAILED
    tables = synthetic.tables(cases, [], lumps)
    before, after = (rates(each.variants[0], each.bootstrap) for each in (whole, tables))
    assert (before.sensitivity.value, before.specificity.value) == (1.0, 1.0)
    assert (after.sensitivity.value, after.specificity.value, after.failed) == (0.75, 0.75, 2)
    assert after.lump_sensitivity.value == 0.75
    assert after.false_findings_of_healthy.value == 0.25
    curve = roc(tables.variants[0], tables.bootstrap)
    assert curve.auc.value == pytest.approx(9 / 16), "each failed case is beyond all others on the wrong side"


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
