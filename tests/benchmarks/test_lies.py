"""The campaign of lies: what a liar sends, which cases there are, and the judgement of a case."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conductor_messages import collected, result
from toy_runs import toy_services

from palpate_benchmarks.fault_cases import LIE, CaseResult, LieVerdict
from palpate_benchmarks.injection import FaultLog
from palpate_benchmarks.liar import KINDS, Liar, Lie
from palpate_benchmarks.lies import Healthy, cases, cells, judge, left_out, run_lies
from palpate_bus.contract import Edge, contract
from palpate_bus.messages import MS, NS, nanoseconds
from palpate_bus.runtime.failure import Failure, FailureCode
from palpate_bus.runtime.lockstep import Stepper

MOMENT = 5 * MS


def sent(lie: str, ticks: int = 12) -> list[Any]:
    topic = lie.split(maxsplit=1)[0]
    service = Liar(toy_services.Robot(), Lie.parse(f"{lie} {MOMENT / NS}"))
    inbox = Stepper(toy_services.Robot(), contract()).inbox
    return [dict(service.step(t * MS, inbox))[topic] for t in range(ticks)]


@pytest.mark.parametrize(
    ("lie", "expected"),
    [
        ("frozen 0", 5e-3), ("zero 0", 0.0), ("gain 0.3", 3e-3), ("sign 0", -10e-3), ("bias 2", 2 + 10e-3), ("delayed 2", 8e-3),
        ("drift 1000", 5.0 + 10e-3), ("spike 2", 10e-3),
    ],
)  # fmt: skip
def test_a_lie_begins_at_its_moment(lie: str, expected: float) -> None:
    forces = [message.wrench.force.x for message in sent(f"ft/wrench wrench.force {lie}")]
    assert forces[:5] == pytest.approx([1e-3 * t for t in range(5)])
    assert forces[10] == pytest.approx(expected)


def test_messages_come_late_twice_and_out_of_order() -> None:
    def stamps(lie: str) -> list[float]:
        return [nanoseconds(message.header.stamp) / MS for message in sent(f"ft/wrench message {lie}")]

    assert stamps("late 2")[4:9] == [4, 3, 4, 5, 6]
    assert stamps("repeated 0")[4:9] == [4, 5, 5, 5, 5]
    assert stamps("stale 0.002")[4:9] == [4, 3, 4, 5, 6]
    assert stamps("disordered 0")[4:9] == [4, 3, 6, 5, 8]


def test_joints_and_quaternions_change_places() -> None:
    assert sent("sim/tool_state pose.orientation swapped 0")[10].pose.orientation.x == 1.0
    assert sent("joint_states position bias 0.5")[10].position == pytest.approx(np.full(7, 0.5), abs=1e-3)
    joints = sent("joint_states position permuted 0")[10]
    assert np.array_equal(joints.velocity, joints.effort)


def test_every_topic_that_a_service_reads_has_cases_or_a_reason() -> None:
    lying = {topic.name for topic, *_ in cells()}
    for topic in contract().topics.values():
        if any(edge.blocking or edge is Edge.LATCHED for edge in topic.readers.values()):
            assert topic.name in lying or left_out(topic)
    assert {kind for _, _, kind, _ in cells()} == set(KINDS)
    assert len({case.name for case in cases(("lockstep", "wallclock"), ())}) > 400


@pytest.mark.parametrize(
    ("lost", "force", "failure", "verdict"),
    [
        (0, 9.0, None, LieVerdict.HARMLESS),
        (1, 9.0, None, LieVerdict.BAD),
        (1, 9.0, "ft/wrench", LieVerdict.NAMED),
        (1, 9.0, "perception/motion", LieVerdict.BAD),
        (0, 15.1, "ft/wrench", LieVerdict.BAD),
    ],
)
def test_a_case_is_judged_by_force_completeness_and_name(lost: int, force: float, failure: str | None, verdict: str) -> None:
    seen = collected()
    seen.exam.targets_skipped = lost * seen.exam.target_count
    for message in seen.indentation:
        message.normal_force, message.tangential_force, message.peak_force = force, 0.0, force
    log = FaultLog(result(seen))
    twin = Healthy({}, int(seen.exam.target_count), len(seen.findings.findings), float(seen.stiffness_map.background), 10.0)
    if failure is not None:
        log.result = replace(log.result, failure=Failure(FailureCode.GAVE_UP, "held", topics=(failure,)))
    case = CaseResult(LIE, "ft/wrench wrench.force gain 0.3 depth", "lockstep", injected_s=0.0)
    assert judge(case, Lie.parse("ft/wrench wrench.force gain 0.3 0"), log, twin).lie_verdict is verdict


@pytest.mark.slow
def test_ten_lies(tmp_path: Path) -> None:
    chosen = [case for case in cases(("lockstep",), ("ft/wrench",)) if case.target.endswith(("descent", "depth"))][:10]
    bad = [case.target for case in run_lies(chosen, tmp_path) if not case.passed]
    assert bad == []
