"""Waits: an examination continues or ends within a bound, and says for what it waits."""

from collections.abc import Callable
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from planning_fakes import BASE, FRAME, PERIOD_S, RATES, SMALL, World, check_at_port, known

from palpate_bus.messages.codes import Phase, Reason
from palpate_models.scenario.schema import ExamInput, Following
from palpate_planning import examination, presses as requested, reasons
from palpate_planning.course import Observation
from palpate_planning.examination import ExaminationSequence
from palpate_planning.free_motion import BackgroundTask
from palpate_planning.interruptions import WALL, WallWatch
from palpate_planning.periods import MS, SECOND
from palpate_planning.presses import RequestedPresses
from palpate_planning.reasons import (
    FOR_ARM,
    FOR_BREATH,
    FOR_JOINTS,
    FOR_PLAN,
    FOR_WALL,
    NO_CAUSE,
    WAIT,
    Cause,
    StrokeWaits,
    Tally,
)
from palpate_planning.stroke import StrokeStage
from palpate_planning.strokes.plan import PressRequest
from palpate_planning.wall.wall import Breath, BreathObservation


def test_nothing_waits_in_contact_for_a_breath_that_does_not_come_to_rest() -> None:
    watch, held = WallWatch(breath := Breath(), Following.GATE, 0.1, Tally()), round((WALL.gate_closed_max_s + 5) / 0.1)
    for k in range(held + round(1.5 * WALL.calm_s / 0.1)):
        t = k * 100 * MS
        breath.receive(BreathObservation(t, np.full(11, 0.006 if k < held else 0.0), 1e-4, calm=True), t)
        watch.step(t, contact_lost=False)
        if k < held:
            assert watch.spoiled == (k * 0.1 > WALL.gate_closed_max_s - 0.05)
            assert not watch.leaps
    assert watch.calm


STILL_RAD = 1e-6


class Watched(World):
    """A closed loop that fails where the arm rests for longer than a wait may without a reason."""

    def __init__(self, settings: ExamInput, excursion: Callable[[float], float] | None = None) -> None:
        super().__init__(settings, excursion=excursion)
        self.reasons: dict[Reason, float] = {}
        """First time of each reason [s]."""
        self._q_rest, self._since = self.q, 0

    def watch(self, each: Callable[[float], None] = lambda t: None, seconds: float = 300.0) -> None:
        """Run to the end; `each` sets the inputs at a time [s]."""
        while self.status.end_tick < 0:
            assert self.t < seconds * SECOND, f"waits without end: {self.status}"
            each(self.t / SECOND)
            self.step()
            reason = self.status.cause.reason
            self.reasons.setdefault(reason, self.t / SECOND)
            if np.abs(self.q - self._q_rest).max() > STILL_RAD or reason is not Reason.NONE:
                self._q_rest, self._since = self.q, self.t
            assert self.t - self._since < (WAIT.reported_s + 1.0) * SECOND, f"waits without a reason: {self.status}"


@pytest.fixture
def limit_s(monkeypatch: pytest.MonkeyPatch) -> float:
    """Make the waits of strokes end early, to save time; return the limit."""
    short = WAIT._replace(limit_s=8.0)
    monkeypatch.setattr(reasons, "WAIT", short)
    return short.limit_s


@pytest.mark.parametrize(("calm_s", "every_s"), [(0.7, 1.9), (2.0, 10.0)])
def test_a_wall_that_is_calm_for_a_moment_ends_within_the_bound(calm_s: float, every_s: float, limit_s: float) -> None:
    world = Watched(known(**SMALL), excursion=lambda t: 0.0)
    began = world.reach(StrokeStage.REST, 0)

    def flicker(t: float) -> None:
        world.calm = (t - began) % every_s >= every_s - calm_s

    world.watch(flicker)
    assert world.end == (Phase.ABORTED, Reason.WALL_NOT_TRACKED), "no tissue was measured"
    assert world.reasons[Reason.WAITS_FOR_WALL] - began < WAIT.reported_s + 2.0
    assert world.t / SECOND - began < limit_s * (1.0 + calm_s / (every_s - calm_s)) + 5.0


@pytest.mark.usefixtures("limit_s")
def test_what_was_measured_is_assessed_where_the_wall_is_lost_later() -> None:
    world = Watched(known(**SMALL), excursion=lambda t: 0.0)
    world.reach(StrokeStage.SLIDE, 2)
    world.steps(100)
    world.calm = False
    world.watch()
    assert {Reason.WAITS_FOR_WALL, Reason.WAITS_FOR_FINDINGS} <= world.reasons.keys()
    assert world.end == (Phase.ABORTED, Reason.WALL_NOT_TRACKED), "more than a tenth is lost"


@pytest.mark.usefixtures("limit_s")
def test_a_breath_that_stays_in_is_named() -> None:
    lost = 1e9
    world = Watched(known(breathing="gate", **SMALL), excursion=lambda t: 0.0 if t < lost else 0.004)
    lost = world.reach(StrokeStage.SLIDE, 2)
    world.watch()
    assert world.reasons[Reason.WAITS_FOR_BREATH] - lost < WAIT.reported_s + 1.0
    assert sum(row[4] > 0.002 for row in world.rows) * PERIOD_S < 2 * WALL.gate_closed_max_s
    assert world.status.phase is Phase.DONE or world.end == (Phase.ABORTED, Reason.WALL_NOT_TRACKED)


def test_a_search_without_requests_ends_the_strokes(limit_s: float) -> None:
    world = Watched(known(pattern="search", **SMALL))
    began = world.reach(StrokeStage.WAIT, 1)
    world.watch()
    assert world.status.phase is Phase.DONE, world.status.message
    assert world.reasons[Reason.WAITS_FOR_REQUEST] - began < WAIT.reported_s + 0.1
    assert Reason.NO_REQUEST in world.reasons
    assert world.t / SECOND - began < limit_s + 5.0


class _HangingPlan(BackgroundTask[Any]):
    """A planner that hangs for as long as the tests run."""

    def due(self, t: int) -> bool:
        return False


def test_a_request_whose_plan_is_dropped_is_planned_again_and_one_that_hangs_ends_the_strokes(monkeypatch: Any) -> None:
    monkeypatch.setattr(requested, "BackgroundTask", _HangingPlan)
    presses, palpation, planner = RequestedPresses(lockstep=False), Mock(waiting=True), Mock()
    presses.receive(PressRequest(1, np.zeros(2), 0.01))
    for t in range(3):
        presses.step(t, planner, palpation, np.zeros(2))
    presses.drop_plan()
    presses.step(3, planner, palpation, np.zeros(2))
    assert presses.done == 0, "nothing was pressed"
    assert presses._planning is not None
    presses.step(round(WAIT.limit_s * SECOND), planner, palpation, np.zeros(2))
    palpation.leave.assert_not_called()
    presses.step(round(2 * WAIT.limit_s * SECOND), planner, palpation, np.zeros(2))
    palpation.leave.assert_called_once_with(FOR_PLAN.end)


def test_a_silent_perception_is_named_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(examination, "EXAM", examination.EXAM._replace(perception_timeout_ns=2 * SECOND))
    world = Watched(known(**SMALL))
    world.watch(lambda _: setattr(world, "_answer_at", None))
    assert Reason.WAITS_FOR_PERCEPTION in world.reasons
    assert world.status.cause.reason is Reason.VIEW_TIMEOUT


def test_each_approach_has_its_own_time_to_wait() -> None:
    world, waited = World(known(**SMALL)), []
    for _ in range(2):
        world.run_to(Phase.APPROACH)
        world.exam._approach_waits.step(FOR_JOINTS)
        waited.append(world.exam._approach_waits._waited_s[FOR_JOINTS])
        world.exam._course.enter(Phase.PLAN, world.t, "planning again")
    assert waited == [PERIOD_S] * 2


def test_an_arm_that_does_not_follow_is_named_and_presses_nothing(limit_s: float) -> None:
    world = World(known(**SMALL))
    world.run_to(Phase.APPROACH)
    world._obey = Mock()  # type: ignore[method-assign]
    world.run(lambda: world.status.cause.reason is Reason.WAITS_FOR_ARM)
    world.run()
    assert (*world.end, world.status.cause.culprit) == (Phase.ABORTED, Reason.ARM_DISPLACED, "control/joint_torque")
    assert Phase.INDENT not in {row[0] for row in world.rows}
    world.steps(50)
    check_at_port(world.setpoints)
    assert world.setpoints[-1].p_WD == pytest.approx(world.kinematics.pose(world.q)[:3, 3], abs=1e-9)


def test_a_robot_without_a_status_is_named_and_awaited_for_a_time() -> None:
    exam = ExaminationSequence(known(BASE, **SMALL), PERIOD_S, FRAME, RATES)
    reasons = []
    for k in range(round(2 * WAIT.limit_s)):
        exam.step(Observation(7 * SECOND + k * SECOND, None))
        reasons.append(exam.status.cause.reason)
    assert reasons[4:6] == [Reason.NONE, Reason.WAITS_FOR_ROBOT]
    assert (exam.status.phase, reasons[-1]) == (Phase.ABORTED, Reason.ROBOT_NOT_READY)
    assert exam.status.end_tick < (7 + WAIT.limit_s + 3) * SECOND


def test_an_operator_may_end_before_the_robot_is_ready() -> None:
    exam = ExaminationSequence(known(BASE, **SMALL), PERIOD_S, FRAME, RATES)
    exam.step(Observation(0, None, end=Cause(Reason.OPERATOR_END, "enough")))
    exam.step(Observation(0, None))
    assert (exam.status.phase, exam.status.cause.reason) == (Phase.ABORTED, Reason.OPERATOR_END)


@pytest.mark.parametrize("phase", [Phase.HOME, Phase.SCAN], ids=lambda phase: phase.name)
def test_a_stop_that_returns_again_and_again_ends_the_examination(phase: Phase) -> None:
    settings, patience_s = known(**SMALL), 10.0
    limits = settings.limits.model_copy(update={"release_patience_s": patience_s})
    world = Watched(settings.model_copy(update={"limits": limits}))
    world.q = world.q + 0.2 * np.eye(7)[0]
    world.run_to(phase)
    began = world.t / SECOND

    def flicker(t: float) -> None:
        released = (t - began) % (0.4 * patience_s) < 0.02
        world.stop = NO_CAUSE if released else Cause(Reason.ROBOT_HOLD, "hold", "robot")

    world.watch(flicker, seconds=began + 2 * patience_s)
    assert world.status.cause.reason is Reason.NOT_RELEASED
    assert world.t / SECOND - began < 1.1 * patience_s


def test_only_progress_begins_the_count_again() -> None:
    counted, ends = StrokeWaits(1.0, Tally()), []
    counted.reach(1, 0.0, at_depth=True)
    for k in range(200):
        counted.reach(1, 0.9 * WAIT.progress_m * (k % 2), at_depth=True)
        counted.step(None)
        end = counted.step((FOR_WALL, FOR_ARM, FOR_BREATH)[k % 3])
        assert bool(counted.reported) == (k + 1 >= WAIT.reported_s)
        if end:
            ends.append(k)
    assert ends[0] == 3 * WAIT.limit_s
    counted.reach(1, WAIT.progress_m, at_depth=True)
    assert not counted.step(FOR_WALL)
