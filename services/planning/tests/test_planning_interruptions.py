"""Tests of stops, pushes, motion of the wall, waits: an examination resumes or ends within a bound and says for what it waits."""

from collections import deque
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from planning_fakes import BASE, FRAME, PERIOD_S, RATES, SMALL, World, check_at_port, known

from palpate_bus.contract.port_check import RefusedMessage
from palpate_bus.messages.codes import Phase, Reason
from palpate_bus.setpoint import ControlMode, Setpoint
from palpate_models.robot import lbr
from palpate_models.scenario.schema import ExamInput, Following
from palpate_planning import presses as requested, waits
from palpate_planning.examination import ExaminationSequence
from palpate_planning.free_motion import BackgroundTask
from palpate_planning.interruptions import RECOVERY, WALL, Recovery, WallWatch
from palpate_planning.motion.timing import JointTrajectory
from palpate_planning.palpation import NOT_TRACKED, Palpation
from palpate_planning.periods import MS, SECOND
from palpate_planning.presses import RequestedPresses
from palpate_planning.reasons import NO_CAUSE, Cause
from palpate_planning.setpoints import ReturnToArm, joint_setpoint
from palpate_planning.status import Observation
from palpate_planning.stroke import StrokeStage
from palpate_planning.strokes.requests import PressRequest
from palpate_planning.waits import FOR_ARM, FOR_BREATH, FOR_JOINTS, FOR_PLAN, FOR_WALL, WAIT, StrokeWaits, Tally
from palpate_planning.wall.breath import Breath, BreathObservation

STOPPED = Cause(Reason.EMERGENCY_STOP, "force 26 N")
PHASES = [Phase.HOME, Phase.LOOK, Phase.PLAN, Phase.APPROACH, Phase.INDENT, Phase.SCAN, Phase.RETRACT, Phase.RETURN]
SHORT = (Phase.RETRACT,)


def stopped_in(phase: Phase, *, soft: bool, seconds: float = 1.0) -> World:
    world = World(known(**SMALL))
    world.q = world.q + 0.2 * np.eye(7)[0]
    world.run_to(phase)
    if phase not in SHORT:
        world.steps(20)
    assert world.status.phase is phase
    world.stop, world.soft = STOPPED, soft
    world.steps(round(seconds / PERIOD_S))
    return world


@pytest.mark.parametrize(
    ("phase", "soft"), [*((phase, k % 2 == 0) for k, phase in enumerate(PHASES)), (Phase.INDENT, False), (Phase.SCAN, True)]
)
def test_after_a_release_it_resumes_without_losses(phase: Phase, soft: bool) -> None:
    world = stopped_in(phase, soft=soft)
    assert world.end == (Phase.HELD, Reason.EMERGENCY_STOP)
    assert world.status.end_tick < 0
    world.stop = NO_CAUSE
    world.complete()
    centres = np.array([s.p_WD for s, row in zip(world.setpoints, world.rows, strict=True) if row[1]])
    assert np.linalg.norm(centres - world.dome.positions[:, None], axis=2).min(axis=1).max() < 0.009
    assert max(row[5] for row in world.rows) < 5.0, "after the stop the force is not larger"


def test_an_arm_that_was_moved_at_the_end_of_a_stop_is_held_where_it_is() -> None:
    world = stopped_in(Phase.HOME, soft=False)
    world.stop, world.q = NO_CAUSE, world.q + 0.3 * np.eye(7)[0]
    there = world.q
    world.steps(5)
    np.testing.assert_allclose(world.exam._course.arm.q, there, atol=1e-9)


def test_an_arm_that_was_pushed_while_the_strokes_were_planned_starts_where_it_is() -> None:
    world = stopped_in(Phase.PLAN, soft=False)
    for _ in range(100):
        world.q = world.q + 0.0025 * np.eye(7)[0]
        world.step()
    world.stop = NO_CAUSE
    world.run_to(Phase.INDENT)
    check_at_port(world.setpoints)


def test_a_soft_stop_in_contact_retreats_along_the_normal_and_waits() -> None:
    world = stopped_in(Phase.SCAN, soft=True, seconds=0.8)
    assert world.pressed == 0.0
    assert world.depth < -0.005
    where = world.p_W
    world.steps(100)
    assert np.linalg.norm(world.p_W - where) < 1e-3


def test_in_an_emergency_stop_nothing_pulls_at_the_arm() -> None:
    world = stopped_in(Phase.SCAN, soft=False)
    world.q = world.q + 0.01
    outcome = world.step()
    assert outcome.setpoint.mode is ControlMode.JOINT
    assert np.array_equal(outcome.setpoint.q, world.q)
    assert not outcome.setpoint.qd.any()


def test_a_soft_stop_that_becomes_an_emergency_stop_is_left_to_the_driver() -> None:
    world = stopped_in(Phase.SCAN, soft=True, seconds=0.05)
    world.soft = False
    assert world.step().setpoint.mode is ControlMode.JOINT
    world.stop = NO_CAUSE
    world.complete()


@pytest.mark.parametrize(("phase", "stopped"), [(Phase.HOME, False), (Phase.PLAN, True), (Phase.SCAN, True), (Phase.SCAN, False)])
def test_an_end_request_brings_the_arm_home(phase: Phase, stopped: bool) -> None:
    world = stopped_in(phase, soft=False, seconds=1.0 if stopped else 0.0)
    world.stop = world.stop if stopped else NO_CAUSE
    world.end_request = Cause(Reason.OPERATOR_END, "enough")
    world.step()
    world.stop = NO_CAUSE
    world.run()
    assert world.end == (Phase.ABORTED, Reason.OPERATOR_END)
    assert np.abs(world.q - lbr.HOME).max() < 0.02
    assert world.pressed == 0.0


@pytest.mark.parametrize("soft", [False, True])
def test_a_stop_that_no_release_can_end_ends_it_at_once(soft: bool) -> None:
    world = stopped_in(Phase.SCAN, soft=soft, seconds=0.02)
    world.final = True
    world.run(seconds=world.t / 1e9 + 3.0)
    assert world.end == (Phase.ABORTED, Reason.EMERGENCY_STOP)
    assert len(world.exam.unfelt) >= 3
    assert (world.pressed > 0.0) is not soft, "if planning moves the arm it is lifted"


def palpation_of(world: World) -> Palpation:
    palpation = world.exam._course.palpation
    assert palpation is not None
    return palpation


def drawn_sideways(world: World) -> float:
    """Run to the end; return the largest lateral distance [m] between set-point and an arm in the tissue."""
    begun, worst = len(world.rows), 0.0
    while world.status.end_tick < 0 and len(world.rows) < begun + 500:
        p_W = world.p_W
        _, n, distance, _ = world.truth.nearest(p_W)
        setpoint = world.step().setpoint
        if world.settings.robot.indenter_radius_m > distance and setpoint.mode is ControlMode.CARTESIAN:
            gap = setpoint.p_WD - p_W
            worst = max(worst, float(np.linalg.norm(gap - (gap @ n) * n)))
    world.run()
    return worst


def push(world: World, aside: float, down: float) -> None:
    """Move the arm along y and down [m]."""
    X = world.kinematics.pose(world.q)
    X[:3, 3] += (0.0, aside, -down)
    solution = world.kinematics.solve(X, world.q)
    assert solution.ok
    world.q = solution.q


def test_an_arm_that_was_pushed_laterally_stops_pressing() -> None:
    world = stopped_in(Phase.SCAN, soft=False)
    for _ in range(4):
        world.q = world.q + 0.02 * np.eye(7)[0]
        world.step()
    world.stop = NO_CAUSE
    assert drawn_sideways(world) < 0.002
    assert world.end == (Phase.ABORTED, Reason.ARM_DISPLACED)


@pytest.mark.parametrize(("phase", "deeper"), [(Phase.SCAN, False), (Phase.SCAN, True), (Phase.RETRACT, True)])
def test_an_arm_that_was_pushed_a_little_lifts_before_it_returns(phase: Phase, deeper: bool) -> None:
    world = stopped_in(phase, soft=False)
    push(world, 0.015, 0.004 if deeper else 0.0)
    world.stop = NO_CAUSE
    assert drawn_sideways(world) < 0.002
    world.complete()


def test_an_arm_that_was_pushed_into_the_tissue_between_strokes_lifts_first() -> None:
    world = World(known(region_m=(0.025, 0.025), pattern="raster"))
    world.run(lambda: getattr(world.exam._course.palpation, "stage", None) is StrokeStage.TRANSFER)
    assert palpation_of(world).free_goal is None
    world.step()
    world.stop = STOPPED
    world.steps(50)
    push(world, 0.01, 0.007 - world.depth)
    world.stop = NO_CAUSE
    world.step()
    assert world.depth > 0.005, "it is in the tissue"
    assert drawn_sideways(world) < 0.002
    world.complete()


def test_lost_perception_while_held_ends_it() -> None:
    world = stopped_in(Phase.LOOK, soft=True)
    world.lost = Cause(Reason.SERVICE_LOST, "lost perception")
    world.run()
    assert world.status.cause.reason is Reason.SERVICE_LOST


def test_a_push_where_no_skin_can_be_is_no_touch() -> None:
    world = World(known(**SMALL))
    tissue, pushed = world.force, []

    def force(depth: float) -> float:
        pushes = world.status.stroke == 2 and depth < -0.007 and len(pushed) < 5
        if not pushes or world.status.message != StrokeStage.DESCEND.value:
            return tissue(depth)
        pushed.append(depth)
        return 8.0

    world.force = force
    world.complete()
    assert pushed
    assert max(row[4] for row in world.rows) < 0.0115, "no touch was taken from it"


def test_a_stroke_that_is_left_before_it_slides_is_still_ahead() -> None:
    world = World(known(**SMALL))
    world.reach(StrokeStage.DESCEND, 2)  # the first only touches
    palpation_of(world).leave(Cause(Reason.WALL_NOT_TRACKED, "another reason"))
    assert sorted(palpation_of(world).ahead) == list(range(world.status.target_count))


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


def test_soft_stops_are_counted_over_all_plans() -> None:
    settings, tally = known(), Tally()
    segment = Mock(touch=False, path=Mock(visits=np.zeros(1), targets=np.zeros(1, dtype=int)))
    for _ in range(RECOVERY.soft_stops_max):
        recovery = Recovery(settings.exam, settings.limits, PERIOD_S, tally)
        assert not recovery.failed
        recovery.soft_stop(26.0, segment, 0.0)
    assert recovery.failed.text.endswith("3 times")


def test_repeats_of_one_stroke_do_not_count_against_the_next() -> None:
    settings, visits = known(), np.array((0.0, 0.2))
    recovery = Recovery(settings.exam, settings.limits, PERIOD_S, Tally())
    first, second = (Mock(touch=False, path=Mock(visits=visits, targets=np.array(targets))) for targets in ((0, 1), (2, 3)))
    for _ in range(RECOVERY.repeats_max):
        recovery.repeat(first, 0.19, 0.01, NOT_TRACKED)
    recovery.repeat(second, 0.0, 0.0, NOT_TRACKED)
    assert not recovery.skipped
    for _ in range(RECOVERY.repeats_max):
        recovery.repeat(second, 0.0, 0.0, NOT_TRACKED)
    assert set(recovery.skipped) == {2, 3}


def test_a_push_while_the_skin_is_only_touched_skips_no_target() -> None:
    world = World(known(**SMALL))
    world.reach(StrokeStage.DESCEND, 1)
    tissue, world.force = world.force, lambda depth: 40.0
    world.steps(2)
    world.force = tissue
    world.complete()


def test_an_arm_that_was_moved_off_a_free_motion_is_not_drawn_back_to_it() -> None:
    world = World(known(**SMALL))
    world.reach(StrokeStage.TRANSFER, 1)
    motion = palpation_of(world)._motion
    motion.segment = motion.segment._replace(free=JointTrajectory(np.tile(world.q, (50, 1)), np.zeros((50, 7))))
    world.steps(5)
    world.stop = Cause(Reason.ROBOT_HOLD, "")
    world.step()
    world.q = world.q + 0.1
    world.end_request = Cause(Reason.OPERATOR_END, "enough")
    world.step()
    world.stop = NO_CAUSE
    for _ in range(10):
        before = world.q.copy()
        assert np.abs(world.step().setpoint.q - before).max() < 0.01
    world.run()
    assert world.status.phase is Phase.ABORTED


class LateWorld(World):
    """A closed loop whose arm is 80 ms late."""

    def _obey(self, setpoint: Setpoint) -> None:
        self.late = getattr(self, "late", deque(maxlen=8))
        self.late.append(setpoint)
        super()._obey(self.late[0])


def test_the_setpoint_returns_to_an_arm_that_is_stopped_in_a_fast_motion_without_a_leap() -> None:
    world, farthest = LateWorld(known(**SMALL)), 0.0
    world.run_to(Phase.APPROACH)
    while not world.stop:
        gap = float(np.linalg.norm(world.step().setpoint.p_WD - world.p_W))
        world.stop = STOPPED if gap < farthest and farthest > 0.02 else NO_CAUSE
        farthest = max(gap, farthest)
    world.steps(10)
    check_at_port(world.setpoints)
    assert world.setpoints[-1].p_WD == pytest.approx(world.p_W, abs=1e-9)


def test_only_a_leap_to_the_arm_is_spread() -> None:
    arm, away, still = np.array(lbr.HOME), np.array(lbr.HOME) + 0.1, np.zeros(7)
    pose = World(known(**SMALL)).kinematics.pose
    for start, target in ((away, arm), (arm, away)):
        ramp, leap = ReturnToArm(PERIOD_S, RATES), [start, *[target] * 29]
        sent = [ramp.step(joint_setpoint(k * 10 * MS, pose(q), q, still, still), pose(arm), arm) for k, q in enumerate(leap)]
        with nullcontext() if target is arm else pytest.raises(RefusedMessage, match="pose"):
            check_at_port(sent)
        assert sent[-1].p_WD == pytest.approx(pose(target)[:3, 3])
        assert pytest.approx(pose(target)[:3, :3]) == sent[-1].R_WD


def test_a_return_is_spread_to_its_end_though_the_arm_comes_to_meet_the_setpoint() -> None:
    arm, still, ramp, sent = np.array(lbr.HOME), np.zeros(7), ReturnToArm(PERIOD_S, RATES), []
    pose = World(known(**SMALL)).kinematics.pose
    X_WI = pose(arm).copy()
    for k, wanted in enumerate([arm + 0.1, *[arm] * 29]):
        sent.append(ramp.step(joint_setpoint(k * 10 * MS, pose(wanted), wanted, still, still), X_WI, arm))
        if k:
            X_WI[:3, :3], X_WI[:3, 3] = sent[-1].R_WD, sent[-1].p_WD
    check_at_port(sent)
    assert (sent[-1].p_WD == pose(arm)[:3, 3]).all()


def test_the_arm_lifts_before_a_sudden_force_and_presses_there_again() -> None:
    world = World(known(**SMALL))
    world.reach(StrokeStage.SLIDE, 2)
    tissue, begun = world.force, len(world.rows)
    world.force = lambda depth: tissue(depth) + 1.2 * (len(world.rows) - begun)  # a cough: 120 N/s
    world.run(lambda: world.status.message != StrokeStage.SLIDE.value)
    assert world.pressed < 11.0
    world.force = tissue
    world.complete()


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
    monkeypatch.setattr(waits, "WAIT", short)
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


def test_a_silent_perception_is_named_at_once() -> None:
    world = Watched(known(**SMALL))
    world.watch(lambda _: setattr(world, "_answer_at", None))
    assert Reason.WAITS_FOR_PERCEPTION in world.reasons
    assert world.status.cause.reason is Reason.VIEW_TIMEOUT


def test_each_approach_has_its_own_time_to_wait() -> None:
    world = World(known(**SMALL))
    for _ in range(3):
        world.run_to(Phase.APPROACH)
        world.exam._approach_waits.step(FOR_JOINTS)
        assert world.exam._approach_waits._waited_s[FOR_JOINTS] == PERIOD_S
        world.exam._course.enter(Phase.PLAN, world.t, "planning again")


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
