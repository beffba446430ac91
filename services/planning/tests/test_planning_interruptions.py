"""Stops, pushes and leaps: an examination resumes without losses, or ends."""

from collections import deque
from contextlib import nullcontext
from unittest.mock import Mock

import numpy as np
import pinocchio as pin
import pytest
from planning_fakes import BASE, PERIOD_S, RATES, SMALL, World, check_at_port, known

from palpate_bus.contract.port_check import RefusedMessage
from palpate_bus.messages.codes import Phase, Reason
from palpate_bus.setpoint import ControlMode, Setpoint
from palpate_models.robot import lbr
from palpate_planning.contact import SensorReading
from palpate_planning.course import Observation
from palpate_planning.interruptions import RECOVERY, Recovery
from palpate_planning.motion.kinematics import ArmKinematics
from palpate_planning.motion.planner import JointTrajectory
from palpate_planning.palpation import NOT_TRACKED, Palpation
from palpate_planning.periods import MS
from palpate_planning.reasons import NO_CAUSE, Cause, Tally
from palpate_planning.setpoints import ReturnToArm, joint_setpoint
from palpate_planning.stroke import StrokeStage

STOPPED = Cause(Reason.EMERGENCY_STOP, "force 26 N")
PHASES = [Phase.HOME, Phase.LOOK, Phase.PLAN, Phase.APPROACH, Phase.INDENT, Phase.SCAN, Phase.RETRACT, Phase.RETURN]


def stop(world: World, phase: Phase, *, soft: bool, seconds: float = 1.0) -> None:
    """Stop an examination 0.2 s after a phase has begun, for a time [s]."""
    world.run_to(phase)
    if phase is not Phase.RETRACT:  # that is short
        world.steps(20)
    assert world.status.phase is phase
    world.stop, world.soft = STOPPED, soft
    world.steps(round(seconds / PERIOD_S))


def stopped_in(phase: Phase, *, soft: bool, seconds: float = 1.0) -> World:
    world = World(known(**SMALL))
    world.q = world.q + 0.2 * np.eye(7)[0]
    stop(world, phase, soft=soft, seconds=seconds)
    return world


@pytest.mark.parametrize("soft_first", [True, False])
def test_after_each_release_it_resumes_without_losses(soft_first: bool) -> None:
    """One examination is stopped in every phase, by turns softly."""
    world = World(known(**SMALL))
    world.q = world.q + 0.2 * np.eye(7)[0]
    for k, phase in enumerate(PHASES):
        stop(world, phase, soft=soft_first is (k % 2 == 0))
        assert world.end == (Phase.HELD, Reason.EMERGENCY_STOP)
        assert world.status.end_tick < 0
        if phase is Phase.PLAN:
            assert np.abs(world.q - world.exam._views.postures[0]).max() < 0.02
        if phase is Phase.SCAN and world.soft:  # it retreats along the normal and waits
            assert world.pressed == 0.0
            assert world.depth < -0.005
            where = world.p_W
            world.steps(100)
            assert np.linalg.norm(world.p_W - where) < 1e-3
        world.stop = NO_CAUSE
    world.complete()
    centres = np.array([s.p_WD for s, row in zip(world.setpoints, world.rows, strict=True) if row[1]])
    assert np.linalg.norm(centres - world.dome.positions[:, None], axis=2).min(axis=1).max() < 0.009
    assert max(row[5] for row in world.rows) < 5.0, "after the stops the force is not larger"


def test_an_arm_that_was_moved_at_the_end_of_a_stop_is_held_where_it_is() -> None:
    world = stopped_in(Phase.HOME, soft=False)
    world.stop, world.q = NO_CAUSE, world.q + 0.3 * np.eye(7)[0]
    there = world.q
    world.steps(5)
    np.testing.assert_allclose(world.exam._course.arm.q, there, atol=1e-9)


def test_an_arm_that_was_pushed_while_the_strokes_were_planned_starts_where_it_is() -> None:
    world = stopped_in(Phase.PLAN, soft=False)
    assert world.exam._planning is not None, "the plan is kept until then"
    for _ in range(100):
        world.q = world.q + 0.0025 * np.eye(7)[0]
        world.step()
    world.stop = NO_CAUSE
    world.run_to(Phase.INDENT)
    check_at_port(world.setpoints)


def test_a_soft_stop_that_becomes_an_emergency_stop_is_left_to_the_driver_and_nothing_pulls_at_the_arm() -> None:
    world = stopped_in(Phase.SCAN, soft=True, seconds=0.0)
    felt = palpation_of(world)._motion.along.position
    world.steps(5)
    assert palpation_of(world).recovery.resume_at == felt, "the braking distance was not felt"
    world.soft, there = False, world.q
    world.q = there + 0.01
    setpoint = world.step().setpoint
    assert setpoint.mode is ControlMode.JOINT
    assert np.array_equal(setpoint.q, world.q)
    assert not setpoint.qd.any()
    world.q, world.stop = there, NO_CAUSE
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


@pytest.mark.parametrize("phase", [Phase.SCAN, Phase.RETRACT])
def test_an_arm_that_was_pushed_a_little_lifts_before_it_returns(phase: Phase) -> None:
    world = stopped_in(phase, soft=False)
    push(world, 0.015, 0.004)
    world.stop = NO_CAUSE
    assert drawn_sideways(world) < 0.002
    world.complete()


@pytest.mark.parametrize("tilt", [0.15, 0.45])
def test_a_tool_that_was_tilted_lifts_before_it_turns_back_without_a_leap_or_gives_up(tilt: float) -> None:
    world = stopped_in(Phase.SCAN, soft=False, seconds=0.1)
    X, held = world.kinematics.pose(world.q), len(world.setpoints)
    for angle in np.linspace(0.0, tilt, 20):
        turned = X.copy()
        turned[:3, :3] = pin.exp3(np.array((angle, 0.0, 0.0))) @ X[:3, :3]
        world.q = world.kinematics.solve(turned, world.q).q
        world.step()
    world.stop = NO_CAUSE
    world.run()
    check_at_port(world.setpoints[held:])
    assert world.end == ((Phase.ABORTED, Reason.ARM_DISPLACED) if tilt > RECOVERY.tilted_max_rad else (Phase.DONE, Reason.NONE))


def test_final_findings_that_arrive_in_a_stop_are_kept() -> None:
    world = World(known(**SMALL))
    world.step()
    world.exam._course.enter(Phase.ASSESS, world.t, "waiting for the findings")
    world.stop = STOPPED
    world.step()
    world.stop = NO_CAUSE
    world.step()
    world.exam.step(Observation(world.t, SensorReading(world.t, world.q, np.zeros(6), np.zeros(7))))
    assert world.status.phase is Phase.DONE


def test_findings_that_are_final_before_the_end_do_not_end_the_examination() -> None:
    world = World(known(**SMALL))
    world.step()
    now = Observation(world.t, SensorReading(world.t, world.q, np.zeros(6), np.zeros(7)))
    world.exam.step(now._replace(findings_final=True))
    world.exam._course.enter(Phase.RETURN, world.t, "going home")
    for _ in range(3):
        world.exam.step(now)
    assert world.status.phase is Phase.ASSESS


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


def test_pushes_before_a_stroke_slides_skip_no_target_and_are_no_touch() -> None:
    """One while the skin is only touched, then some where no skin can be."""
    world = World(known(**SMALL))
    world.reach(StrokeStage.DESCEND, 1)
    tissue, world.force = world.force, lambda depth: 40.0
    world.steps(2)
    pushed: list[float] = []

    def force(depth: float) -> float:
        pushes = world.status.stroke == 2 and depth < -0.007 and len(pushed) < 5
        if not pushes or world.status.message != StrokeStage.DESCEND.value:
            return tissue(depth)
        pushed.append(depth)
        return 8.0

    world.force = force
    world.complete()
    assert pushed
    assert max(row[4] for row in world.rows) < 0.0115


def test_a_stroke_that_is_left_before_it_slides_is_still_ahead() -> None:
    world = World(known(**SMALL))
    world.reach(StrokeStage.DESCEND, 2)  # the first only touches
    palpation_of(world).leave(Cause(Reason.WALL_NOT_TRACKED, "another reason"))
    assert sorted(palpation_of(world).ahead) == list(range(world.status.target_count))


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


pose = ArmKinematics(BASE, known().limits).pose


def test_only_a_leap_to_the_arm_is_spread() -> None:
    arm, away, still = np.array(lbr.HOME), np.array(lbr.HOME) + 0.1, np.zeros(7)
    for start, target in ((away, arm), (arm, away)):
        ramp, leap = ReturnToArm(PERIOD_S, RATES), [start, *[target] * 29]
        sent = [ramp.step(joint_setpoint(k * 10 * MS, pose(q), q, still, still), pose(arm), arm) for k, q in enumerate(leap)]
        with nullcontext() if target is arm else pytest.raises(RefusedMessage, match="pose"):
            check_at_port(sent)
        assert sent[-1].p_WD == pytest.approx(pose(target)[:3, 3])
        assert pytest.approx(pose(target)[:3, :3]) == sent[-1].R_WD


def test_a_return_is_spread_to_its_end_though_the_arm_comes_to_meet_the_setpoint() -> None:
    arm, still, ramp, sent = np.array(lbr.HOME), np.zeros(7), ReturnToArm(PERIOD_S, RATES), []
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
