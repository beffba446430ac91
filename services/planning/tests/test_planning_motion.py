"""Kinematics, collision scene, timing, and free motions: planned in the background, followed, and with missed steps."""

import os
from itertools import pairwise
from pathlib import Path
from threading import Event
from time import sleep
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from planning_fakes import BASE, PERIOD_S, known, seen_dome

from palpate_bus.messages.codes import Reason
from palpate_bus.setpoint import Setpoint
from palpate_models.numerics.frames import apply, inverse, rigid
from palpate_models.robot import lbr
from palpate_models.robot.arm import tool_pose
from palpate_models.robot.lbr import ARM, HOME
from palpate_models.scenario.schema import Exam as ExamSettings, Limits, Robot, arm_path
from palpate_planning.contact import ContactMeasurement
from palpate_planning.free_motion import WORKER, BackgroundTask, FreeMotion
from palpate_planning.motion.kinematics import KINEMATIC_LIMITS, ArmKinematics, CollisionScene
from palpate_planning.motion.planner import (
    TIMING,
    JerkLimitedAxis,
    NoPathError,
    RestartRamp,
    SpeedLimit,
    joint_trajectory,
    plan,
    round_corners,
)
from palpate_planning.palpation import Palpation
from palpate_planning.periods import MS
from palpate_planning.reasons import MOVED, WAIT, Tally
from palpate_planning.stroke import StrokeStage
from palpate_planning.stroke_motion import MOTION as STROKE_MOTION, StrokeMotion
from palpate_planning.strokes.path import PathPoint, SurfacePath, centre, least_twist
from palpate_planning.strokes.plan import REACH, STRETCHED, ExamPlanner, Segment, look_postures
from palpate_planning.wall.surface import Foot
from palpate_planning.wall.wall import WallEstimate, plane

LIMITS = Limits()
KINEMATICS = ArmKinematics(BASE, LIMITS)
BOUNDS = (KINEMATICS.lower, KINEMATICS.upper)
SEEN = seen_dome(known(region_m=(0.2, 0.2)))
SCENE = CollisionScene(KINEMATICS, BASE, (SEEN.vertices, SEEN.triangles))


def above(x: float, y: float, gap: float) -> np.ndarray:
    """Return a posture with the indenter's deepest point `gap` above the surface over (x, y) of A."""
    p, n = (a[0] for a in SEEN.surface.at(np.array([[x, y]])))
    R = least_twist(-n, KINEMATICS.pose(lbr.HOME)[:3, :3])
    goal = rigid(R, centre(p, n, BASE.indenter_radius_m, -gap))
    solution = KINEMATICS.solve(goal, np.array(lbr.HOME))
    assert solution.ok
    return solution.q


AROUND = (np.array([1.3, 0.9, 0.0, -1.2, 0.0, 1.0, 0.0]), np.array([-1.3, 0.9, 0.0, -1.2, 0.0, 1.0, 0.0]))
"""Low postures at both sides of the abdomen: the straight motion between them collides with it."""


def test_inverse_kinematics_meets_position_and_axis_and_reports_what_is_out_of_reach() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        q = rng.uniform(-0.7, 0.7, 7) * KINEMATICS.upper
        X = KINEMATICS.pose(q)
        solution = KINEMATICS.solve(X, q + rng.normal(0, 0.2, 7))
        assert solution.ok
        found = KINEMATICS.pose(solution.q)
        assert found[:3, 3] == pytest.approx(X[:3, 3], abs=1e-4)
        assert found[:3, :3] == pytest.approx(X[:3, :3], abs=1e-3)
        assert np.all(np.abs(solution.q) <= KINEMATICS.upper)
    assert not KINEMATICS.solve(rigid(X[:3, :3], np.array((3.0, 0.0, 1.0))), np.array(lbr.HOME)).ok


def test_home_is_free_the_table_is_not_and_only_the_tool_may_touch_in_contact() -> None:
    assert SCENE.free(np.array(lbr.HOME))
    deep = np.array([0.0, 1.9, 0.0, -0.3, 0.0, 0.5, 0.0])
    assert any("table" in pair or "abdomen" in pair for pair in SCENE.collisions(deep))
    pressed, buried = above(0.0, 0.0, -0.010), above(0.0, 0.0, -0.10)
    contact = CollisionScene(KINEMATICS, BASE, (SEEN.vertices, SEEN.triangles), tool_may_touch=True)
    assert not SCENE.free(pressed)
    assert contact.free(pressed)
    assert not contact.free(buried), "the F/T sensor's body must not touch"


def test_round_an_obstacle_the_path_is_free_all_along() -> None:
    a, b = AROUND
    assert SCENE.free(a)
    assert SCENE.free(b)
    assert not SCENE.motion_free(a, b)
    path = plan(SCENE, a, b, BOUNDS, 1)
    assert len(path) > 2
    assert np.array_equal(path[[0, -1]], AROUND)
    fine = np.concatenate([np.linspace(p, q, 400) for p, q in pairwise(path)])
    assert all(SCENE.free(q) for q in fine)


def test_the_same_seed_gives_the_same_path_to_the_bit_and_another_another() -> None:
    a, b = AROUND
    paths = [plan(SCENE, a, b, BOUNDS, seed) for seed in (4, 9, 4)]
    assert np.array_equal(paths[0], paths[2])
    assert not np.array_equal(paths[0], paths[1])


def test_ends_in_collision_are_named() -> None:
    with pytest.raises(NoPathError, match=r"goal posture .* collides: .* and abdomen"):
        plan(SCENE, np.array(lbr.HOME), above(0.0, 0.0, -0.02), BOUNDS, 0)


@pytest.mark.parametrize("points", [(np.array(lbr.HOME), above(0.05, 0.05, 0.03)), AROUND])
def test_timing_keeps_all_limits(points: tuple[np.ndarray, np.ndarray]) -> None:
    path = plan(SCENE, *points, BOUNDS, 1)
    q, qd = (found := joint_trajectory(KINEMATICS, round_corners(path, 0.1), LIMITS, PERIOD_S)).q, found.qd
    assert q[0] == pytest.approx(points[0], abs=1e-3)
    assert q[-1] == pytest.approx(points[1], abs=1e-9)
    assert (np.abs(np.diff(q, axis=0)) / PERIOD_S <= LIMITS.joint_velocity_scale * lbr.VELOCITY_LIMIT * 1.02).all()
    assert (np.abs(np.diff(qd, axis=0)) / PERIOD_S <= lbr.ARM.acceleration_radps2 * 1.1).all()
    tool = np.array([KINEMATICS.pose(at)[:3, 3] for at in q])
    assert np.linalg.norm(np.diff(tool, axis=0), axis=1).max() / PERIOD_S <= LIMITS.speed_mps * 1.02
    assert qd[-1] == pytest.approx(np.zeros(7), abs=1e-9)
    assert q[:-1] + 0.5 * PERIOD_S * (qd[:-1] + qd[1:]) == pytest.approx(q[1:], abs=3e-4)


def test_rounded_and_timed_motion_of_the_planner_is_free() -> None:
    planner = ExamPlanner(known(region_m=(0.2, 0.2)), PERIOD_S)
    trajectory = planner.motion(*AROUND, SEEN)
    assert all(SCENE.free(q) for q in trajectory.q)


def test_targets_that_need_a_stretched_arm_are_skipped() -> None:
    far = known(Robot(base_xy_m=(-0.22, 0.0)), region_m=(0.15, 0.0125), centre_m=(0.0, 0.0))
    examination = ExamPlanner(far, PERIOD_S).examination(seen_dome(far), np.array(lbr.HOME))
    assert {REACH, STRETCHED} == set(examination.skipped.values())
    assert min(np.abs(segment.path.q[:, 3]).min() for segment in examination.segments) > KINEMATIC_LIMITS.straight_rad


def test_paths_keep_the_elbow_bent(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also between targets: the filter of targets is switched off here."""
    reachable = ExamPlanner._reachable

    def lenient(self: ExamPlanner, *arguments: Any) -> Any:
        with monkeypatch.context() as patch:
            patch.setattr(ArmKinematics, "stretched", lambda self, q, bend: False)
            return reachable(self, *arguments)

    monkeypatch.setattr(ExamPlanner, "_reachable", lenient)
    far, bend = known(Robot(base_xy_m=(-0.165, 0.0)), region_m=(0.15, 0.025), centre_m=(0.0, 0.0)), 0.5
    examination = ExamPlanner(far, PERIOD_S).examination(seen_dome(far), np.array(lbr.HOME), bend=bend)
    assert STRETCHED in examination.skipped.values()
    assert min(np.abs(segment.path.q[:, 3]).min() for segment in examination.segments if segment.free is None) > 0.98 * bend


def test_a_weak_arm_moves_within_its_torques(tmp_path: Path) -> None:
    file = tmp_path / "weak.yaml"
    file.write_text(arm_path("ur5").read_text() + "torque_nm: [4.0, 52.0, 30.0, 6.0, 3.0, 2.0]\n")
    durations = []
    for name in ("ur5", str(file)):
        kinematics = ArmKinematics(Robot(arm=name), LIMITS)
        home = kinematics.arm.home_rad
        trajectory = joint_trajectory(kinematics, np.array([home, home + np.array([1.0, 0, 0, 0, 0, 0])]), LIMITS, PERIOD_S)
        accelerations = np.gradient(trajectory.qd, PERIOD_S, axis=0)
        assert kinematics.torque_share(trajectory.q, trajectory.qd, accelerations) <= TIMING.torque_share
        durations.append(len(trajectory))
    assert durations[1] > 1.2 * durations[0]


def test_speed_limit_interpolates_and_brakes_ahead_of_a_slow_place() -> None:
    s = np.linspace(0.0, 1.0, 1001)
    limit = SpeedLimit(s, np.where(np.abs(s - 0.5) < 0.01, 0.01, 0.2), 0.1)
    found = [limit.at(place) for place in (-1.0, 0.1, 0.4, 0.5, 2.0)]
    assert found == pytest.approx([0.2, 0.2, np.sqrt(0.01**2 + 2 * 0.1 * 0.09), 0.01, 0.2], rel=0.01)
    coarse, speed = np.array((0.0, 0.3, 0.4)), np.array((0.1, 0.2, 0.05))
    for place in (0.06, 0.3, 0.33, 0.39):
        assert SpeedLimit(coarse, speed, 1e9).at(place) == np.interp(place, coarse, speed)  # so that it need not brake ahead


def test_axis_moves_to_its_target_at_rest() -> None:
    axis = JerkLimitedAxis(0.0, 0.5, 5.0, PERIOD_S)
    speeds = []
    while not axis.step(0.1, 0.05):
        speeds.append(axis.velocity)
        assert len(speeds) < 1000
    assert axis.position == pytest.approx(0.1)
    assert max(speeds) <= 0.05 + 1e-9


def test_an_axis_that_stood_still_starts_from_rest() -> None:
    axis = JerkLimitedAxis(0.0, 0.5, 5.0, PERIOD_S)
    for _ in range(20):
        axis.step(0.1, 0.05)
    assert axis.velocity > 0.02
    axis.stand()
    fresh = JerkLimitedAxis(axis.position, 0.5, 5.0, PERIOD_S)
    for _ in range(30):
        assert (axis.position, axis.velocity, axis.acceleration) == (fresh.position, fresh.velocity, fresh.acceleration)
        assert axis.step(0.1, 0.05) == fresh.step(0.1, 0.05)


def test_scan_postures_differ_and_none_leaves_the_workspace() -> None:
    exam = known(Robot())
    kinematics, X_AW = ArmKinematics(exam.robot, exam.limits), inverse(np.array(exam.X_WA))
    postures = look_postures(exam)
    assert np.array_equal(postures[0], lbr.HOME)
    assert all(np.abs(a - b).max() > 0.5 for i, a in enumerate(postures) for b in postures[:i])
    sides = [apply(X_AW, kinematics.pose(q)[:3, 3])[1] for q in postures]
    assert len(sides) >= 3
    narrow = exam.limits.model_copy(update={"workspace_max_m": (0.7, max(sides) - 0.01, 1.2)})
    inside = look_postures(exam.model_copy(update={"limits": narrow}))
    assert [apply(X_AW, kinematics.pose(q)[:3, 3])[1] for q in inside] == [y for y in sides if y < max(sides)]


def test_scan_postures_are_within_the_limits_of_the_first_joint(tmp_path: Path) -> None:
    file = tmp_path / "narrow.yaml"
    narrow = "lower_rad: [-2.9, -1.7, -2.9, -3.1, -2.9, 0.0, -2.9]\nupper_rad: [1.0, 1.7, 2.9, 0.0, 2.9, 3.7, 2.9]\n"
    file.write_text(arm_path("panda").read_text() + narrow)
    turns = [float(q[0]) for q in look_postures(known(Robot(arm=str(file))))]
    assert {0.0, -1.2} <= set(turns)
    assert max(turns) < 1.0


@pytest.mark.parametrize("lockstep", [True, False])
def test_a_result_is_due_at_its_time_and_on_a_wall_clock_not_before_it_is_there(lockstep: bool) -> None:
    go = Event()
    task = BackgroundTask(1000, 50, lambda: go.wait(10) and 7, lockstep=lockstep)
    assert not task.due(1049)
    assert task.due(1050) is lockstep
    go.set()
    assert task.result() == 7
    assert [task.due(1049), task.due(1050)] == [False, True]


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


def test_after_a_stop_in_a_free_motion_the_posture_begins_where_the_arm_is() -> None:
    free, press = Segment(PLACE, contact=False, free=MOTION), Segment(PLACE, contact=True)
    palpation = Palpation((free, press), known(), PERIOD_S, plane(np.eye(4)), Tally())
    palpation.step(0, ABOVE)
    palpation.pause()
    palpation.skip_free_motion()
    assert palpation.step(10 * MS, ABOVE._replace(q=GOAL)).setpoint.q == pytest.approx(GOAL)


def test_an_arm_that_does_not_arrive_ends_the_strokes() -> None:
    palpation = free_palpation()
    times = ticks(0, 10 * MS, len(MOTION) + round((WAIT.limit_s + 1) / 0.01))
    steps = [palpation.step(t, ABOVE) for t in times]
    assert steps[len(MOTION)].stage is StrokeStage.TRANSFER
    assert palpation.recovery.failed.reason is Reason.ARM_DISPLACED
    assert steps[-1].stage is StrokeStage.DONE


def test_strokes_that_are_left_in_a_free_motion_end_at_once() -> None:
    palpation = free_palpation()
    palpation.step(0, ABOVE)
    palpation.leave(MOVED)
    assert palpation.step(10 * MS, ABOVE).stage is StrokeStage.DONE


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
    motion._sample, motion._q_offset = 0.0, None
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


def test_a_dropped_task_does_not_delay_the_next() -> None:
    running, done = BackgroundTask(0, 0, lambda: sleep(0.1)), list[int]()
    dropped = BackgroundTask(0, 0, lambda: done.append(1))
    del dropped
    BackgroundTask(0, 0, lambda: None).result()
    assert running.due(0) and not done


def test_a_fork_waits_for_the_planning_thread() -> None:
    future = WORKER.submit(sleep, 0.1)
    if not (child := os.fork()):
        os._exit(not future.done())
    assert os.waitpid(child, 0)[1] == 0
