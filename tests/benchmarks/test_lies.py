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
from palpate_benchmarks.liar import KINDS, Liar, Lie, LyingTopic
from palpate_benchmarks.lies import Healthy, cases, cells, draw_lies, judge, left_out, run_lies, start_s
from palpate_bus.contract import contract
from palpate_bus.messages import MS, NS, SurfaceCorrection, header, nanoseconds
from palpate_bus.runtime.failure import Failure, FailureCode
from palpate_bus.runtime.lockstep import Stepper
from palpate_errors import UserError

MOMENT = 5 * MS


def sent(lie: str, ticks: int = 12) -> list[Any]:
    topic = lie.split(maxsplit=1)[0]
    service = Liar(toy_services.Robot(), Lie.parse(f"{lie} {MOMENT / NS}"), lambda: None)
    inbox = Stepper(toy_services.Robot(), contract()).inbox
    return [dict(service.step(t * MS, inbox))[topic] for t in range(ticks)]


@pytest.mark.parametrize(
    ("lie", "expected"),
    [
        ("frozen 0", 5e-3), ("zero 0", 0.0), ("gain 0.3", 3e-3), ("sign 0", -10e-3), ("bias 2", 2 + 10e-3), ("delayed 2", 8e-3),
        ("drift 1000", 5.0 + 10e-3),
    ],
)  # fmt: skip
def test_a_lie_begins_at_its_moment(lie: str, expected: float) -> None:
    forces = [message.wrench.force.x for message in sent(f"ft/wrench wrench.force {lie}")]
    assert forces[:5] == pytest.approx([1e-3 * t for t in range(5)])
    assert forces[10] == pytest.approx(expected)


@pytest.mark.parametrize(
    "text", ["", "ft/wrench wrench.force gain 0.3", "ft/torque wrench.force gain 0.3 1", "ft/wrench message x 0 1"]
)
def test_a_lie_that_cannot_be_read_is_refused(text: str) -> None:
    with pytest.raises(UserError, match=r"PALPATE_LIE = .*expected TOPIC FIELD KIND AMOUNT SECONDS"):
        Lie.parse(text)


def test_messages_come_late_twice_and_out_of_order() -> None:
    def stamps(lie: str) -> list[float]:
        return [nanoseconds(message.header.stamp) / MS for message in sent(f"ft/wrench message {lie}")]

    assert stamps("late 2")[4:9] == [4, 3, 4, 5, 6]
    assert stamps("repeated 0")[4:9] == [4, 5, 5, 5, 5]
    assert stamps("stale 0.002")[4:9] == [4, 3, 4, 5, 6]
    assert stamps("disordered 0")[4:9] == [4, 3, 6, 5, 8]


def correction(t: int) -> SurfaceCorrection:
    return SurfaceCorrection(header(t, "abdomen"), np.zeros(1, np.float32), np.ones(1, np.float32))


@pytest.mark.parametrize(("at_s", "spikes"), [(13.12, [13.5, 14.5, 15.5]), (14.0, [14.0, 15.0, 16.0])])
def test_a_spike_is_in_the_first_message_of_each_second_from_the_moment_on(at_s: float, spikes: list[float]) -> None:
    lying = LyingTopic(Lie("perception/correction", "outward", "spike", 0.12, at_s))
    times = [13 * NS + k * 500 * MS for k in range(7)]
    sent = [lying.messages(t, [correction(t)], event=True)[0].outward for t in times]
    assert [t / NS for t, outward in zip(times, sent, strict=True) if outward > 0.1] == spikes


def test_a_late_event_is_sent_once() -> None:
    lying = LyingTopic(Lie("perception/correction", "message", "late", 200.0, 1.0))
    sent = {
        k: lying.messages(k * 100 * MS, [correction(k * 100 * MS)] if k in (8, 10, 11) else [], event=True) for k in range(15)
    }
    stamps = {k: [nanoseconds(message.header.stamp) // (100 * MS) for message in late] for k, late in sent.items() if late}
    assert stamps == {8: [8], 12: [10], 13: [11]}


@pytest.mark.parametrize(
    ("lie", "sent"),
    [
        ("zero 0", False), ("sign 0", False), ("gain 0.3", False), ("frozen 0", False), ("delayed 200", False),
        ("bias 0.01", True), ("nan 0", True), ("noise 0.01", True), ("spike 0.1", True),
    ],
)  # fmt: skip
def test_a_lie_that_changes_no_message_is_not_sent(lie: str, sent: bool) -> None:
    lying = LyingTopic(Lie.parse(f"perception/correction outward {lie} 1"))
    for k in range(5, 20):
        lying.messages(k * 100 * MS, [correction(k * 100 * MS)], event=True)
    assert lying.sent is sent


def test_joints_and_quaternions_change_places() -> None:
    assert sent("sim/tool_state pose.orientation swapped 0")[10].pose.orientation.x == 1.0
    assert sent("joint_states position bias 0.5")[10].position == pytest.approx(np.full(7, 0.5), abs=1e-3)
    joints = sent("joint_states position permuted 0")[10]
    assert np.array_equal(joints.velocity, joints.effort)


def test_every_topic_that_a_service_reads_has_cases_or_a_reason() -> None:
    lying = {topic.name for topic, *_ in cells()}
    assert {topic.name for topic in contract().topics.values()} - lying <= left_out().keys()
    assert all(left_out().values()), "no reason"
    assert {kind for _, _, kind, _ in cells()} == set(KINDS)
    assert len({case.name for case in cases(("lockstep", "wallclock"), ())}) > 400


def test_no_case_repeats_another_or_is_of_a_message_that_is_not_sent() -> None:
    targets = {case.target.rsplit(" ", 1)[0] for case in (*cases(("lockstep",), ()), *draw_lies(200, 1, ("lockstep",)))}
    assert {"sim/surface message late 20", "exam/state message late 50"} <= targets
    assert not targets & {"sim/surface message late 50", "tf_static transforms.transform.rotation frozen 0"}
    assert not [target for target in targets if target.startswith("planning/camera_trigger message repeated")]
    drawn = [case.target.split() for case in draw_lies(200, 1, ("lockstep",))]
    assert {target[-1] for target in drawn if target[0] == "perception/targets"} == {"rest"}
    assert start_s(Lie("tf_static", "transforms.transform.rotation", "nan", 0.0, 0.3)) == 0.0


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
    log = FaultLog(result(seen), sent=True)
    twin = Healthy({}, int(seen.exam.target_count), len(seen.findings.findings), float(seen.stiffness_map.background), 10.0)
    if failure is not None:
        log.result = replace(log.result, failure=Failure(FailureCode.GAVE_UP, "held", topics=(failure,)))
    case = CaseResult(LIE, "ft/wrench wrench.force gain 0.3 depth", "lockstep", injected_s=0.0)
    assert judge(replace(case), Lie.parse("ft/wrench wrench.force gain 0.3 0"), log, twin).lie_verdict is verdict
    log.sent = False
    assert judge(case, Lie.parse("ft/wrench wrench.force gain 0.3 0"), log, twin).lie_verdict is LieVerdict.NOT_SENT


@pytest.mark.slow
def test_ten_lies(tmp_path: Path) -> None:
    chosen = [case for case in cases(("lockstep",), ("ft/wrench",)) if case.target.endswith(("descent", "depth"))][:10]
    bad = [case.target for case in run_lies(chosen, tmp_path) if not case.passed]
    assert bad == []
