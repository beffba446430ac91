"""A stopped examination, with all real services: released it goes on where it was, and finds what it would have found."""

from __future__ import annotations

from typing import Any

import pytest
from examination import SHORT

from palpate.run.composed import load_services
from palpate.run.roles import WORKERS
from palpate_bus.messages import ExamState, OperatorRequest, RobotStatus
from palpate_bus.messages.stamps import NS, header
from palpate_bus.runtime.composed import Composed
from palpate_bus.service import Inbox, Outbox
from palpate_conductor.collector import Collected, Collector
from palpate_models.scenario.load import load_scenario

HELD_FOR = NS


class Operator(Collector):
    """Stops the examination a second after it begins to scan, and says another word a second later."""

    def __init__(self, word: int | None) -> None:
        super().__init__()
        self.word = word
        self.scan: int | None = None
        self.said: list[int] = []
        self.modes: list[int] = []

    def step(self, t: int, inbox: Inbox) -> Outbox:
        out: dict[str, Any] = dict(super().step(t, inbox))
        exam = self.collected.exam
        if self.scan is None and exam is not None and exam.phase == ExamState.PHASE_SCAN:
            self.scan = t
        due = [OperatorRequest.STOP, self.word][len(self.said) :]
        if self.word is not None and self.scan is not None and due and t >= self.scan + (1 + len(self.said)) * HELD_FOR:
            self.said.append(due[0])
            out["operator/request"] = OperatorRequest(header(t), due[0], "a test")
        self.modes += [status.mode for status in inbox.new("robot/status")]
        return out


def examine(word: int | None) -> tuple[Collected, Operator]:
    scenario = load_scenario("clean", (*SHORT, "camera.frames=4"))
    operator = Operator(word)
    run = Composed([*load_services(scenario, WORKERS), operator])
    run.run(lambda: operator.collected.end_tick, 120 * NS)
    return operator.collected, operator


@pytest.mark.slow
def test_released_it_goes_on_where_it_was() -> None:
    undisturbed, _ = examine(None)
    collected, operator = examine(OperatorRequest.RELEASE)
    assert operator.said == [OperatorRequest.STOP, OperatorRequest.RELEASE]
    assert RobotStatus.MODE_SAFE_HOLD in operator.modes
    assert operator.modes[-1] == RobotStatus.MODE_ACTIVE
    assert collected.exam.phase == ExamState.PHASE_DONE, collected.exam.message
    assert collected.exam.targets_skipped == 0
    assert len(collected.samples) >= len(undisturbed.samples)
    assert max(m.normal_force for m in collected.indentation) < 1.2 * max(m.normal_force for m in undisturbed.indentation)
    (found,), (expected,) = collected.findings.findings, undisturbed.findings.findings
    assert abs(found.centroid.x - expected.centroid.x) < 3e-3
    assert abs(found.centroid.y - expected.centroid.y) < 3e-3
    assert found.ratio == pytest.approx(expected.ratio, rel=0.1)


@pytest.mark.slow
def test_ended_it_goes_home_and_says_who_ended_it() -> None:
    collected, operator = examine(OperatorRequest.END)
    assert operator.said == [OperatorRequest.STOP, OperatorRequest.END]
    assert collected.exam.phase == ExamState.PHASE_ABORTED
    assert "ended by the operator: a test" in collected.exam.message
    assert collected.indentation[-1].normal_force == 0.0
