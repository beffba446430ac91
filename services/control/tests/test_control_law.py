"""The control law at rest, and in motion on a simulated arm with friction and one millisecond from measuring to acting."""

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from control_plant import ROBOT, WORKING, External, Plant, no_force, reference, setpoint
from hypothesis import given, settings, strategies as st

from palpate_bus.setpoint import ControlMode, Setpoint
from palpate_control import impedance
from palpate_control.impedance import ImpedanceController
from palpate_control.model import ArmModel
from palpate_control.reference import TUNING, Extrapolator, Reference
from palpate_models.robot.arm import urdf
from palpate_models.robot.lbr import HOME, POSITION_LIMIT, TORQUE_LIMIT
from palpate_models.scenario.schema import Robot

REST = np.zeros(7)


@pytest.fixture(scope="module")
def arm() -> ArmModel:
    return ArmModel(urdf(ROBOT))


@pytest.fixture
def unlimited(arm: ArmModel, monkeypatch: pytest.MonkeyPatch) -> ImpedanceController:
    """Return the law without its rate limit."""
    monkeypatch.setattr(impedance, "TORQUE_RATE_NM_PER_MS", 1e9)
    return ImpedanceController(arm)


def offset(arm: ArmModel, q: np.ndarray, twist: np.ndarray) -> Reference:
    """Return a reference away from posture `q` by a displacement in world, without null-space posture."""
    held = setpoint(arm, q, joint_stiffness=np.zeros(7))
    return reference(held._replace(p_WD=held.p_WD + twist[:3], R_WD=pin.exp3(twist[3:]) @ held.R_WD))


@pytest.mark.parametrize("q", WORKING)
def test_springs_are_the_gradient_of_their_energy(arm: ArmModel, unlimited: ImpedanceController, q: np.ndarray) -> None:
    ref = offset(arm, q, np.array([0.01, -0.02, 0.015, 0.2, -0.1, 0.15]))

    def energy(at: np.ndarray) -> float:
        arm.update(at, REST)
        error = np.concatenate(((ref.motion.p_WD - arm.p_WI) @ ref.motion.R_WD, pin.log3(ref.motion.R_WD.T @ arm.R_WI)))
        return 0.5 * float(ref.setpoint.stiffness @ error**2)

    slope = [(energy(q + dq) - energy(q - dq)) / 2e-6 for dq in 1e-6 * np.eye(7)]
    np.testing.assert_allclose(unlimited.command(q, REST, ref), -np.array(slope), rtol=1e-5, atol=1e-4)


def test_position_error_is_clipped(arm: ArmModel, unlimited: ImpedanceController) -> None:
    for z in (0.2, 0.4):
        ref = offset(arm, WORKING[1], np.array([0.0, 0.0, z, 0, 0, 0]))
        ref.motion.R_WD[:] = np.diag([1.0, -1.0, -1.0])  # axes of W, so that the clip of z is that of D's z
        ref.setpoint.stiffness[:] = np.array([2000.0, 2000.0, 500.0, 0, 0, 0])
        torque = unlimited.command(WORKING[1], REST, ref)
        np.testing.assert_allclose(torque, arm.J_W[2] * 500 * impedance.LAW.position_clip_m, atol=1e-9)


def test_rotation_error_is_clipped(arm: ArmModel, unlimited: ImpedanceController) -> None:
    q = WORKING[1]
    arm.update(q, REST)
    axis = arm.R_WI[:, 0]
    torque = unlimited.command(q, REST, offset(arm, q, np.concatenate((np.zeros(3), 2.0 * axis))))
    np.testing.assert_allclose(torque, arm.J_W[3:].T @ axis * 200 * impedance.LAW.rotation_clip_rad, atol=1e-8)


@pytest.mark.parametrize("q", WORKING)
def test_null_space_torque_does_not_move_the_indenter(arm: ArmModel, unlimited: ImpedanceController, q: np.ndarray) -> None:
    apart = np.array([0.3, -0.2, 0.5, 0.1, -0.4, 0.2, 0.3])
    torque = unlimited.command(q, REST, reference(setpoint(arm, q, q=q + apart, joint_stiffness=np.full(7, 50.0))))
    assert np.abs(torque).max() == pytest.approx(impedance.LAW.null_torque_nm), "scaled as a whole"
    to_task = arm.J_W @ np.linalg.inv(arm.inertia(q) + impedance.LAW.slow_s * np.diag(arm.viscous_friction))
    assert np.linalg.norm(to_task @ torque) < 1e-4 * np.linalg.norm(to_task @ (50.0 * apart))


@pytest.mark.parametrize("ms", [1, 5])
def test_torque_changes_by_at_most_a_newton_metre_a_millisecond(arm: ArmModel, ms: int) -> None:
    controller = ImpedanceController(arm, period_s=ms / 1e3)
    q = WORKING[1]
    ref = offset(arm, q, np.array([0.1, 0.1, -0.1, 0.3, 0.3, 0.3]))
    before = np.zeros(7)
    for _ in range(200):
        after = controller.command(q, REST, ref)
        assert np.abs(after - before).max() <= ms * impedance.TORQUE_RATE_NM_PER_MS + 1e-12
        before = after
    assert np.abs(before).max() > 20


def test_command_and_gravity_together_stay_within_the_limits(arm: ArmModel, unlimited: ImpedanceController) -> None:
    q = np.deg2rad([0.0, 90.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    for sign in (-1, 1):
        pressed = setpoint(arm, q).p_WD + sign * np.array([0.0, 0.0, 0.09])
        asked = setpoint(arm, q, p_WD=pressed, stiffness=np.array([1e4, 1e4, 1e4, 200.0, 200.0, 200.0]))
        torque = unlimited.command(q, REST, reference(asked))
        assert (np.abs(torque) <= TORQUE_LIMIT).all()
        assert (np.abs(torque + arm.gravity) <= TORQUE_LIMIT + 1e-9).all()
        assert max(abs(torque[1]), abs((torque + arm.gravity)[1])) == pytest.approx(TORQUE_LIMIT[1])


@pytest.mark.parametrize("joint", range(7))
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_joint_limits_repel(arm: ArmModel, unlimited: ImpedanceController, joint: int, side: float) -> None:
    q = np.array(HOME)
    q[joint] = side * (POSITION_LIMIT[joint] - 0.06)
    at_rest = unlimited.command(q, REST, reference(setpoint(arm, q, mode=ControlMode.JOINT)))
    assert np.abs(at_rest).max() < 1e-9
    pushes = []
    for inside in (0.04, 0.02, 0.0, -0.05):
        q[joint] = side * (POSITION_LIMIT[joint] - inside)
        ref = reference(setpoint(arm, q, mode=ControlMode.JOINT))
        pushes.append(-side * unlimited.command(q, REST, ref)[joint])
    assert 0 < pushes[0] < pushes[1] < pushes[2] <= pushes[3]
    assert pushes[3] == pytest.approx(impedance.REPULSION_FRACTION * TORQUE_LIMIT[joint])


def test_stretched_out_arm_gives_finite_torque(arm: ArmModel) -> None:
    """Singular: the elbow is straight, wrist and shoulder axes coincide."""
    controller = ImpedanceController(arm)
    ref = offset(arm, np.zeros(7), np.array([0.01, 0.01, 0.01, 0.1, 0.1, 0.1]))
    for _ in range(20):
        assert np.isfinite(controller.command(np.zeros(7), REST, ref)).all()


def test_model_refuses_another_robot() -> None:
    joint = '<joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint>'
    one = f'<robot name="x"><link name="a"/><link name="b"/>{joint}</robot>'
    with pytest.raises(ValueError, match="1 joints"):
        ArmModel(one)
    with pytest.raises(ValueError, match="'probe'"):
        ArmModel(urdf(ROBOT), frame="probe")


def test_the_cartesian_law_is_that_of_its_description(arm: ArmModel, unlimited: ImpedanceController) -> None:
    """tau = J'F + N'tau_0 + C qd + friction, in matrices of full size, where nothing is clipped."""
    rng = np.random.default_rng(11)
    q, qd, twist, qd_0 = WORKING[1], *(0.02 * rng.normal(size=n) for n in (7, 6, 7))
    K, F_W = np.array([200.0] * 3 + [20.0] * 3), np.array([1.0, -2.0, -8.0, 0.1, 0.2, -0.3])
    asked = setpoint(arm, q, V_WD=twist, F_W=F_W, qd=qd_0, q=q + 0.01 * rng.normal(size=7), stiffness=K)
    torque = unlimited.command(q, qd, reference(asked))
    M, D, J, X = arm.inertia(q), np.diag(arm.viscous_friction), arm.J_W, np.kron(np.eye(2), asked.R_WD.T)
    W = np.linalg.inv(M + impedance.LAW.slow_s * D)
    J_bar = W @ J.T @ np.linalg.inv(J @ W @ J.T)
    m = np.diag(np.linalg.inv(X @ J @ np.linalg.inv(M) @ J.T @ X.T))
    b = (np.diag(np.linalg.inv(X @ J @ W @ J.T @ X.T)) - m) / impedance.LAW.slow_s
    m = np.minimum(m, 4 / np.diag(X @ J @ np.linalg.inv(M) @ J.T @ X.T))
    designed = 2 * asked.damping_ratio * np.sqrt(asked.stiffness * m)
    B = np.maximum(designed - b, impedance.LAW.min_damping * designed)
    B_0 = 2 * impedance.LAW.joint_damping_ratio * np.sqrt(asked.joint_stiffness / np.diag(np.linalg.inv(M)))
    tau_0 = asked.joint_stiffness * (asked.q - q) + B_0 * (qd_0 - qd)
    qd_d = qd_0 + J_bar @ (twist - J @ qd_0)
    friction = D @ qd_d + arm.coulomb_friction * qd_d / (np.abs(qd_d) + impedance.LAW.stiction_speed_radps)
    F = X.T @ (B * (X @ (twist - J @ qd)))
    expected = J.T @ (F + F_W) + (np.eye(7) - J.T @ J_bar.T) @ tau_0 + arm.bias - arm.gravity + friction
    np.testing.assert_allclose(torque, expected, rtol=1e-4, atol=1e-4)


MS = 1_000_000


def at(stamp: int, p: float = 0.0, v: float = 0.0, mode: ControlMode = ControlMode.CARTESIAN, **changes: Any) -> Setpoint:
    """Return a set-point at `p` along x and in each joint, with the velocity `v`."""
    x, one, joints = np.eye(6)[0], np.ones(6), np.ones(7)
    moving = Setpoint(stamp, mode, np.eye(3), p * x[:3], v * x, 0 * x, one, one, p * joints, v * joints, joints)
    return moving._replace(**changes)


@given(st.integers(0, 29), st.floats(-2, 2), st.floats(-3, 3))
@settings(deadline=None)  # the first example loads what is compiled
def test_pose_moves_with_its_twist(age_ms: int, v: float, w: float) -> None:
    guide = Extrapolator(10 * MS)
    twist = np.array([v, 0.5 * v, -v, 0.2 * w, w, -w])
    guide.accept(at(5 * MS, V_WD=twist), 5 * MS)
    now = guide.at((5 + age_ms) * MS)
    np.testing.assert_allclose(now.motion.p_WD, twist[:3] * age_ms * 1e-3, atol=1e-12)
    np.testing.assert_allclose(now.motion.R_WD, pin.exp3(twist[3:] * age_ms * 1e-3), atol=1e-12)
    np.testing.assert_allclose(now.motion.V_WD, twist)


@pytest.mark.parametrize("mode", ControlMode)
def test_accelerated_motion_stays_smooth(mode: ControlMode) -> None:
    """1 m/s^2 (or rad/s^2): no tick's step differs from the one before by more than 40 um; the error stays below 0.3 mm."""
    guide, path = Extrapolator(10 * MS), []
    for t in range(0, 500 * MS, MS):
        if t % (10 * MS) == 0:
            s = max(t - 10 * MS, 0) * 1e-9
            guide.accept(at(round(s * 1e9), 0.5 * s * s, s, mode), t)
        now = guide.at(t)
        path.append(now.motion.p_WD[0] if mode is ControlMode.CARTESIAN else now.motion.q[3])
    true = 0.5 * (np.arange(500) * 1e-3) ** 2
    assert np.abs(np.array(path) - true).max() < 3e-4
    assert np.abs(np.diff(path, 2)).max() < 4e-5


def test_steps_of_pose_and_wrench_fade_in() -> None:
    guide = Extrapolator(10 * MS)
    guide.accept(at(0), 10 * MS)
    guide.at(10 * MS)
    turned = pin.exp3(np.array([0.0, 0.0, 0.1]))
    guide.accept(at(10 * MS, 0.001, R_WD=turned, F_W=np.array([0.0, 0, 4, 0, 0, 0])), 20 * MS)
    values = [guide.at(t * MS) for t in range(20, 61)]
    p, f = np.array([v.motion.p_WD[0] for v in values]), np.array([v.motion.F_W[2] for v in values])
    angle = np.array([pin.log3(v.motion.R_WD)[2] for v in values])
    for series, end in ((p, 0.001), (f, 4.0), (angle, 0.1)):
        assert series[0] < 0.9 * end
        assert (np.diff(series) > 0).all()
        assert series[-1] == pytest.approx(end, rel=2e-3)


def test_a_clock_that_is_set_back_makes_no_gap_wider() -> None:
    """It would wind the springs up: 100 ms back made 60 N m of a gap of 2 um."""
    guide = Extrapolator(10 * MS)
    guide.accept(at(490 * MS), 500 * MS)
    guide.at(500 * MS)
    guide.accept(at(500 * MS, 2e-6), 501 * MS)
    assert 0.0 <= guide.at(501 * MS).motion.p_WD[0] <= 2e-6
    for back in (40, 100, 200):
        assert 0.0 <= guide.at((502 - back) * MS).motion.p_WD[0] <= 2e-6


def test_silent_sender_is_braked_smoothly() -> None:
    """Set-points stop: the motion continues for the bridging time, then brakes within 25 ms; in free motion it brakes softly."""
    guide = Extrapolator(10 * MS)
    guide.accept(at(0, 0.0, 1.0, ControlMode.JOINT), 0)
    rates = np.array([guide.at(t * MS).motion.qd[0] for t in range(700)])
    assert np.abs(np.diff(rates)).max() * 1e3 < 1.01 / TUNING.free_braking_s
    assert rates[-1] < 1e-2
    guide = Extrapolator(10 * MS)
    guide.accept(at(0, 0.0, 0.0, ControlMode.JOINT), 0)
    guide.accept(at(10 * MS, 0.0, 0.08, ControlMode.JOINT), 10 * MS)  # speeding up by 8 rad/s^2
    motions = [guide.at((10 + t) * MS).motion for t in range(700)]
    np.testing.assert_allclose(np.diff([m.q[0] for m in motions]) * 1e3, [m.qd[0] for m in motions[1:]], atol=0.01)
    guide = Extrapolator(10 * MS)
    guide.accept(at(0, 0.0, 0.1), 0)
    values = [guide.at(t * MS) for t in range(200)]
    v, p = (np.array([x[0] for x in found]) for found in zip(*((m.V_WD, m.p_WD) for _, m, _ in values), strict=True))
    bridge = TUNING.bridged_periods * 10
    assert v[bridge] == pytest.approx(0.1)
    assert v[bridge + 1] > 0.07
    assert abs(v[bridge + 30]) < 1e-3
    assert p[-1] == pytest.approx(0.1 * (bridge * 1e-3 + TUNING.smoothing_s))


def test_change_of_mode_starts_afresh() -> None:
    guide = Extrapolator(10 * MS)
    guide.accept(at(0, 0.3, 0.1), 0)
    guide.at(0)
    guide.accept(at(10 * MS, 1.0, 0.0, ControlMode.JOINT), 20 * MS)
    now = guide.at(20 * MS)
    assert now.setpoint.mode is ControlMode.JOINT
    np.testing.assert_allclose(now.motion.q, 1.0)
    np.testing.assert_allclose(now.motion.qdd, 0.0)


def test_joint_setpoints_determine_their_acceleration_within_bounds() -> None:
    guide = Extrapolator(10 * MS)
    guide.accept(at(0, 0.0, 0.0, ControlMode.JOINT), 0)
    guide.accept(at(10 * MS, 0.0, 0.05, ControlMode.JOINT), 10 * MS)
    assert guide.at(10 * MS).motion.qdd == pytest.approx(np.full(7, 5.0))
    guide.accept(at(20 * MS, 0.0, 1.5, ControlMode.JOINT), 20 * MS)
    assert guide.at(20 * MS).motion.qdd == pytest.approx(np.full(7, TUNING.max_acceleration_radps2))


def simulate(
    plant: Plant, robot: Robot, at: Callable[[int], Reference], ticks: int, external: External = no_force, *, late: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Positions of the indenter (ticks, 3) and torques (ticks, 7) under control, `late` ticks from measuring to acting."""
    controller = ImpedanceController(ArmModel(urdf(robot)))
    under_way = deque([np.zeros(7)] * late)
    positions, torques = [], []
    for k in range(ticks):
        command = controller.command(plant.q, plant.qd, at(k * MS))
        under_way.append(command)
        plant.step(under_way.popleft(), external)
        positions.append(plant.tip()[1])
        torques.append(command)
    return np.array(positions), np.array(torques)


@pytest.mark.parametrize("axis", [0, 2, 4])
def test_stiffness_is_what_was_asked_for(axis: int) -> None:
    """Displacement under a wrench along one axis of D is F / K within 2 %, without stiction."""
    robot = Robot(joint_friction_nm=0.0)
    arm, plant = ArmModel(urdf(robot)), Plant(WORKING[1], robot)
    ref = reference(setpoint(arm, WORKING[1], joint_stiffness=np.zeros(7)))
    R, p, _ = plant.tip()
    size = 10.0 if axis < 3 else 4.0
    wrench = size * np.kron(np.eye(2), R)[:, axis]
    controller, acting = ImpedanceController(arm), np.zeros(7)
    for _ in range(2500):
        command = controller.command(plant.q, plant.qd, ref)
        plant.step(acting + plant.tip()[2].T @ wrench)
        acting = command
    R_now, p_now, _ = plant.tip()
    moved = np.concatenate((R.T @ (p_now - p), pin.log3(R.T @ R_now)))
    assert moved[axis] == pytest.approx(size / ref.setpoint.stiffness[axis], rel=0.02)
    if axis < 3:
        assert np.abs(np.delete(moved[:3], axis)).max() < 0.02 * moved[axis]


@pytest.mark.parametrize(
    ("q", "spring", "damper"),
    [(WORKING[0], 400.0, 10.0), (WORKING[1], 2000.0, 20.0), (WORKING[2], 2000.0, 100.0), (WORKING[2], 400.0, 10.0)],
)
def test_stiff_control_is_stable_in_contact(arm: ArmModel, q: np.ndarray, spring: float, damper: float) -> None:
    """K_z = 5000 N/m pushes 10 mm into a spring and damper that starts at the indenter's depth: no chatter, no overshoot."""
    held = setpoint(arm, q)
    p0, n = held.p_WD, held.R_WD[:, 2]
    pushed = reference(held._replace(p_WD=p0 + 0.01 * n, stiffness=np.array([5000.0] * 3 + [200.0] * 3)))

    def contact(p: np.ndarray, v: np.ndarray) -> np.ndarray:
        depth = (p - p0) @ n
        return -n * max(0.0, spring * depth + damper * (v @ n)) if depth > 0 else np.zeros(3)

    positions, _ = simulate(Plant(q), ROBOT, lambda _: pushed, 1000, contact)
    depth = (positions - p0) @ n
    assert depth[-1] == pytest.approx(0.01 * 5000 / (5000 + spring), abs=2e-4)
    assert depth.max() < depth[-1] + 4e-4
    assert np.ptp(depth[-100:]) < 5e-5


@pytest.mark.parametrize(
    ("q", "assumed", "true"), [(WORKING[0], 10.0, 3.0), (WORKING[2], 10.0, 3.0), (WORKING[1], 0.0, 0.0), (WORKING[1], 10.0, 20.0)]
)
def test_stable_where_friction_is_not_what_it_is_thought_to_be(q: np.ndarray, assumed: float, true: float) -> None:
    robot, real = Robot(joint_damping_nms=assumed), Robot(joint_damping_nms=true)
    held = setpoint(ArmModel(urdf(robot)), q)
    moved = reference(held._replace(p_WD=held.p_WD + np.array([0.005, -0.005, 0.01])))
    plant = Plant(q, real)
    simulate(plant, robot, lambda _: moved, 1500)
    assert np.abs(plant.qd).max() < 0.02
    assert np.linalg.norm(plant.tip()[1] - moved.motion.p_WD) < 3e-3  # of 12: twice the friction also takes twice the time


@pytest.mark.parametrize(("q", "joint_stiffness"), [(WORKING[0], 20.0), (WORKING[2], 20.0), (WORKING[1], 0.0)])
def test_scan_keeps_up_with_its_setpoints(arm: ArmModel, q: np.ndarray, joint_stiffness: float) -> None:
    """30 mm/s in set-points that are 10 to 19 ms old: within 0.5 mm despite 10 Nms/rad, and posture does not drag it off."""
    held = setpoint(arm, q)
    V, stiffness, guide = 0.03 * np.eye(6)[1], np.full(7, joint_stiffness), Extrapolator(10 * MS)

    def at(t: int) -> Reference:
        if t % (10 * MS) == 0:
            sent = max(t - 10 * MS, 0)
            p = held.p_WD + V[:3] * sent * 1e-9
            guide.accept(setpoint(arm, q, sent, p_WD=p, V_WD=V, joint_stiffness=stiffness), t)
        return guide.at(t)

    positions, _ = simulate(Plant(q), ROBOT, at, 1000)
    lag = held.p_WD + np.outer(np.arange(1, 1001) * 1e-3, V[:3]) - positions
    assert np.abs(lag[300:]).max() < 5e-4


def test_joint_mode_follows_a_motion(arm: ArmModel) -> None:
    """A minimum-jerk motion of up to 0.8 rad in 1.2 s: within 15 mrad on the way, 2 mrad at its end."""
    start, end = np.array(HOME), np.array(HOME) + np.array([0.8, 0.5, -0.3, 0.4, 0.3, -0.5, 0.6])
    duration = 1.2

    def planned(t: int) -> tuple[np.ndarray, np.ndarray]:
        x = min(max(t * 1e-9 / duration, 0.0), 1.0)
        s, sd = 10 * x**3 - 15 * x**4 + 6 * x**5, (30 * x**2 - 60 * x**3 + 30 * x**4) / duration
        return start + s * (end - start), sd * (end - start)

    guide = Extrapolator(10 * MS)
    plant = Plant(start)
    errors = []

    def at(t: int) -> Reference:
        if t % (10 * MS) == 0:
            q, qd = planned(t - 10 * MS)
            guide.accept(setpoint(arm, start, t - 10 * MS, ControlMode.JOINT, q=q, qd=qd), t)
        errors.append(np.abs(plant.q - planned(t)[0]).max())
        return guide.at(t)

    simulate(plant, ROBOT, at, 1600)
    assert max(errors) < 0.015
    assert errors[-1] < 0.002


def test_joint_mode_is_calm_where_torques_act_late(arm: ArmModel) -> None:
    """Joints 1 and 3 of almost one axis, 8 ms from measuring to acting, as with an arm behind two more processes."""
    posture = np.array([-0.15, 0.35, 0.03, -1.8, 0.0, 0.92, 0.0])
    firm = np.array([800.0, 800.0, 600.0, 600.0, 400.0, 300.0, 200.0])
    hold = reference(setpoint(arm, posture, mode=ControlMode.JOINT, joint_stiffness=firm))
    plant = Plant(posture + np.array([0.01, 0.0, -0.01, 0.0, 0.0, 0.0, 0.0]))
    _, torques = simulate(plant, ROBOT, lambda t: hold, 1500, late=8)
    assert np.abs(np.diff(torques[-200:], axis=0)).max() < 0.01
    assert np.abs(plant.q - posture).max() < 5e-4


def test_change_of_mode_is_bumpless(arm: ArmModel) -> None:
    """Joint hold, Cartesian hold, joint hold, in contact force: neither torque nor indenter jumps."""
    q = WORKING[1]
    holds = {mode: reference(setpoint(arm, q, mode=mode)) for mode in ControlMode}

    def at(t: int) -> Reference:
        return holds[ControlMode.CARTESIAN if 500 * MS <= t < 1000 * MS else ControlMode.JOINT]

    positions, torques = simulate(Plant(q), ROBOT, at, 1500, lambda p, v: np.array([0.0, 0.0, 5.0]))
    assert np.abs(np.diff(torques, axis=0)).max() <= 1.0 + 1e-9
    speed = np.linalg.norm(np.diff(positions, axis=0), axis=1) / 1e-3
    assert speed[490:].max() < 0.05
    assert np.ptp(positions[-100:], axis=0).max() < 1e-4
