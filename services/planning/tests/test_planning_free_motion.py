"""Tests of free motions: background worker, trajectory following, and missed steps."""

import os
from itertools import pairwise
from threading import Event
from time import sleep
from types import SimpleNamespace

import numpy as np
import pytest
from planning_fakes import BASE, PERIOD_S, known

from palpate_bus.messages.codes import Reason
from palpate_bus.setpoint import Setpoint
from palpate_models.robot.arm import tool_pose
from palpate_models.robot.lbr import ARM, HOME
from palpate_models.scenario.schema import Exam as ExamSettings, Limits, Robot
from palpate_planning.contact import ContactMeasurement
from palpate_planning.free_motion import WORKER, BackgroundTask, FreeMotion
from palpate_planning.motion.kinematics import ArmKinematics
from palpate_planning.motion.timing import TIMING, RestartRamp, joint_trajectory
from palpate_planning.palpation import Palpation
from palpate_planning.periods import MS
from palpate_planning.stroke import StrokeStage
from palpate_planning.stroke_motion import MOTION as STROKE_MOTION, StrokeMotion
from palpate_planning.strokes.path import PathPoint, SurfacePath
from palpate_planning.strokes.plan import ExamPlanner
from palpate_planning.strokes.segments import Segment
from palpate_planning.waits import WAIT, Tally
from palpate_planning.wall.surface import Foot
from palpate_planning.wall.wall import WallEstimate, plane


@pytest.mark.parametrize("lockstep", [True, False])
def test_a_result_is_due_at_its_time_and_on_a_wall_clock_not_before_it_is_there(lockstep: bool) -> None:
    go = Event()
    task = BackgroundTask(1000, 50, lambda: go.wait(10) and 7, lockstep=lockstep)
    assert not task.due(1049)
    assert task.due(1050) is lockstep
    go.set()
    assert task.result() == 7
    assert [task.due(1049), task.due(1050)] == [False, True]


KINEMATICS = ArmKinematics(BASE, Limits())
START = np.array([0.0, 0.6, 0.0, -1.2, 0.0, 1.0, 0.0])
GOAL = START + np.array([0.9, -0.2, 0.1, 0.3, 0.0, -0.2, 0.5])
MOTION = joint_trajectory(KINEMATICS, np.array([START, GOAL]), Limits(), PERIOD_S)
DOWN, ONE = np.diag([1.0, -1.0, -1.0]), np.zeros(1, dtype=int)
PLACE = SurfacePath(np.zeros(1), np.zeros((1, 3)), -DOWN[None, 2], DOWN[None], GOAL[None], ONE, ONE)
FOOT = Foot(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.02, np.zeros(2))
ABOVE = ContactMeasurement(
    START, np.eye(4), np.eye(3), FOOT, WallEstimate(0.0, 0.0, 0.01), -0.02, 0.0, 0.0, (FOOT.p_W, FOOT.n_W), False
)


def ticks(late_at: int, late: int, count: int) -> list[int]:
    """Times of steps [ns], 10 ms apart but for one that comes `late` [ns] after the one before."""
    gaps = [10 * MS] * count
    gaps[late_at] = late
    return np.cumsum(gaps).tolist()


def followed(times: list[int]) -> list[Setpoint]:
    """Set-points of a follower on `MOTION`."""
    follower, ramp = FreeMotion(KINEMATICS, ExamPlanner(known(), PERIOD_S), lockstep=True), RestartRamp()
    follower.start(MOTION)
    return [follower.step(t, ramp.step(t)) for t in times]


def palpated(times: list[int]) -> list[Setpoint]:
    """Set-points of a palpation on a segment that is `MOTION`."""
    palpation, ramp = free_palpation(), RestartRamp()
    return [palpation.step(t, ABOVE, ramp.step(t)).setpoint for t in times[: len(MOTION) - 1]]


def free_palpation() -> Palpation:
    """Return a palpation of two segments that both are `MOTION`."""
    segment = Segment(PLACE, contact=False, free=MOTION)
    return Palpation((segment, segment), known(), PERIOD_S, plane(np.eye(4)), Tally())


def test_a_free_motion_begins_where_the_arm_is_and_ends_where_it_was_planned() -> None:
    """After a correction of centimetres the arm is not at the planned start."""
    aside = np.array((0.0, 0.02, 0.0, 0.07, 0.0, 0.0, 0.0))
    palpation, ramp = free_palpation(), RestartRamp()
    times = ticks(5, 10 * MS, len(MOTION) - 1)
    asked = [palpation.step(t, ABOVE._replace(q=START + aside), ramp.step(t)).setpoint for t in times]
    q, qd = np.array([s.q for s in asked]), np.array([s.qd for s in asked])
    assert q[0] == pytest.approx(START + aside, abs=1e-3)
    assert q[-2] == pytest.approx(GOAL, abs=1e-3)
    assert np.gradient(q[:-1], PERIOD_S, axis=0)[1:-1] == pytest.approx(qd[1:-2], abs=0.01)


MOVERS = {"follower": followed, "free segment": palpated}


@pytest.mark.parametrize("late", [False, True])
def test_the_rate_is_one_on_time_and_comes_up_from_none_after_a_gap(late: bool) -> None:
    ramp, rise = RestartRamp(), TIMING.restart_ns // (10 * MS)
    rates = [ramp.step(t) for t in ticks(5, TIMING.braked_ns + late * 10 * MS, 50)]
    expected = np.ones(50)
    expected[5 : 5 + rise] = np.arange(rise) / rise if late else 1.0
    assert rates == pytest.approx(expected)


@pytest.mark.parametrize("mover", MOVERS)
def test_on_time_every_sample_is_taken_as_it_is(mover: str) -> None:
    setpoints = MOVERS[mover](ticks(0, 10 * MS, len(MOTION) - 2))
    for k, setpoint in enumerate(setpoints, start=1):
        assert np.array_equal(setpoint.q, MOTION.q[k])
        assert np.array_equal(setpoint.qd, MOTION.qd[k])


@pytest.mark.parametrize("late", [40 * MS, 190 * MS])
@pytest.mark.parametrize("mover", MOVERS)
def test_after_a_gap_a_motion_resumes_from_rest(mover: str, late: int) -> None:
    middle = len(MOTION) // 2
    setpoints = MOVERS[mover](ticks(middle, late, len(MOTION) + 30))
    before, first = setpoints[middle - 1 : middle + 1]
    assert np.abs(before.qd).max() > 0.3, "the motion is under way"
    assert np.array_equal(first.q, before.q), "nothing is skipped"
    assert not first.qd.any()
    for a, b in pairwise(setpoints[middle:]):
        step = 0.5 * PERIOD_S * (a.qd + b.qd)
        assert b.q - a.q == pytest.approx(step, abs=4e-4), "position and velocity belong together"
        assert (np.abs(b.qd - a.qd) / PERIOD_S <= 1.5 * ARM.acceleration_radps2).all()
    along = np.array([s.q[0] for s in setpoints])
    assert (np.diff(along) >= 0.0).all()


def test_after_a_pause_in_a_free_motion_the_palpation_continues_with_the_next_segment() -> None:
    palpation = free_palpation()
    palpation.step(0, ABOVE)
    palpation.pause()
    palpation.skip_free_motion()
    contacts = [ABOVE._replace(q=q, X_WI=KINEMATICS.pose(q)) for q in MOTION.q]
    steps = [palpation.step(t, now) for t, now in zip(ticks(0, 10 * MS, len(MOTION)), contacts, strict=True)]
    assert steps[-1].stage is StrokeStage.DONE
    assert np.array_equal(steps[-1].setpoint.q, MOTION.q[-1])


def test_an_arm_that_does_not_arrive_ends_the_strokes() -> None:
    palpation = free_palpation()
    times = ticks(0, 10 * MS, len(MOTION) + round((WAIT.limit_s + 1) / 0.01))
    steps = [palpation.step(t, ABOVE) for t in times]
    assert steps[len(MOTION)].stage is StrokeStage.TRANSFER
    assert palpation.recovery.failed.reason is Reason.ARM_DISPLACED
    assert steps[-1].stage is StrokeStage.DONE


class Turn:
    """A free motion of two samples."""

    q = np.array((HOME, HOME + 0.3))

    def __len__(self) -> int:
        return len(self.q)

    def at(self, sample: float) -> tuple[np.ndarray, np.ndarray]:
        return HOME + 0.3 * sample, np.zeros(7)


def test_a_free_motion_waits_for_an_arm_that_is_behind() -> None:
    """A pendant or a drive may slow it down."""
    motion = StrokeMotion(ExamSettings(), Limits(), Robot(), 0.01, None)  # type: ignore[arg-type]  # no wall in free motion
    motion.segment = SimpleNamespace(free=Turn())  # type: ignore[assignment]
    motion._sample, motion._q_offset, motion._following = 0.0, None, True
    motion.setpoint(0, SimpleNamespace(q=HOME, X_WI=np.eye(4)), 1.0)  # type: ignore[arg-type]
    rad, m = STROKE_MOTION.behind_rad, STROKE_MOTION.behind_m
    arrived = []
    for behind, below in ((0.3, 0.0), (rad + 0.01, 0.0), (rad - 0.01, m + 1e-3), (rad - 0.01, m - 1e-3)):
        motion.follow_free_motion(1.0)
        X_WI = tool_pose(Turn.q[-1], Robot())
        X_WI[2, 3] -= below
        motion.setpoint(0, SimpleNamespace(q=Turn.q[-1] - behind, X_WI=X_WI), 1.0)  # type: ignore[arg-type]
        arrived.append(motion.follow_free_motion(1.0))
    assert arrived == [False, False, False, True]


def test_a_stroke_after_a_free_motion_begins_at_the_depth_of_the_arm() -> None:
    motion = StrokeMotion(ExamSettings(), Limits(), Robot(), 0.01, None)  # type: ignore[arg-type]
    contact = SimpleNamespace(depth=-0.034, force=0.0, load=0.0)
    for free in (Turn(), None):
        motion.segment = SimpleNamespace(free=free)  # type: ignore[assignment]
        motion.regulate(contact, in_contact=False, pushing=False)  # type: ignore[arg-type]
    assert motion.regulation.reference_m == pytest.approx(-0.034, abs=1e-4)


def test_the_posture_of_a_setpoint_moves_no_faster_than_its_limit() -> None:
    """At a singular wrist the postures at the end of a path and at the start of the next stroke are far apart."""
    wall = SimpleNamespace(outward=lambda p, t: 0.0)
    motion, postures = StrokeMotion(ExamSettings(), Limits(), Robot(), 0.01, wall), []  # type: ignore[arg-type]
    motion.along = SimpleNamespace(position=0.0, velocity=0.0)  # type: ignore[assignment]
    for q in (HOME, HOME + 0.5):
        still = np.zeros(3)
        point = PathPoint(still, np.array((0.0, 0.0, 1.0)), np.eye(3), q, still, still, still, np.zeros(7))
        motion.segment = SimpleNamespace(free=None, path=SimpleNamespace(at=lambda s, point=point: point))  # type: ignore[assignment]
        postures += [motion.setpoint(0, SimpleNamespace(q=HOME), 1.0).q for _ in range(8)]  # type: ignore[arg-type]
    assert np.abs(np.diff(postures, axis=0)).max() <= STROKE_MOTION.posture_radps * 0.01 + 1e-9
    np.testing.assert_array_equal(postures[-1], HOME + 0.5)


def test_a_fork_waits_for_the_planning_thread() -> None:
    future = WORKER.submit(sleep, 0.1)
    if not (child := os.fork()):
        os._exit(not future.done())
    assert os.waitpid(child, 0)[1] == 0
