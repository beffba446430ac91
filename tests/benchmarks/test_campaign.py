"""The fault campaign: its faults, its cases, and the judgement of a case."""

import signal
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conductor_messages import collected, result
from toy_runs import toy_services
from typer.testing import CliRunner

from palpate.commands import app_for
from palpate_benchmarks import injection
from palpate_benchmarks.campaign import cases, draw_cases, judge, prepare, run_case
from palpate_benchmarks.fault_cases import CaseOutcome, CaseResult, FaultCase, csv_text, from_csv
from palpate_benchmarks.faulty import JUMP_NS, FaultySender, FaultyTransport, InjectedFault
from palpate_benchmarks.injection import ROLES, CaseOver, FaultLog, FaultResult, FaultRun, FaultTimes, FaultWatch, examination
from palpate_benchmarks.liar import INJECTED
from palpate_bus.contract import CONDUCTOR, contract
from palpate_bus.messages import NS, ExamState, codec, nanoseconds
from palpate_bus.runtime.conductor_link import CONDUCTOR_LOST_LOG
from palpate_bus.runtime.failure import Failure, FailureCode
from palpate_bus.wire.rmw import topic_key
from palpate_bus.wire.zenoh_config import BusOptions, session
from palpate_conductor.outcome import RunProgress
from palpate_errors import ExitStatus

TOPIC = contract().topics["control/joint_torque"]


def sent(kind: str, count: int = 1, messages: int = 5) -> list[tuple[int, bytes]]:
    out: list[tuple[int, bytes]] = []
    to: Any = SimpleNamespace(put=lambda payload, sequence: out.append((sequence, payload)))
    sender = FaultySender(to, TOPIC, InjectedFault(TOPIC.name, kind, count, at=2_000_000), lambda: False)
    payload = codec.encode(toy_services.torque_command(7_000_000_000_000, np.arange(7.0)), TOPIC.type)
    for sequence in range(1, messages + 1):
        sender.put(payload, sequence)
    return out


def test_a_fault_begins_at_its_time_and_hits_its_number_of_messages() -> None:
    assert [sequence for sequence, _ in sent("drop")] == [1, 2, 4, 5]
    assert [sequence for sequence, _ in sent("drop", count=0)] == [1, 2]
    assert [sequence for sequence, _ in sent("duplicate")] == [1, 2, 3, 3, 4, 5]


def test_nan_is_in_every_float_and_nowhere_else() -> None:
    message = codec.decode(sent("nan")[2][1], TOPIC.type)
    assert np.isnan(message.torque).all()
    assert nanoseconds(message.valid_for) == 50_000_000
    assert not np.isnan(codec.decode(sent("nan")[3][1], TOPIC.type).torque).any()


def test_a_transport_is_faulty_in_its_topic_only_and_from_the_signal_on() -> None:
    qos = contract().qos["control"]
    with session(BusOptions()) as opened:
        transport = FaultyTransport(opened, InjectedFault(TOPIC.name, "nan", at=0))
        for topic in (TOPIC, contract().topics["joint_states"]):
            publisher = transport.publisher(topic.name, topic_key(topic, 0), qos, bytes(16))
            assert isinstance(publisher, FaultySender) == (topic is TOPIC)
        late = FaultyTransport(opened, InjectedFault("clock", "jump"))
        before = late.now()
        assert before < late.now() < before + NS
        signal.raise_signal(signal.SIGUSR1)
        assert JUMP_NS <= late.now() - before < 2 * JUMP_NS


def watch(**options: Any) -> FaultWatch:
    """Return the watch of a run whose fault was due long ago."""
    due = FaultWatch(FaultRun(Path(), **{"early": True, **options}))
    due.since = 0.0
    return due


def in_phase(phase: int, culprit: str = "") -> RunProgress:
    messages = collected()
    last = messages.exam_states[-1]
    messages.exam_states = [*messages.exam_states, ExamState(**{**vars(last), "phase": phase, "culprit": culprit})]
    return RunProgress(0, 1.0, messages)


def judged(log: FaultLog | None, folder: Path, kind: str, where: str, status: int = 0) -> CaseResult:
    case = CaseResult(kind, where, "lockstep")
    if log is not None:
        (folder / "logs").mkdir()
        (folder / "logs" / "planning.log").write_text(f"2026 planning WARNING {INJECTED % where}\n", encoding="utf-8")
    judge(case, FaultResult(folder, folder / "gone", status, log, 8.0), where.split("+"))
    return case


@pytest.mark.parametrize(
    ("phase", "outcome"),
    [
        (ExamState.PHASE_DONE, CaseOutcome.COMPLETED),
        (ExamState.PHASE_RETURN, CaseOutcome.CONTINUED),
        (ExamState.PHASE_ABORTED, CaseOutcome.ENDED),
    ],
)
def test_a_case_is_over_as_soon_as_its_outcome_is_known(phase: int, outcome: CaseOutcome, tmp_path: Path) -> None:
    progress = in_phase(phase, "planning/setpoint")
    watched = watch()
    with pytest.raises(CaseOver) as over:
        watched.on_progress(progress)
    log = watched.finish(replace(result(progress.collected), failure=over.value.failure))
    case = judged(log, tmp_path, "nan", "planning/setpoint")
    assert case.outcome is outcome
    assert case.passed
    assert (case.sign == "") == outcome.unharmed, "a fault without effect was not noticed"


def test_a_fault_of_the_assessment_shows_after_the_scan(tmp_path: Path) -> None:
    assert not prepare(FaultCase("nan", "assessment/map", False), tmp_path, 1.0)[0].early
    assert prepare(FaultCase("nan", "planning/setpoint", False), tmp_path, 1.0)[0].early
    watch(early=False).on_progress(in_phase(ExamState.PHASE_RETURN))
    watch().on_progress(in_phase(ExamState.PHASE_SCAN))


def test_the_fault_is_due_in_its_phase(capsys: pytest.CaptureFixture[str]) -> None:
    case = FaultWatch(FaultRun(Path(), phase=ExamState.PHASE_SCAN, at_s=0.5))
    for t, phase in ((6.0, ExamState.PHASE_INDENT), (7.0, ExamState.PHASE_SCAN), (7.4, ExamState.PHASE_SCAN)):
        case.on_progress(in_phase(phase)._replace(t=round(t * NS)))
    assert not capsys.readouterr().out
    case.on_progress(in_phase(ExamState.PHASE_SCAN)._replace(t=round(7.5 * NS)))
    assert capsys.readouterr().out == "the fault is due at 7.5\n"


def test_an_end_that_names_no_role_is_bad(tmp_path: Path) -> None:
    failed = replace(result(collected()), failure=Failure(FailureCode.BLOCKED, "something went wrong"))
    assert not judged(watch().finish(failed), tmp_path, "nan", "planning/setpoint").passed


def test_results_are_read_back_from_their_file_and_from_no_other() -> None:
    killed = CaseResult("kill", "robot", "lockstep", 8.0, 33.2, 'robot, "gone"\nat once', "run ended", 5.0, named=True)
    hung = CaseResult("nan", "exam/state", "wall clock", hung=True, left_behind="/tmp/x", kept=False)
    assert from_csv(csv_text([killed, hung])) == [killed, hung]
    with pytest.raises(ValueError, match="must have the columns kind, target"):
        from_csv("mode,fault\nlockstep,kill\n")


def test_drawn_cases_follow_their_seed() -> None:
    first, again, other = (list(draw_cases(40, seed, ["lockstep"])) for seed in (1000, 1000, 1001))
    assert first == again != other
    assert {len(case.target.split("+")) for case in first} == {1, 2, 3}
    assert {role for case in first for role in case.target.split("+")} <= {*ROLES, CONDUCTOR}
    assert len({case.name for case in first}) == 40


def test_a_row_is_bad_when_the_force_rises_or_something_is_lost_or_left() -> None:
    good = CaseResult("kill", "x", "lockstep", 8.0, peak_force_before_n=5.0, peak_force_n=6.9, ended="x lost", named=True)
    assert good.passed
    assert replace(good, peak_force_before_n=0.0, peak_force_n=14.0).passed, "before contact the force has yet to rise"
    higher, over = {"peak_force_n": 7.1}, {"peak_force_before_n": 14.0, "peak_force_n": 15.5}
    for bad in (higher, over, {"kept": False}, {"left_behind": "/somewhere"}, {"named": False}, {"hung": True}):
        assert not replace(good, **bad).passed


def test_a_fault_without_a_message_is_not_injected(tmp_path: Path) -> None:
    case = CaseResult("nan", "planning/path", "lockstep")
    judge(case, FaultResult(tmp_path, tmp_path / "gone", 0, FaultLog(result(collected())), 8.0), ["planning/path"])
    assert case.ended.startswith("the fault was not injected")
    assert not case.passed
    known = {(case.kind, case.target) for case in cases(("lockstep",), ("nan", "stamp", "drop"), ())}
    assert ("nan", "planning/camera_trigger") not in known
    assert {("drop", "planning/camera_trigger"), ("drop", "assessment/findings")} <= known
    assert prepare(FaultCase("drop", "planning/path", False), tmp_path, 1.0)[0].phase == ExamState.PHASE_LOOK


def test_a_row_that_was_not_injected_stays_in_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "faults.csv"
    file.write_text(csv_text([CaseResult("kill", "robot", "lockstep", ended="the fault was not injected")]), encoding="utf-8")
    monkeypatch.setattr("palpate_benchmarks.campaign.run_case", lambda case, *_: replace(case.result(), injected_s=1.0))
    words = ["faults", "--out", str(file), "--kind", "nan", "--only", "exam/state", "--mode", "lockstep"]
    assert CliRunner().invoke(app_for("faults"), words).exit_code == ExitStatus.FAILED
    assert [case.kind for case in from_csv(file.read_text(encoding="utf-8"))] == ["kill", "nan"]


def test_a_fault_that_is_never_due_ends_its_case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(injection, "TIMES", FaultTimes(due_s=0.1, services_leave_s=1.0))
    case = run_case(FaultCase("nan", "planning/setpoint", wallclock=False), tmp_path)
    assert "not due within 0.1 s: waited for the start of the services" in case.ended
    assert not case.passed


@pytest.mark.parametrize("named", [True, False])
def test_the_failure_of_the_run_is_judged(named: bool, tmp_path: Path) -> None:
    failure = Failure(FailureCode.ROLE_LOST, "something failed", ("control",) if named else ())
    case = judged(FaultLog(replace(result(collected()), failure=failure)), tmp_path, "kill", "control+recorder")
    assert case.passed == named
    assert case.ended == "something failed"


def test_without_conductor_and_recording_nothing_is_kept(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "planning.log").write_text(f"2026 planning WARNING {CONDUCTOR_LOST_LOG % 'gone'}\n", encoding="utf-8")
    case = judged(None, tmp_path, "kill", CONDUCTOR, -9)
    assert case.sign == "planning: conductor lost: gone"
    assert case.named
    assert not case.kept


def test_settings_change_the_examination_of_the_cases() -> None:
    assert examination(("exam.depth_m=0.006",)).exam.depth_m == 0.006


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "where", "wallclock"),
    [
        *(("kill", role, False) for role in ("control", "planning", "robot", "tissue", CONDUCTOR, "dashboard")),
        ("kill", "control", True),
        ("nan", "planning/setpoint", False),
    ],
)
def test_a_case_is_run_and_judged(kind: str, where: str, wallclock: bool, tmp_path: Path) -> None:
    """The force rises no further, and the role is named; without a viewer the run continues."""
    case = run_case(FaultCase(kind, where, wallclock), tmp_path)
    assert case.passed, case
    assert (case.outcome is CaseOutcome.ENDED) == (where != "dashboard")
