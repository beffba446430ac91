"""What the fault campaign makes of how a case ended."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from conductor_messages import collected, result

from palpate_benchmarks.campaign import CaseOutcome, CaseOver, FaultCase, FaultFinding, _conclude, _Watch
from palpate_benchmarks.campaign_tables import csv_text, from_csv, markdown
from palpate_bus.messages import ExamState
from palpate_bus.runtime.failure import Failure, FailureCode
from palpate_conductor.outcome import RunProgress


def watch(where: str = "planning/setpoint", target: str = "planning") -> _Watch:
    struck = FaultFinding("nan", where, "lockstep", injected_s=0.0)
    local: Any = SimpleNamespace(running={})
    return _Watch(FaultCase("nan", where, False), local, target, struck, since=1e12)


def in_phase(phase: int, message: str = "") -> RunProgress:
    messages = collected()
    last = messages.exam_states[-1]
    messages.exam_states = [*messages.exam_states, ExamState(**{**vars(last), "phase": phase, "message": message})]
    return RunProgress(0, 1.0, messages)


@pytest.mark.parametrize(
    ("phase", "outcome"),
    [
        (ExamState.PHASE_DONE, CaseOutcome.COMPLETED),
        (ExamState.PHASE_RETURN, CaseOutcome.CONTINUED),
        (ExamState.PHASE_ABORTED, CaseOutcome.ENDED),
    ],
)
def test_a_case_is_over_as_soon_as_its_outcome_is_known(phase: int, outcome: CaseOutcome) -> None:
    progress = in_phase(phase, "aborted: planning/setpoint refused")
    case = watch()
    with pytest.raises(CaseOver) as over:
        case.tell(progress)
    _conclude(case.finding, case, replace(result(progress.collected), failure=over.value.failure))
    assert case.finding.outcome is outcome
    assert case.finding.good
    assert (case.finding.sign == "") == outcome.unharmed, "a fault without effect was not noticed"


def test_what_assessment_does_shows_after_the_scan() -> None:
    watch("assessment/map", "assessment").tell(in_phase(ExamState.PHASE_RETURN))
    watch().tell(in_phase(ExamState.PHASE_SCAN))


def test_an_end_that_names_nobody_is_bad() -> None:
    case = watch()
    _conclude(case.finding, case, replace(result(collected()), failure=Failure(FailureCode.BLOCKED, "something went wrong")))
    assert not case.finding.good


def test_the_page_sums_up_and_marks_what_is_bad() -> None:
    fine = FaultFinding(
        "kill", "robot", "lockstep", 8.0, 20.0, "robot lost", "run ended", 5.0, 5.5, CaseOutcome.ENDED, "robot lost", True
    )
    slow = FaultFinding(
        "kill", "tissue", "lockstep", 8.0, 40.0, "tissue lost", "run ended", 5.0, 26.0, CaseOutcome.ENDED, "tissue lost", True
    )
    page = markdown([fine, slow])
    assert "1 of 2 as they should be; the largest force was 26.0 N." in page
    assert "| lockstep | kill | 2 | 1 | 2 | 30, 40 | 26.0 | run ended 2 |" in page
    assert "**!** lockstep, kill tissue: tissue lost" in page
    assert "robot lost" not in page
    assert [line.rsplit(",", 1)[1] for line in csv_text([fine, slow]).splitlines()] == ["good", "True", "False"]


def test_findings_come_back_from_their_file() -> None:
    found = [
        FaultFinding(
            "kill",
            "robot",
            "lockstep",
            15.5,
            33.2,
            'robot, "gone"\nat once',
            "safe hold",
            6.0,
            None,
            CaseOutcome.ENDED,
            "x",
            named=True,
        ),
        FaultFinding("nan", "exam/state", "wall clock", hung=True, left_behind="/tmp/x", kept=False),
    ]
    assert from_csv(csv_text(found)) == found


def test_a_file_of_other_columns_is_refused() -> None:
    with pytest.raises(ValueError, match="wants the columns kind, where"):
        from_csv("mode,fault\nlockstep,kill\n")
