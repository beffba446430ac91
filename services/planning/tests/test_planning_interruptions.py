"""Tests of stops, pushes and unexpected motion of the wall: the examination waits, resumes or ends."""

from collections import deque
from unittest.mock import Mock

import numpy as np
import pytest
from planning_fakes import PERIOD_S, RATES, World, check_at_port, known

from palpate_bus.contract.port_check import RefusedMessage
from palpate_bus.messages.codes import Phase, Reason
from palpate_bus.setpoint import ControlMode, Setpoint
from palpate_models.robot import lbr
from palpate_models.scenario.schema import Following
from palpate_planning.interruptions import RECOVERY, WALL, Recovery, WallWatch
from palpate_planning.motion.timing import JointTrajectory
from palpate_planning.palpation import NOT_TRACKED
from palpate_planning.reasons import NO_CAUSE, Cause
from palpate_planning.setpoints import ReturnToArm, joint_setpoint
from palpate_planning.stroke import StrokeStage
from palpate_planning.waits import Tally
from palpate_planning.wall.breath import Breath, BreathObservation

STOPPED = Cause(Reason.EMERGENCY_STOP, "force 26 N")
PHASES = [Phase.HOME, Phase.LOOK, Phase.PLAN, Phase.APPROACH, Phase.INDENT, Phase.SCAN, Phase.RETRACT, Phase.RETURN]


def stopped_in(phase: Phase, *, soft: bool, seconds: float = 1.0) -> World:
    world = World(known(region_m=(0.025, 0.0125)))
    world.q = world.q + np.array([0.2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    world.run(lambda: world.exam.status.phase is phase)
    for _ in range(20):
        world.step()
    if world.exam.status.phase is not phase:  # the phase is shorter
        world = World(known(region_m=(0.025, 0.0125)))
        world.run(lambda: world.exam.status.phase is phase)
    world.stop, world.soft = STOPPED, soft
    for _ in range(round(seconds / 0.01)):
        world.step()
    return world


@pytest.mark.parametrize(
    ("phase", "soft"), [*((phase, k % 2 == 0) for k, phase in enumerate(PHASES)), (Phase.INDENT, False), (Phase.SCAN, True)]
)
def test_after_a_release_it_resumes_without_losses(phase: Phase, soft: bool) -> None:
    world = stopped_in(phase, soft=soft)
    status = world.exam.status
    assert status.phase is Phase.HELD
    assert status.cause.reason is Reason.EMERGENCY_STOP
    assert status.end_tick < 0
    world.stop = NO_CAUSE
    world.run()
    assert world.exam.status.phase is Phase.DONE, world.exam.status.message
    assert world.exam.status.targets_skipped == 0
    centres = np.array([s.p_WD for s, row in zip(world.setpoints, world.rows, strict=True) if row[1]])
    for target in world.dome.positions:
        assert np.linalg.norm(centres - target, axis=1).min() < 0.009
    assert max(row[5] for row in world.rows) < 5.0, "after the stop the force is not larger"


def test_an_arm_that_was_pushed_while_the_strokes_were_planned_starts_where_it_is() -> None:
    world = stopped_in(Phase.PLAN, soft=False)
    for _ in range(100):
        world.q = world.q + np.array([0.0025, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        world.step()
    world.stop = NO_CAUSE
    world.run(lambda: world.exam.status.phase is Phase.INDENT)
    check_at_port(world.setpoints)


def test_a_soft_stop_in_contact_retreats_along_the_normal_and_waits() -> None:
    world = stopped_in(Phase.SCAN, soft=True, seconds=0.8)
    assert world.pressed == 0.0
    assert world.depth < -0.005
    where = world.kinematics.pose(world.q)[:3, 3]
    for _ in range(100):
        world.step()
    assert np.linalg.norm(world.kinematics.pose(world.q)[:3, 3] - where) < 1e-3


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
    world.run()
    assert world.exam.status.phase is Phase.DONE


@pytest.mark.parametrize(("phase", "stopped"), [(Phase.HOME, False), (Phase.PLAN, True), (Phase.SCAN, True), (Phase.SCAN, False)])
def test_an_end_request_brings_the_arm_home(phase: Phase, stopped: bool) -> None:
    world = stopped_in(phase, soft=False, seconds=1.0 if stopped else 0.0)
    world.stop = world.stop if stopped else NO_CAUSE
    world.end = Cause(Reason.OPERATOR_END, "enough")
    world.step()
    world.stop = NO_CAUSE
    world.run()
    assert world.exam.status.phase is Phase.ABORTED
    assert world.exam.status.cause.reason is Reason.OPERATOR_END
    assert np.abs(world.q - lbr.HOME).max() < 0.02
    assert world.pressed == 0.0


def test_without_a_release_it_ends() -> None:
    world = stopped_in(Phase.SCAN, soft=False)
    world.run()
    status = world.exam.status
    assert status.phase is Phase.ABORTED
    assert status.cause.reason is Reason.NOT_RELEASED
    assert world.t == pytest.approx(status.end_tick - 1_000_000_000 + 10_000_000)


@pytest.mark.parametrize("soft", [False, True])
def test_a_stop_that_no_release_can_end_ends_it_at_once(soft: bool) -> None:
    world = stopped_in(Phase.SCAN, soft=soft, seconds=0.02)
    world.final = True
    world.run(seconds=world.t / 1e9 + 3.0)
    assert world.exam.status.phase is Phase.ABORTED
    assert world.exam.status.cause.reason is Reason.EMERGENCY_STOP
    assert len(world.exam.unfelt) >= 3
    assert (world.pressed > 0.0) is not soft, "if planning moves the arm it is lifted"


def drawn_sideways(world: World) -> float:
    """Run to the end; return the largest lateral distance [m] between set-point and an arm in the tissue."""
    begun, worst = len(world.rows), 0.0
    while world.exam.status.end_tick < 0 and len(world.rows) < begun + 500:
        p_W = world.kinematics.pose(world.q)[:3, 3]
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
        world.q = world.q + np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        world.step()
    world.stop = NO_CAUSE
    assert drawn_sideways(world) < 0.002
    assert world.exam.status.phase is Phase.ABORTED
    assert world.exam.status.cause.reason is Reason.ARM_DISPLACED


@pytest.mark.parametrize(("phase", "deeper"), [(Phase.SCAN, False), (Phase.SCAN, True), (Phase.RETRACT, True)])
def test_an_arm_that_was_pushed_a_little_lifts_before_it_returns(phase: Phase, deeper: bool) -> None:
    world = stopped_in(phase, soft=False)
    push(world, 0.015, 0.004 if deeper else 0.0)
    world.stop = NO_CAUSE
    assert drawn_sideways(world) < 0.002
    assert world.exam.status.phase is Phase.DONE, world.exam.status.message
    assert world.exam.status.targets_skipped == 0


def test_an_arm_that_was_pushed_into_the_tissue_between_strokes_lifts_first() -> None:
    world = World(known(region_m=(0.025, 0.025), pattern="raster"))
    world.run(lambda: getattr(world.exam._course.palpation, "stage", None) is StrokeStage.TRANSFER)
    assert world.exam._course.palpation is not None
    assert world.exam._course.palpation.free_goal is None
    world.step()
    world.stop = STOPPED
    for _ in range(50):
        world.step()
    push(world, 0.01, 0.007 - world.depth)
    world.stop = NO_CAUSE
    world.step()
    assert world.depth > 0.005, "it is in the tissue"
    assert drawn_sideways(world) < 0.002
    assert world.exam.status.phase is Phase.DONE, world.exam.status.message
    assert world.exam.status.targets_skipped == 0


def test_lost_perception_while_held_ends_it() -> None:
    world = stopped_in(Phase.LOOK, soft=True)
    world.lost = Cause(Reason.SERVICE_LOST, "lost perception")
    world.run()
    assert world.exam.status.cause.reason is Reason.SERVICE_LOST


SMALL = {"region_m": (0.025, 0.0125)}


def reached(world: World, stage: StrokeStage, stroke: int = 1) -> None:
    status = world.exam.status
    world.run(lambda: status.stroke >= stroke and status.message == stage.value)


def test_a_push_where_no_skin_can_be_is_no_touch() -> None:
    world = World(known(**SMALL))
    tissue, pushed = world.force, []

    def force(depth: float) -> float:
        pushes = world.exam.status.stroke == 2 and depth < -0.007 and len(pushed) < 5
        if pushes and world.exam.status.message == StrokeStage.DESCEND.value:
            pushed.append(depth)
            return 8.0
        return tissue(depth)

    world.force = force
    world.run()
    assert pushed
    assert world.exam.status.phase is Phase.DONE, world.exam.status.message
    assert world.exam.status.targets_skipped == 0
    assert max(row[4] for row in world.rows) < 0.0115, "no touch was taken from it"


def test_a_stroke_that_is_left_before_it_slides_is_still_ahead() -> None:
    world = World(known(**SMALL))
    reached(world, StrokeStage.DESCEND, stroke=2)  # the first only touches
    palpation = world.exam._course.palpation
    assert palpation is not None
    palpation.leave(Cause(Reason.WALL_NOT_TRACKED, "another reason"))
    assert sorted(palpation.ahead) == list(range(world.exam.status.target_count))


def test_nothing_waits_in_contact_for_a_breath_that_does_not_come_to_rest() -> None:
    breath = Breath()
    watch = WallWatch(breath, Following.GATE, 0.1, Tally())
    inspired = BreathObservation(0, np.full(11, 0.006), 1e-4, calm=True)
    for k in range(round((WALL.gate_closed_max_s + 5) / 0.1)):
        t = k * 100_000_000
        breath.receive(inspired._replace(stamp=t), t)
        watch.step(t, contact_lost=False)
        assert watch.spoiled == (k * 0.1 > WALL.gate_closed_max_s - 0.05)
        assert not watch.leaps
    for _ in range(round(1.5 * WALL.calm_s / 0.1)):
        t += 100_000_000
        breath.receive(inspired._replace(stamp=t, forecast=np.zeros(11)), t)
        watch.step(t, contact_lost=False)
    assert watch.calm


def test_a_wall_that_stays_out_is_not_pressed_for_long() -> None:
    held_from = 1e9
    world = World(known(breathing="gate", **SMALL), excursion=lambda t: 0.0 if t < held_from else 0.004)
    reached(world, StrokeStage.SLIDE, stroke=2)
    held_from = world.t / 1e9
    world.run(seconds=200.0)
    pressed = [depth > 0.002 for *_, depth, _ in world.rows]
    assert sum(pressed) * 0.01 < 2 * WALL.gate_closed_max_s
    assert world.exam.status.cause.reason is Reason.WALL_NOT_TRACKED or world.exam.status.phase is Phase.DONE


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
    reached(world, StrokeStage.DESCEND, stroke=1)
    tissue = world.force
    world.force = lambda depth: 40.0
    world.step()
    world.step()
    world.force = tissue
    world.run()
    assert world.exam.status.phase is Phase.DONE, world.exam.status.message
    assert world.exam.status.targets_skipped == 0


def test_an_arm_that_was_moved_off_a_free_motion_is_not_drawn_back_to_it() -> None:
    world = World(known(**SMALL))
    reached(world, StrokeStage.TRANSFER, stroke=1)
    palpation = world.exam._course.palpation
    assert palpation is not None
    posture = JointTrajectory(np.tile(world.q, (50, 1)), np.zeros((50, 7)))
    palpation._motion.segment = palpation._motion.segment._replace(free=posture)
    for _ in range(5):
        world.step()
    world.stop = Cause(Reason.ROBOT_HOLD, "")
    world.step()
    world.q = world.q + 0.1
    world.end = Cause(Reason.OPERATOR_END, "enough")
    world.step()
    world.stop = NO_CAUSE
    for _ in range(10):
        before = world.q.copy()
        assert np.abs(world.step().setpoint.q - before).max() < 0.01
    world.run()
    assert world.exam.status.phase is Phase.ABORTED


class LateWorld(World):
    """A closed loop whose arm is 80 ms late."""

    def _obey(self, setpoint: Setpoint) -> None:
        self.late = getattr(self, "late", deque(maxlen=8))
        self.late.append(setpoint)
        super()._obey(self.late[0])


def test_the_setpoint_returns_to_an_arm_that_is_stopped_in_a_fast_motion_without_a_leap() -> None:
    world = LateWorld(known(**SMALL))
    world.run(lambda: world.exam.status.phase is Phase.APPROACH)
    farthest = 0.0
    while not world.stop:
        asked = world.step().setpoint
        gap = float(np.linalg.norm(asked.p_WD - world.kinematics.pose(world.q)[:3, 3]))
        world.stop = STOPPED if gap < farthest and farthest > 0.02 else NO_CAUSE
        farthest = max(gap, farthest)
    for _ in range(10):
        world.step()
    check_at_port(world.setpoints)
    assert world.setpoints[-1].p_WD == pytest.approx(world.kinematics.pose(world.q)[:3, 3], abs=1e-9)


@pytest.mark.parametrize(("back", "passes"), [(True, True), (False, False)])
def test_only_a_leap_to_the_arm_is_spread(back: bool, passes: bool) -> None:
    arm, away, still = np.array(lbr.HOME), np.array(lbr.HOME) + 0.1, np.zeros(7)
    kinematics, ramp = World(known(**SMALL)).kinematics, ReturnToArm(PERIOD_S, RATES)
    at = {True: arm, False: away}
    sent = []
    for k in range(30):
        q = at[(k > 0) is back]
        wanted = joint_setpoint(k * 10_000_000, kinematics.pose(q), q, still, still)
        sent.append(ramp.step(wanted, kinematics.pose(arm), arm))
    if passes:
        check_at_port(sent)
        assert sent[-1].p_WD == pytest.approx(kinematics.pose(arm)[:3, 3])
        assert pytest.approx(kinematics.pose(arm)[:3, :3]) == sent[-1].R_WD
    else:
        with pytest.raises(RefusedMessage, match="pose"):
            check_at_port(sent)


def test_the_arm_lifts_before_a_sudden_force_and_presses_there_again() -> None:
    world = World(known(**SMALL))
    reached(world, StrokeStage.SLIDE, stroke=2)
    tissue, begun = world.force, len(world.rows)
    world.force = lambda depth: tissue(depth) + 1.2 * (len(world.rows) - begun)  # a cough: 120 N/s
    while world.exam.status.message == StrokeStage.SLIDE.value:
        world.step()
    assert world.pressed < 11.0
    world.force = tissue
    world.run()
    assert world.exam.status.phase is Phase.DONE, world.exam.status.message
    assert world.exam.status.targets_skipped == 0
