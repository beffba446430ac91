"""The fault campaign: its faults, its cases, and the judgement of a case."""

import signal
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conductor_messages import collected, result

from palpate_benchmarks.campaign import CaseOver, _conclude, _Watch
from palpate_benchmarks.fault_cases import CaseOutcome, FaultCase, FaultFinding, csv_text, from_csv
from palpate_benchmarks.faulty import JUMP_NS, FaultySender, FaultyTransport, InjectedFault
from palpate_benchmarks.struck import CONDUCTOR, ROLES, Struck
from palpate_benchmarks.whole_cases import _judge, drawn
from palpate_bus.contract import contract
from palpate_bus.messages import ExamState, JointTorqueCommand, codec
from palpate_bus.messages.stamps import NS, duration_message, header, nanoseconds
from palpate_bus.runtime.conductor_link import CONDUCTOR_LOST_LOG
from palpate_bus.runtime.failure import Failure, FailureCode
from palpate_bus.wire.rmw import topic_key
from palpate_bus.wire.zenoh_config import BusOptions, session
from palpate_conductor.outcome import RunProgress

TOPIC = contract().topics["control/joint_torque"]


class Sent:
    def __init__(self) -> None:
        self.messages: list[tuple[int, bytes]] = []

    def put(self, payload: bytes, sequence: int) -> None:
        self.messages.append((sequence, payload))

    def hello(self) -> None:
        self.messages.append((0, b""))

    def close(self) -> None:
        pass


def payload() -> bytes:
    message = JointTorqueCommand(header(7_000_000_000_000), np.arange(7.0), np.zeros(0), duration_message(50_000_000), "", "")
    return codec.encode(message, TOPIC.type)


def sent(kind: str, count: int = 1, messages: int = 5) -> list[tuple[int, bytes]]:
    out = Sent()
    sender = FaultySender(out, TOPIC, InjectedFault(TOPIC.name, kind, count, at=2_000_000), lambda: False)
    for sequence in range(1, messages + 1):
        sender.put(payload(), sequence)
    return out.messages


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
        assert isinstance(transport.publisher(TOPIC.name, topic_key(TOPIC, 0), qos, bytes(16)), FaultySender)
        assert not isinstance(
            transport.publisher("joint_states", topic_key(contract().topics["joint_states"], 0), qos, bytes(16)), FaultySender
        )
        late = FaultyTransport(opened, InjectedFault("clock", "jump"))
        before = late.now()
        assert before < late.now() < before + NS
        signal.raise_signal(signal.SIGUSR1)
        assert JUMP_NS <= late.now() - before < 2 * JUMP_NS


@pytest.mark.parametrize(
    ("topic", "kind", "at", "allowed"),
    [
        ("joint_states", "melt", None, "duplicate"),
        ("joint_stakes", "nan", None, "joint_states"),
        ("joint_states", "jump", None, "clock"),
        ("exam/findings", "nan", 0, "joint_states"),
    ],
)
def test_an_unknown_fault_is_answered_with_the_allowed_ones(topic: str, kind: str, at: int | None, allowed: str) -> None:
    with pytest.raises(ValueError, match=allowed):
        InjectedFault(topic, kind, at=at)


def watch(where: str = "planning/setpoint", target: str = "planning") -> _Watch:
    struck = FaultFinding("nan", where, "lockstep", injected_s=0.0)
    local: Any = SimpleNamespace(running={})
    return _Watch(FaultCase("nan", where, False), local, target, struck, since=1e12)


def in_phase(phase: int, culprit: str = "") -> RunProgress:
    messages = collected()
    last = messages.exam_states[-1]
    messages.exam_states = [*messages.exam_states, ExamState(**{**vars(last), "phase": phase, "culprit": culprit})]
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
    progress = in_phase(phase, "planning/setpoint")
    case = watch()
    with pytest.raises(CaseOver) as over:
        case.on_progress(progress)
    _conclude(case.finding, case, replace(result(progress.collected), failure=over.value.failure))
    assert case.finding.outcome is outcome
    assert case.finding.good
    assert (case.finding.sign == "") == outcome.unharmed, "a fault without effect was not noticed"


def test_a_fault_of_the_assessment_shows_after_the_scan() -> None:
    watch("assessment/map", "assessment").on_progress(in_phase(ExamState.PHASE_RETURN))
    watch().on_progress(in_phase(ExamState.PHASE_SCAN))


def test_an_end_that_names_no_role_is_bad() -> None:
    case = watch()
    _conclude(case.finding, case, replace(result(collected()), failure=Failure(FailureCode.BLOCKED, "something went wrong")))
    assert not case.finding.good


def found(where: str, detected_ms: float, peak_force_n: float) -> FaultFinding:
    """Return a run in lockstep that ended because of a killed role."""
    text = f"{where} lost"
    return FaultFinding(
        *("kill", where, "lockstep", 8.0, detected_ms, text, "run ended", 5.0, peak_force_n, CaseOutcome.ENDED, text), named=True
    )


def test_findings_are_read_back_from_their_file() -> None:
    quoted = replace(found("robot", 33.2, 6.0), sign='robot, "gone"\nat once', peak_force_n=None)
    hung = FaultFinding("nan", "exam/state", "wall clock", hung=True, left_behind="/tmp/x", kept=False)
    assert from_csv(csv_text([quoted, hung])) == [quoted, hung]


def test_a_file_of_other_columns_is_refused() -> None:
    with pytest.raises(ValueError, match="must have the columns kind, where"):
        from_csv("mode,fault\nlockstep,kill\n")


def test_drawn_cases_follow_their_seed() -> None:
    first, again, other = (list(drawn(40, seed, ["lockstep"])) for seed in (1000, 1000, 1001))
    assert first == again != other
    assert {len(case.where.split("+")) for case in first} == {1, 2, 3}
    assert {role for case in first for role in case.where.split("+")} <= {*ROLES, CONDUCTOR}
    assert len({case.name for case in first}) == 40


def test_a_row_is_bad_when_the_force_rises_or_something_is_lost_or_left() -> None:
    good = FaultFinding("kill", "x", "lockstep", 8.0, peak_force_before_n=5.0, peak_force_n=6.9, ended="x lost", named=True)
    assert good.good
    assert replace(good, peak_force_before_n=0.0, peak_force_n=14.0).good, "before contact the force has yet to rise"
    for bad in (
        replace(good, peak_force_n=7.1),
        replace(good, peak_force_before_n=14.0, peak_force_n=15.5),
        replace(good, kept=False),
        replace(good, left_behind="/somewhere"),
        replace(good, named=False),
        replace(good, hung=True),
    ):
        assert not bad.good


@pytest.mark.parametrize("named", [True, False])
def test_the_failure_of_the_run_is_judged(named: bool, tmp_path: Path) -> None:
    failure = asdict(Failure(FailureCode.ROLE_LOST, "something failed", ("control",) if named else ()))
    said = {"failure": failure, "lost": ["control"] if named else [], "forces": [[int(7e9), 5.0], [int(8.1e9), 5.5]]}
    struck = Struck(tmp_path, tmp_path / "gone", 0, said, 8.0, 1.0)
    finding = FaultFinding("kill", "control+recorder", "lockstep")
    _judge(finding, struck, ["control", "recorder"])
    assert finding.good == named
    assert (finding.peak_force_before_n, finding.peak_force_n, finding.ended) == (5.0, 5.5, "something failed")


def test_without_conductor_and_recording_nothing_is_kept(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "planning.log").write_text(f"2026 planning WARNING {CONDUCTOR_LOST_LOG % 'gone'}\n", encoding="utf-8")
    finding = FaultFinding("kill", CONDUCTOR, "lockstep")
    _judge(finding, Struck(tmp_path, tmp_path / "gone", -9, {}, 8.0, 1.0), [CONDUCTOR])
    assert finding.sign == "planning: conductor lost: gone"
    assert finding.named
    assert not finding.kept
    assert not FaultCase("kill", CONDUCTOR, False).wallclock
