"""Cases under names made from their content, and the seeds of patients."""

from __future__ import annotations

from pathlib import Path

import pytest
from toy_study import TOY, study

from palpate.study.cases import Request, cases_of, command_of, patient_seeds, secret_of
from palpate.study.folder import Folder, manifest_of
from palpate.study.spec import StudyError


def test_ids_do_not_depend_on_what_things_are_called() -> None:
    (one, *_), (other, *_) = cases_of(study()), cases_of(study(methods={"another-name": {}}))
    assert one.case_id == other.case_id
    assert one.method != other.method


@pytest.mark.parametrize(
    "changes",
    [
        {"tier": "quick"},
        {"errors": {"poor": "poor"}},
        {"methods": {"m": {"settings": {"exam.depth_m": 0.008}}}},
        {"methods": {"m": {"periods": {"control": 5}}}},
        {"salt": "another"},
    ],
)
def test_ids_depend_on_everything_that_decides_a_result(changes: dict[str, object]) -> None:
    ids = {case.case_id for case in cases_of(study(tier="whole"))}
    assert ids.isdisjoint(case.case_id for case in cases_of(study(**{"tier": "whole", **changes})))


@pytest.mark.parametrize("field", ["services.assessment", "exam.pattern", "search.policy"])
def test_ids_depend_on_what_is_in_a_file_and_not_on_where_it_is(tmp_path: Path, field: str) -> None:
    found = []
    for folder, text in (("a", "1"), ("b", "1"), ("c", "2")):
        path = tmp_path / folder / "mine.py"
        path.parent.mkdir()
        path.write_text(f"def create(scenario): return {text}\nscan = next_press = create\n")
        settings = {"exam.pattern": "search"} if field == "search.policy" else {}
        found.append(cases_of(study(methods={"m": {"settings": {**settings, field: str(path)}}}))[0].case_id)
    assert found[0] == found[1] != found[2]


def test_the_command_says_all_that_was_asked_for() -> None:
    request = Request("tune", 8, ("search.policy=my own.py", "errors=poor"), "secret")
    words = "--set 'search.policy=my own.py' --set errors=poor --seeds-file FILE"
    assert command_of("mine.yaml", request, ["a"], ["assessment=b.py"]) == (
        f"palpate study mine.yaml --split tune --number 8 --method a --service assessment=b.py {words}"
    )
    assert command_of("release", Request()) == "palpate study release --split test"


def test_patients_are_the_same_for_all_methods_and_errors() -> None:
    cases = cases_of(
        study(errors={"none": "none", "poor": "poor"}, methods={"a": {}, "b": {"settings": {"exam.depth_m": 0.008}}})
    )
    for number in range(3):
        assert len({case.seed for case in cases if case.number == number}) == 1
    assert len({case.case_id for case in cases}) == len(cases) == 12


def test_two_names_for_one_examination_are_refused() -> None:
    with pytest.raises(StudyError, match="clean 0 b none and clean 0 a none are the same examination"):
        cases_of(study(methods={"a": {}, "b": {}}))


def test_splits_share_no_patient_and_more_patients_change_none() -> None:
    tune, test = (patient_seeds("s", "p", split, 300, "salt") for split in ("tune", "test"))
    assert len(set(tune)) == len(set(test)) == 300
    assert max(tune) < 1000 <= min(test)
    assert patient_seeds("s", "p", "tune", 100, "salt") == tune[:100]
    assert len(set(patient_seeds("s", "p", "tune", 1000, ""))) == 1000


def test_a_salt_changes_the_patients_of_the_split_test_alone() -> None:
    for split in ("tune", "test"):
        same = patient_seeds("s", "p", split, 5, "one") == patient_seeds("s", "p", split, 5, "two")
        assert same == (split == "tune")


def test_a_held_out_study_needs_its_own_file_of_seeds(tmp_path: Path) -> None:
    secret, wrong = tmp_path / "secret", tmp_path / "wrong"
    secret.write_bytes(b"0123456789")
    wrong.write_bytes(b"9876543210")
    held_out = study(seeds_sha256="84d89877f0d4041efb6bf91a16f0248f2fd573e6af05c19f96bedb9f882f7882")
    with pytest.raises(StudyError, match="--seeds-file"):
        cases_of(held_out)
    with pytest.raises(StudyError, match="its SHA-256 is"):
        secret_of(wrong, held_out)
    hidden = cases_of(held_out, Request(secret=secret_of(secret, held_out)))
    assert {case.seed for case in hidden}.isdisjoint(case.seed for case in cases_of(study()))
    assert [case.seed for case in cases_of(held_out, Request("tune"))] == [
        case.seed for case in cases_of(study(), Request("tune"))
    ]


def test_no_patient_at_all_is_refused() -> None:
    empty = {**TOY["populations"]["clean"], "number": {}}
    with pytest.raises(StudyError, match=r"number\.test"):
        cases_of(study(populations={"clean": empty}))


def test_a_folder_holds_the_cases_of_one_request(tmp_path: Path) -> None:
    Folder(tmp_path).open(manifest_of("toy", cases_of(study(), Request("test", 1))))
    Folder(tmp_path).open(manifest_of("toy", cases_of(study(), Request("test", 3))))
    poor = cases_of(study(), Request("test", 3, ("errors=poor",)))
    with pytest.raises(StudyError, match="other settings or patients: give this one another folder with -o"):
        Folder(tmp_path).open(manifest_of("toy", poor))
