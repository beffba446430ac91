"""The console of `palpate run`: narration of `exam/state`, its keys, and Ctrl-C at each time."""

import io
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from time import sleep
from types import SimpleNamespace
from typing import Any

import psutil
import pytest
from rich.console import Console
from waiting import wait_until

from palpate.exam_state import exam_state
from palpate.run.inputs import Outlook
from palpate.run.interrupts import all_is_measured, results_first
from palpate.run.progress import Narration, RunDisplay
from palpate_bus.messages import NS, ExamState, OperatorRequest
from palpate_bus.messages.codes import Phase, Reason
from palpate_conductor.collector import Collected
from palpate_conductor.outcome import RunProgress
from palpate_models.scenario.schema import Exam
from palpate_planning.course import PHASE_OF
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


@pytest.fixture(autouse=True)
def interrupts() -> Iterator[None]:
    """Python's own handler, which a shell replaces for a background job."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def press() -> None:
    signal.raise_signal(signal.SIGINT)


def test_the_first_ctrl_c_ends_the_examination_and_the_next_is_answered(capfd: pytest.CaptureFixture[str]) -> None:
    with results_first() as ending:
        with pytest.raises(KeyboardInterrupt):
            press()
        assert ending.asked
        press()
        assert "another Ctrl-C discards them" in capfd.readouterr().err
        with pytest.raises(KeyboardInterrupt):
            press()
    with pytest.raises(KeyboardInterrupt):
        press()


def test_once_all_is_measured_the_first_is_answered(capfd: pytest.CaptureFixture[str]) -> None:
    with results_first() as ending:
        all_is_measured()
        press()
        assert ending.asked
        assert "ending and writing" in capfd.readouterr().err
        with pytest.raises(KeyboardInterrupt):
            press()


def test_an_earlier_handler_is_still_called() -> None:
    done = []

    def hung_up(number: int, frame: Any) -> None:
        done.append(number)
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, hung_up)
    with results_first():
        all_is_measured()
        press()
    assert done == [signal.SIGINT]
    assert signal.getsignal(signal.SIGINT) is hung_up


def test_a_signal_that_is_ignored_stays_ignored() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with results_first() as ending:
        press()
    assert not ending.asked
    assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN


PATIENCE_S = 120.0
"""For the first service of the run to be started."""


def services_of(pid: int) -> list[psutil.Process]:
    """Return the services among the children of a process; it checks what users wrote in other children."""
    return [child for child in psutil.Process(pid).children() if "palpate.service" in child.cmdline()]


def test_an_interrupted_start_leaves_neither_processes_nor_a_folder(tmp_path: Path) -> None:
    out = tmp_path / "out"
    run = subprocess.Popen([sys.executable, "-m", "palpate", "run", "-o", str(out)], stderr=subprocess.PIPE, text=True)
    assert wait_until(lambda: services_of(run.pid), PATIENCE_S)
    sleep(0.5)  # some are importing by now
    services = services_of(run.pid)
    run.send_signal(signal.SIGINT)
    _, said = run.communicate(timeout=PATIENCE_S)
    assert not any(service.is_running() for service in services)
    assert run.returncode in (130, -signal.SIGINT)  # a shell makes 130 of both
    assert said.splitlines()[-1] == "palpate: interrupted"
    assert not out.exists()


def test_ctrl_c_during_the_start_is_a_line() -> None:
    """The signal is pending before the interpreter starts."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        started = subprocess.Popen([sys.executable, "-m", "palpate", "plan"], stderr=subprocess.PIPE, text=True)
        started.send_signal(signal.SIGINT)
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    _, said = started.communicate(timeout=60)
    assert started.returncode in (130, -signal.SIGINT)  # a shell makes 130 of both
    assert len(said.splitlines()) == 1
