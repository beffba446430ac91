"""Strokes of a scan: coverage, poses of the indenter, set-points along a path."""

from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st
from planning_fakes import known
from scipy.spatial.transform import Rotation

from palpate_bus.setpoint import ControlMode
from palpate_models.robot import lbr
from palpate_models.scenario.patterns import LIMITS
from palpate_models.scenario.schema import CommandLevel, Mode, Robot
from palpate_planning.motion.kinematics import IkSolution
from palpate_planning.motion.planner import NoPathError
from palpate_planning.reasons import Cause
from palpate_planning.stroke import StrokeInput, lift
from palpate_planning.stroke_motion import StrokeMotion, stroke_setpoint
from palpate_planning.strokes.coverage import TUNING, Stroke, strokes, touches
from palpate_planning.strokes.path import SurfacePath, centre, frame, frames_along, least_twist
from palpate_planning.strokes.plan import REACH, SEGMENTS, STRETCHED, Segment, SegmentPlanner
from palpate_planning.wall.surface import PerceivedSurface
from palpate_planning.wall.wall import plane

SPACING = 0.0125


def grid(columns: int, rows: int, snake: bool) -> tuple[np.ndarray, np.ndarray]:
    xy, lines = [], []
    for j in range(rows):
        order = range(columns - 1, -1, -1) if snake and j % 2 else range(columns)
        xy += [(i * SPACING, j * SPACING) for i in order]
        lines += [j] * columns
    return np.array(xy), np.array(lines)


@given(st.integers(2, 6), st.integers(1, 5), st.booleans(), st.sampled_from(list(Mode)), st.integers(0, 2**30 - 1))
@settings(deadline=None)
def test_every_usable_target_is_visited_once_in_order(columns: int, rows: int, joined: bool, mode: Mode, mask: int) -> None:
    xy, lines = grid(columns, rows, joined)
    usable = np.array([bool(mask >> i & 1) for i in range(len(xy))])
    pieces = strokes(xy, lines, usable, joined, mode, SPACING)
    visited = [int(i) for piece in pieces for i in piece.targets]
    assert visited == np.flatnonzero(usable).tolist()
    for piece in pieces:
        assert piece.xy[piece.visits] == pytest.approx(xy[piece.targets], abs=1e-9)


def test_a_snake_is_one_stroke_without_corners() -> None:
    xy, lines = grid(6, 4, snake=True)
    (stroke,) = strokes(xy, lines, np.ones(len(xy), dtype=bool), True, Mode.CONTINUOUS, SPACING)
    steps = np.diff(stroke.xy, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    assert lengths.max() < 1.5 * TUNING.sample_m
    turns = np.arccos(np.clip((steps[1:] * steps[:-1]).sum(axis=1) / (lengths[1:] * lengths[:-1]), -1, 1))
    assert turns.max() < 0.5, "a semicircle of 6.25 mm in steps of 2 mm turns by 0.32 rad a step"
    assert stroke.xy[:, 0].max() < 5 * SPACING + 0.6 * SPACING


def test_a_skipped_target_breaks_the_stroke_and_a_break_keeps_its_targets() -> None:
    xy, lines = grid(5, 2, snake=True)
    for skipped, breaks, expected in (
        ([2], set[int](), [[0, 1], [3, 4, 5, 6, 7, 8, 9]]),
        ([], {1, 4}, [[0, 1], [2, 3, 4], [5, 6, 7, 8, 9]]),
    ):
        usable = ~np.isin(np.arange(len(xy)), skipped)
        pieces = strokes(xy, lines, usable, True, Mode.CONTINUOUS, SPACING, breaks)
        assert [piece.targets.tolist() for piece in pieces] == expected


def test_touches_are_spread_over_all_that_is_usable() -> None:
    xy, _ = grid(17, 17, snake=True)
    usable = np.ones(len(xy), dtype=bool)
    usable[:40] = False
    spread = touches(xy, usable)
    assert all(piece.touch and len(piece.xy) == 1 and usable[piece.targets[0]] for piece in spread)
    places = np.array([piece.xy[0] for piece in spread])
    assert len(places) == 9
    assert np.linalg.norm(xy[usable][:, None] - places, axis=-1).min(axis=1).max() < LIMITS.touches_m
    assert touches(xy, np.zeros(len(xy), dtype=bool)) == []


coordinate = st.floats(-1.0, 1.0)
vectors = st.tuples(coordinate, coordinate, coordinate).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.05)
units = vectors.map(lambda v: v / np.linalg.norm(v))
rotations = st.tuples(vectors, st.floats(-3.1, 3.1)).map(
    lambda a: Rotation.from_rotvec(a[0] / np.linalg.norm(a[0]) * a[1]).as_matrix()
)


@given(units, rotations)
@settings(deadline=None)
def test_tool_axis_is_opposite_to_the_normal_and_no_other_orientation_is_nearer(normal: np.ndarray, R_near: np.ndarray) -> None:
    R = least_twist(-normal, R_near)
    assert R[:, 2] == pytest.approx(-normal, abs=1e-9)
    assert np.abs(R.T @ R - np.eye(3)).max() < 1e-9
    assert np.linalg.det(R) == pytest.approx(1.0)
    turned = [R @ Rotation.from_rotvec((0, 0, a)).as_matrix() for a in (-0.3, -0.05, 0.05, 0.3)]
    assert all(np.trace(R_near.T @ R) >= np.trace(R_near.T @ other) - 1e-9 for other in turned)


@given(rotations, vectors)
@settings(deadline=None)
def test_a_frame_has_the_given_z_axis_and_keeps_its_x_axis_near(R: np.ndarray, x_near: np.ndarray) -> None:
    z = R[:, 2].copy()
    assume(np.linalg.norm(np.cross(z, x_near)) > 1e-3)
    found = frame(z, x_near)
    assert found[:, 2] == pytest.approx(z, abs=1e-12)
    assert np.abs(found.T @ found - np.eye(3)).max() < 1e-9
    assert np.linalg.det(found) == pytest.approx(1.0)
    assert found[:, 1] @ x_near == pytest.approx(0.0, abs=1e-12)
    assert found[:, 0] @ x_near > 0.0


DOWN = np.diag((1.0, -1.0, -1.0))


def dome_path(samples: int) -> SurfacePath:
    """Return a path over a dome, reached targets 7, 3 and 5 on it."""
    xy = np.column_stack((np.linspace(-0.05, 0.05, samples), np.full(samples, 0.01))) if samples > 1 else np.zeros((1, 2))
    x, y = np.meshgrid(np.arange(-0.1, 0.1, 0.01), np.arange(-0.1, 0.1, 0.01))
    vertices = np.column_stack((x.ravel(), y.ravel(), -(x.ravel() ** 2) / 0.5 - y.ravel() ** 2))
    s, p, n, R = frames_along(PerceivedSurface.from_mesh(vertices, None, np.eye(4)), xy, DOWN)
    q = np.outer(1.0 + s, np.arange(1.0, 8.0)) ** 2
    visits = np.array([0, samples // 2, samples - 1]) if samples > 1 else np.zeros(1, int)
    return SurfacePath(s, p, n, R, q, np.array([7, 3, 5])[: len(visits)], visits)


@pytest.mark.parametrize("samples", [1, 21])
def test_a_setpoint_is_the_path_point_at_a_distance_from_the_surface(samples: int) -> None:
    path, push = dome_path(samples), 1.7
    for s in np.linspace(-0.01, path.length + 0.01, 50).tolist():
        point = path.at(s)
        setpoint = stroke_setpoint(7, point, 0.03, 0.0173, -0.002, push)
        assert (setpoint.mode, setpoint.stamp) == (ControlMode.CARTESIAN, 7)
        assert setpoint.p_WD == pytest.approx(centre(point.p_W, point.n_W, 0.0173, 0.0))
        assert setpoint.R_WD[:, 2] == pytest.approx(-point.n_W)
        assert setpoint.F_W.tolist() == [*(-push * point.n_W), 0.0, 0.0, 0.0]
        assert np.array_equal(setpoint.q, point.q)


def test_the_velocities_of_a_setpoint_are_its_rates_of_change() -> None:
    path, rate, sinking, dt = dome_path(21), 0.03, -0.002, 1e-4
    for s in np.linspace(0.01, path.length - 0.01, 20).tolist():
        before, now, after = (
            stroke_setpoint(0, path.at(s + k * rate * dt), rate, 0.01 - k * sinking * dt, sinking, 0.0) for k in (-1, 0, 1)
        )
        assert now.V_WD[:3] == pytest.approx((after.p_WD - before.p_WD) / (2 * dt), abs=1e-5)
        assert now.V_WD[3:] == pytest.approx(Rotation.from_matrix(after.R_WD @ before.R_WD.T).as_rotvec() / (2 * dt), abs=1e-3)
        assert now.qd == pytest.approx((after.q - before.q) / (2 * dt), abs=1e-5)


@pytest.mark.parametrize(("level", "kept"), [(CommandLevel.POSITION, True), (CommandLevel.TORQUE, False)])
@pytest.mark.parametrize(("slope", "wave_rad"), [(20.0, 0.0), (0.0, 0.1)], ids=["almost straight elbow", "singular wrist"])
def test_drives_can_follow_a_joint_that_turns_fast(level: CommandLevel, kept: bool, slope: float, wave_rad: float) -> None:
    """A joint turns by 20 rad per metre, or to and fro by 0.2 rad in 30 mm. An arm with an impedance yields."""
    path, settings = dome_path(61), known(Robot(level=level))
    q, visits = np.outer(slope * path.s + wave_rad * np.sin(100 * path.s), np.eye(7)[3]), np.array([0, 30, 60])
    path = SurfacePath(path.s, path.p, path.n, path.R, q, path.targets, visits)
    motion = StrokeMotion(settings.exam, settings.limits, settings.robot, 0.01, plane(np.eye(4)))
    motion.start(Segment(path, contact=False))
    joint = [0.0]
    while not motion.travel(path.length):
        joint.append(motion.point.q[3])
    acceleration = np.abs(np.diff(joint, 2)).max() / 0.01**2
    assert bool(acceleration < 1.1 * lbr.ARM.acceleration_radps2[3]) is kept


def test_a_transfer_that_is_left_comes_to_rest_before_the_lift_ends() -> None:
    """It is at the lift's height already; what follows begins with the arm at rest."""
    path, settings = dome_path(21), known()
    motion = StrokeMotion(settings.exam, settings.limits, settings.robot, 0.01, plane(np.eye(4)))
    motion.start(Segment(path, contact=False))
    while motion.along.velocity < 0.01:
        motion.travel(path.length)
    lifting = lift(motion, lambda t: SEGMENTS.hover_m)
    next(lifting)
    with pytest.raises(StopIteration):
        for k in range(100):
            lifting.send(StrokeInput(k, Mock(), ending=True))
    assert motion.along.velocity < 1e-3


def test_the_speed_limit_holds_between_strokes() -> None:
    path, settings = dome_path(21), known()
    limits = settings.limits.model_copy(update={"speed_mps": 0.012})
    motion = StrokeMotion(settings.exam, limits, settings.robot, 0.01, plane(np.eye(4)))
    motion.start(Segment(path, contact=False))
    lifting, lifted, travelled = lift(motion, lambda t: 0.1), [0.0], [0.0]
    next(lifting)
    for k in range(100):
        lifting.send(StrokeInput(k, Mock(), paused=True))
        lifted.append(-motion.depth_axis.velocity)
    while not motion.travel(path.length):
        travelled.append(motion.along.velocity)
    assert [max(lifted), max(travelled)] == pytest.approx([0.012, 0.012], rel=1e-3)


def test_the_target_is_the_one_reached_last() -> None:
    path = dome_path(21)
    _, middle, end = path.visits
    reached = [path.target(s) for s in (-1.0, 0.0, middle - 1e-9, middle, end - 1e-9, end, end + 1.0)]
    assert reached == [7, 7, 7, 3, 3, 5, 5]


@pytest.mark.parametrize(("fault", "reason"), [("reach", REACH), ("stretched", STRETCHED), ("collision", None)])
def test_a_target_that_the_arm_cannot_take_is_dropped_with_the_cause(fault: str, reason: Cause | None) -> None:
    """The arm fails on the far side of a flat patch, where two of three targets are."""
    x, y = np.meshgrid(np.linspace(-0.1, 0.1, 21), np.linspace(-0.1, 0.1, 21))
    surface = PerceivedSurface.from_mesh(np.column_stack((x.ravel(), y.ravel(), np.zeros(x.size))), None, np.eye(4))
    fails = Mock(side_effect=lambda X_WI, near: IkSolution(X_WI[:, 3], fault != "reach" or X_WI[0, 3] < 0.01))
    kinematics = Mock(solve=fails, stretched=lambda q, bend: fault == "stretched" and q[0] >= 0.01)
    kinematics.pose.return_value = np.eye(4)
    scene = Mock(free=lambda q: fault != "collision" or q[0] < 0.01, collisions=lambda q: ["elbow"])
    planner = SegmentPlanner(kinematics, scene, surface, np.zeros((3, 4)), known(), 0.1, Mock(side_effect=NoPathError("none")))
    xy = np.column_stack((np.linspace(0.0, 0.02, 11), np.zeros(11)))
    dropped = planner.layout([Stroke(xy, np.arange(3), np.array([0, 5, 10]))]).dropped
    assert set(dropped) == {1, 2}
    assert dropped[1] == reason if reason else "elbow" in dropped[1].text
