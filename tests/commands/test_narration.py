"""The console of `palpate run`: narration of `exam/state`, and its keys."""

import os
import pty
import sys
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

from rich.console import Console

from palpate.exam_state import exam_state
from palpate.run.inputs import Outlook
from palpate.run.progress import PHASES, Narration, RunDisplay
from palpate_bus.messages import NS, ExamState, OperatorRequest
from palpate_bus.messages.codes import Phase, Reason
from palpate_conductor.collector import Collected
from palpate_conductor.outcome import RunProgress
from palpate_models.scenario.schema import Exam
from palpate_planning.status import PHASE_OF
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


def narrated(states: list[Any], narration: Narration | None = None) -> list[tuple[str, str]]:
    narration = narration or Narration(EXAM)
    return [news for s in states if (news := narration.news(s)) is not None]


def test_touches_and_scan_are_narrated_once_each() -> None:
    names = [name for name, _ in narrated([*examination(), state(Phase.RETURN, "returning home", 9)])]
    assert names == ["approach", "touch", "scan", "return"]


def test_a_wait_is_printed_once_at_each_target() -> None:
    narration = Narration(EXAM)
    narrated(examination(), narration)
    waits, rests = (
        state(Phase.INDENT, "waiting for it", 9, Reason.WAITS_FOR_WALL),
        state(Phase.INDENT, StrokeStage.REST.value, 9),
    )
    later = [replace(s, target_index=20) for s in (rests, waits, rests, waits)]
    assert [text for _, text in narrated([rests, waits, rests, waits, *later], narration)] == ["waiting for it"] * 2


def test_a_patient_who_moved_is_touched_again() -> None:
    looks = state(Phase.LOOK, "the patient has moved: looking again", TOUCHES + LINES)
    names = [name for name, _ in narrated([*examination(), looks, *examination(TOUCHES + LINES)])]
    assert names == ["approach", "touch", "scan", "look", "approach", "touch", "scan"]


def test_every_phase_has_a_name() -> None:
    assert set(PHASES) == set(Phase)


def test_the_time_left() -> None:
    display = RunDisplay(Console(quiet=True), True, EXAM)
    whole = Outlook.of(EXAM).duration_s

    def left(t_s: float) -> str:
        return display._time_left(RunProgress(int(t_s * NS), 0.25, Collected(), ()))

    assert left(whole - 75) == "about 5 min left"
    assert left(whole - 5) == "about 20 s left"
    assert left(whole + 50) == "about 0 s left"


def show_keys() -> None:
    """Show a run in this terminal until three requests were made, and print them."""
    collected, asked = Collected(), list[int]()

    def request(number: int, reason: str) -> None:
        asked.append(number)
        stops = number in (OperatorRequest.STOP, OperatorRequest.SOFT_STOP)
        collected.supervisor = SimpleNamespace(level=int(stops), reason="an operator" if stops else "")

    with RunDisplay(Console(stderr=True, width=200), False, Exam()) as display:
        while len(asked) < 3:
            display.show(RunProgress(0, 1.0, collected, (), request))
            time.sleep(0.01)
    print("asked", asked, flush=True)


def test_keys_of_palpate_run() -> None:
    child, end = pty.fork()
    if child == 0:
        os.execv(sys.executable, [sys.executable, __file__])
    text, sent = "", 0
    while True:
        try:
            text += os.read(end, 4096).decode(errors="ignore")
        except OSError:  # the terminal closes with its process
            break
        if "keys: s soft stop" in text and sent == text.count("stop: passed on"):
            os.write(end, b"ser"[sent : sent + 1])
            sent += 1
    _, status = os.waitpid(child, 0)
    os.close(end)
    assert status == 0, text
    assert f"asked {[OperatorRequest.SOFT_STOP, OperatorRequest.STOP, OperatorRequest.RELEASE]}" in text
    assert "stopped: an operator" in text


if __name__ == "__main__":
    show_keys()
