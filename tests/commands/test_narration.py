"""The console of `palpate run`: narration of `exam/state`, and its keys."""

import io
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from palpate.exam_state import exam_state
from palpate.run.inputs import Outlook
from palpate.run.progress import Narration, RunDisplay
from palpate_bus.messages import NS, ExamState, OperatorRequest
from palpate_bus.messages.codes import Phase, Reason
from palpate_conductor.collector import Collected
from palpate_conductor.outcome import RunProgress
from palpate_models.scenario.schema import Exam
from palpate_planning.status import PHASE_OF
from palpate_planning.stroke import StrokeStage

EXAM = Exam(region_m=(0.10, 0.06))
OUTLOOK = Outlook.of(EXAM)
TOUCHES, LINES = OUTLOOK.touches, OUTLOOK.lines


def state(phase: int, message: str, stroke: int, reason: int = ExamState.REASON_NONE) -> Any:
    return exam_state(0, phase, message=message, stroke=stroke, target_count=45, reason=reason)


def stroke(number: int, *, pressed: bool) -> list[Any]:
    stages = [StrokeStage.REST, StrokeStage.DESCEND, *([StrokeStage.SETTLE, StrokeStage.SLIDE] if pressed else [])]
    return [state(PHASE_OF[stage], stage.value, number) for stage in (*stages, StrokeStage.LIFT, StrokeStage.TRANSFER)]


def examination(before: int = 0) -> list[Any]:
    touched = [s for k in range(TOUCHES) for s in stroke(before + k + 1, pressed=False)]
    pressed = [s for k in range(LINES) for s in stroke(before + TOUCHES + k + 1, pressed=True)]
    return [state(Phase.APPROACH, "approaching the first target", before), *touched, *pressed]


def narrated(states: list[Any], narration: Narration | None = None) -> list[tuple[str, str]]:
    narration = narration or Narration(EXAM)
    return [news for s in states if (news := narration.news(s)) is not None]


def test_a_wait_is_printed_once_at_each_target() -> None:
    narration = Narration(EXAM)
    narrated(examination(), narration)
    waits = state(Phase.INDENT, "waiting for it", 9, Reason.WAITS_FOR_WALL)
    rests = state(Phase.INDENT, StrokeStage.REST.value, 9)
    later = [replace(s, target_index=20) for s in (rests, waits, rests, waits)]
    assert [text for _, text in narrated([rests, waits, rests, waits, *later], narration)] == ["waiting for it"] * 2


def test_touches_and_scan_are_narrated_once_each_and_again_for_a_patient_who_moved() -> None:
    looks, returns = state(Phase.LOOK, "looking again", TOUCHES + LINES), state(Phase.RETURN, "returning home", 9)
    names = [name for name, _ in narrated([*examination(), looks, *examination(TOUCHES + LINES), returns])]
    assert names == ["approach", "touch", "scan", "look", "approach", "touch", "scan", "return"]


def test_the_time_left() -> None:
    display = RunDisplay(Console(quiet=True), True, EXAM)
    for left_s, shown in ((75, "about 5 min left"), (5, "about 20 s left"), (-50, "about 0 s left")):
        t = int((OUTLOOK.duration_s - left_s) * NS)
        assert display._time_left(RunProgress(t, 0.25, Collected(), ())) == shown


def test_keys_of_palpate_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests of the dashboard press such keys in a terminal."""
    collected, asked, pressed, printed = Collected(), list[int](), ["soft-stop", "stop", "release"], io.StringIO()

    def request(number: int, reason: str) -> None:
        asked.append(number)
        stops = number != OperatorRequest.RELEASE
        collected.supervisor = SimpleNamespace(level=int(stops), reason="an operator" if stops else "")

    monkeypatch.setattr("palpate_bus.runs.operator.OperatorKeys.read_requests", lambda _: pressed[len(asked) : len(asked) + 1])
    with RunDisplay(Console(file=printed, force_terminal=True, width=200), False, Exam()) as display:
        for _ in pressed:
            display.show(RunProgress(0, 1.0, collected, (), request))
    assert asked == [OperatorRequest.SOFT_STOP, OperatorRequest.STOP, OperatorRequest.RELEASE]
    assert "stopped: an operator" in printed.getvalue()
    assert "released" in printed.getvalue()
