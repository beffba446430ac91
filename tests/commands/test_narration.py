"""What the console of `palpate run` makes of `exam/state`."""

from __future__ import annotations

from typing import Any

from rich.console import Console

from palpate.exam_state import exam_state
from palpate.run.outlook import Outlook
from palpate.run.progress import PHASES, Narration, RunDisplay
from palpate_bus.messages import ExamState
from palpate_bus.messages.stamps import NS
from palpate_conductor.collector import Collected
from palpate_conductor.outcome import RunProgress
from palpate_models.scenario.schema import Exam
from palpate_planning.reasons import Reason
from palpate_planning.status import PHASE_OF, Phase
from palpate_planning.stroke import StrokeStage

EXAM = Exam(region_m=(0.10, 0.06))
TOUCHES = Outlook.of(EXAM).touches
LINES = Outlook.of(EXAM).lines


def state(phase: int, message: str, stroke: int, reason: int = ExamState.REASON_NONE) -> Any:
    return exam_state(0, phase, message=message, stroke=stroke, target_count=45, reason=reason)


def stroke(number: int, *, pressed: bool) -> list[Any]:
    stages = [StrokeStage.REST, StrokeStage.DESCEND, *([StrokeStage.SETTLE, StrokeStage.SLIDE] if pressed else [])]
    return [state(PHASE_OF[stage], stage.value, number) for stage in (*stages, StrokeStage.LIFT, StrokeStage.TRANSFER)]


def examination(before: int = 0) -> list[Any]:
    touched = [s for k in range(TOUCHES) for s in stroke(before + k + 1, pressed=False)]
    pressed = [s for k in range(LINES) for s in stroke(before + TOUCHES + k + 1, pressed=True)]
    return [state(Phase.APPROACH, "approaching the first target", before), *touched, *pressed]


def told(states: list[Any], narration: Narration | None = None) -> list[tuple[str, str]]:
    narration = narration or Narration(EXAM)
    return [news for s in states if (news := narration.news(s)) is not None]


def test_touches_and_scan_are_told_once_each_however_many_strokes_they_have() -> None:
    names = [name for name, _ in told([*examination(), state(Phase.RETURN, "returning home", 9)])]
    assert names == ["approach", "touch", "scan", "return"]


def test_the_part_counts_the_touches_and_then_is_the_scan() -> None:
    narration = Narration(EXAM)
    parts = []
    for s in examination():
        narration.news(s)
        parts.append(narration.part(s))
    assert list(dict.fromkeys(parts)) == ["approach", *(f"touch {k + 1}/{TOUCHES}" for k in range(TOUCHES)), "scan"]


def test_touches_are_no_progress_of_the_scan() -> None:
    narration = Narration(EXAM)
    shares = []
    for s in examination():
        s.target_index = 30
        narration.news(s)
        shares.append((narration.part(s).partition(" ")[0], narration.done(s)))
    assert {share for name, share in shares if name == "touch"} == {0.0}
    assert {share for name, share in shares if name == "scan"} == {30 / 45}


def test_a_patient_who_moved_is_touched_again() -> None:
    looks = state(Phase.LOOK, "the patient has moved: looking again", TOUCHES + LINES)
    names = [name for name, _ in told([*examination(), looks, *examination(TOUCHES + LINES)])]
    assert names == ["approach", "touch", "scan", "look", "approach", "touch", "scan"]


def test_what_happens_within_a_stroke_is_told_word_for_word_and_once() -> None:
    narration = Narration(EXAM)
    told(examination(), narration)
    lifts = [state(Phase.RETRACT, "no tissue felt", TOUCHES + LINES, ExamState.REASON_NO_TISSUE)] * 3
    assert told(lifts, narration) == [("scan", "no tissue felt")]


def test_every_reason_has_its_code() -> None:
    codes = {name.removeprefix("REASON_"): getattr(ExamState, name) for name in vars(ExamState) if name.startswith("REASON_")}
    assert codes == {reason.name: int(reason) for reason in Reason}


def test_every_phase_has_a_name() -> None:
    assert set(PHASES) == {getattr(ExamState, f"PHASE_{phase.name}") for phase in Phase}


def test_the_time_left_is_told_by_the_clock() -> None:
    display = RunDisplay(Console(quiet=True), True, EXAM)
    whole = Outlook.of(EXAM).duration_s

    def left(t_s: float) -> str:
        return display._left(RunProgress(int(t_s * NS), 0.25, Collected(), ()))

    assert left(whole - 75) == "about 5 min left"
    assert left(whole - 5) == "about 20 s left"
    assert left(whole + 50) == "about 0 s left"
