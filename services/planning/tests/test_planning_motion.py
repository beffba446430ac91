"""Tests of kinematics, collision scene, free motion and timing."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from planning_fakes import BASE, PERIOD_S, known, seen_dome

from palpate_models.numerics.frames import apply, inverse, rigid
from palpate_models.robot import lbr
from palpate_models.scenario.arm_file import arm_path
from palpate_models.scenario.schema import Limits, Robot
from palpate_planning.motion.kinematics import KINEMATIC_LIMITS, ArmKinematics
from palpate_planning.motion.planner import NoPathError, plan
from palpate_planning.motion.scene import CollisionScene
from palpate_planning.motion.timing import TIMING, JerkLimitedAxis, SpeedLimit, joint_trajectory, round_corners
from palpate_planning.strokes.path import centre, least_twist
from palpate_planning.strokes.plan import ExamPlanner, look_postures
from palpate_planning.strokes.segments import REACH, STRETCHED

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


def test_inverse_kinematics_meets_position_and_axis() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        q = rng.uniform(-0.7, 0.7, 7) * KINEMATICS.upper
        X = KINEMATICS.pose(q)
        solution = KINEMATICS.solve(X, q + rng.normal(0, 0.2, 7))
        assert solution.ok
        found = KINEMATICS.pose(solution.q)
        assert found[:3, 3] == pytest.approx(X[:3, 3], abs=1e-4)
        assert found[:3, 2] == pytest.approx(X[:3, 2], abs=1e-3)
        assert found[:3, 0] == pytest.approx(X[:3, 0], abs=1e-3)
        assert np.all(np.abs(solution.q) <= KINEMATICS.upper)


def test_an_unreachable_pose_is_reported() -> None:
    X = KINEMATICS.pose(np.array(lbr.HOME))
    X[:3, 3] = (3.0, 0.0, 1.0)
    assert not KINEMATICS.solve(X, np.array(lbr.HOME)).ok


def test_home_is_free_and_the_table_is_not() -> None:
    assert SCENE.free(np.array(lbr.HOME))
    deep = np.array([0.0, 1.9, 0.0, -0.3, 0.0, 0.5, 0.0])
    assert not SCENE.free(deep)
    assert any("table" in pair or "abdomen" in pair for pair in SCENE.collisions(deep))


def test_only_the_tool_may_touch_and_only_in_the_contact_phase() -> None:
    pressed = above(0.0, 0.0, -0.010)
    contact = CollisionScene(KINEMATICS, BASE, (SEEN.vertices, SEEN.triangles), tool_may_touch=True)
    assert not SCENE.free(pressed)
    assert contact.free(pressed)
    buried = above(0.0, 0.0, -0.10)
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
    trajectory = joint_trajectory(KINEMATICS, round_corners(path, 0.1), LIMITS, PERIOD_S)
    assert trajectory.q[0] == pytest.approx(points[0], abs=1e-3)
    assert trajectory.q[-1] == pytest.approx(points[1], abs=1e-9)
    speed = np.abs(np.diff(trajectory.q, axis=0)) / PERIOD_S
    assert (speed <= LIMITS.joint_velocity_scale * lbr.VELOCITY_LIMIT * 1.02).all()
    assert (np.abs(np.diff(trajectory.qd, axis=0)) / PERIOD_S <= lbr.ARM.acceleration_radps2 * 1.1).all()
    tool = np.array([KINEMATICS.pose(q)[:3, 3] for q in trajectory.q])
    assert np.linalg.norm(np.diff(tool, axis=0), axis=1).max() / PERIOD_S <= LIMITS.speed_mps * 1.02
    assert trajectory.qd[-1] == pytest.approx(np.zeros(7), abs=1e-9)
    predicted = trajectory.q[:-1] + 0.5 * PERIOD_S * (trajectory.qd[:-1] + trajectory.qd[1:])
    assert predicted == pytest.approx(trajectory.q[1:], abs=3e-4)


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


def test_speed_limit_brakes_ahead_of_a_slow_place() -> None:
    s = np.linspace(0.0, 1.0, 1001)
    limit = SpeedLimit(s, np.where(np.abs(s - 0.5) < 0.01, 0.01, 0.2), 0.1)
    assert limit.at(0.5) == pytest.approx(0.01)
    assert limit.at(0.1) == pytest.approx(0.2)
    assert limit.at(0.4) == pytest.approx(np.sqrt(0.01**2 + 2 * 0.1 * 0.09), rel=0.01)


def test_axis_moves_to_its_target_at_rest() -> None:
    axis = JerkLimitedAxis(0.0, 0.5, 5.0, PERIOD_S)
    speeds = []
    while not axis.step(0.1, 0.05):
        speeds.append(axis.velocity)
        assert len(speeds) < 1000
    assert axis.position == pytest.approx(0.1)
    assert max(speeds) <= 0.05 + 1e-9


def test_a_speed_limit_between_its_places_is_numpys_to_the_bit() -> None:
    rng = np.random.default_rng(5)
    s, speed = np.unique(np.round(rng.uniform(0.0, 1.0, 40), 3)), rng.uniform(0.01, 0.2, 40)
    limit = SpeedLimit(s, speed[: len(s)], 1e9)  # so that it need not brake ahead
    for place in (-0.1, 1.1, *s.tolist(), *rng.uniform(0.0, 1.0, 500).tolist()):
        assert limit.at(place) == np.interp(place, s, speed[: len(s)])
    assert [SpeedLimit(s[:1], speed[:1], 0.1).at(place) for place in (-1.0, float(s[0]), 1.0)] == [speed[0]] * 3


def test_an_axis_that_stood_still_starts_from_rest() -> None:
    axis = JerkLimitedAxis(0.0, 0.5, 5.0, PERIOD_S)
    for _ in range(20):
        axis.step(0.1, 0.05)
    assert axis.velocity > 0.02
    axis.stand()
    fresh = JerkLimitedAxis(axis.position, 0.5, 5.0, PERIOD_S)
    assert axis.velocity == axis.acceleration == 0.0
    for _ in range(30):
        assert axis.step(0.1, 0.05) == fresh.step(0.1, 0.05)
        assert (axis.position, axis.velocity, axis.acceleration) == (fresh.position, fresh.velocity, fresh.acceleration)


def test_scan_postures_leave_the_view_free_and_differ() -> None:
    postures = look_postures(known(Robot()))
    assert len(postures) >= 3
    assert np.array_equal(postures[0], lbr.HOME)
    assert all(np.abs(a - b).max() > 0.5 for i, a in enumerate(postures) for b in postures[:i])


def test_no_scan_posture_leaves_the_workspace() -> None:
    exam = known(Robot())
    kinematics, X_AW = ArmKinematics(exam.robot, exam.limits), inverse(np.array(exam.X_WA))
    sides = [apply(X_AW, kinematics.pose(q)[:3, 3])[1] for q in look_postures(exam)]
    narrow = exam.limits.model_copy(update={"workspace_max_m": (0.7, max(sides) - 0.01, 1.2)})
    inside = look_postures(exam.model_copy(update={"limits": narrow}))
    assert [apply(X_AW, kinematics.pose(q)[:3, 3])[1] for q in inside] == [y for y in sides if y < max(sides)]


def test_scan_postures_are_within_the_limits_of_the_first_joint(tmp_path: Path) -> None:
    file = tmp_path / "narrow.yaml"
    narrow = "lower_rad: [-2.9, -1.7, -2.9, -3.1, -2.9, 0.0, -2.9]\nupper_rad: [1.0, 1.7, 2.9, 0.0, 2.9, 3.7, 2.9]\n"
    file.write_text(arm_path("panda").read_text() + narrow)
    turns = [float(q[0]) for q in look_postures(known(Robot(arm=str(file))))]
    assert 0.0 in turns
    assert -1.2 in turns
    assert max(turns) < 1.0
