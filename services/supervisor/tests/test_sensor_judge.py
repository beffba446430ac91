"""The judge of F/T sensor and joints, on an arm that moves freely and then presses: nominal dynamics, noise, friction, bias."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pinocchio as pin
import pytest

from palpate.exam_state import exam_state
from palpate_bus.messages import ExamState
from palpate_bus.messages.geometry import vector
from palpate_models.numerics.frames import GRAVITY
from palpate_models.robot import lbr
from palpate_models.robot.arm import urdf
from palpate_models.scenario.load import exam_input, load_scenario
from palpate_supervisor.judge import EXAM, FT, JOINTS, DepthAgreement, MotionAgreement, SensorJudge
from palpate_supervisor.senses import BY_CURRENT, ForceComparison, ForceSenses, Measurement, ToolSense

ROBOT = exam_input(load_scenario("clean")).robot
DT, LIE_S, PRESS_S, END_S = 0.01, 8.0, 7.0, 12.0
UP = np.array((0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
Lie = Callable[[float, Measurement], Measurement]


@cache
def measurements() -> tuple[Measurement, ...]:
    """At rest for a second, then six of free motion, then a press of up to 8 N; the joints have friction of 0.2 N m."""
    model = pin.buildModelFromXML(urdf(ROBOT, geometry=False))
    data, sensor, rng = model.createData(), model.getFrameId("ft_sensor"), np.random.default_rng(1)
    t = np.arange(0.0, END_S, DT)
    angle = np.where((t > 1.0) & (t < PRESS_S), 1 - np.cos(2 * np.pi * (t - 1.0) / 3.0), 0.0)
    q = np.array(lbr.HOME) + 0.25 * np.outer(angle, (0.6, 1.0, -0.5, 0.8, 0.7, 1.0, 0.3))
    qd = np.gradient(q, DT, axis=0)
    qdd = np.gradient(qd, DT, axis=0)
    found = []
    for i in range(len(t)):
        force_W = np.array((0.0, 0.0, 4.0 * (1 - np.cos(np.pi * (t[i] - PRESS_S))) if t[i] > PRESS_S else 0.0))
        J = pin.computeFrameJacobian(model, data, q[i], model.getFrameId("indenter"), pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)[:3]
        pin.forwardKinematics(model, data, q[i], qd[i], qdd[i])
        R_WS = pin.updateFramePlacement(model, data, sensor).rotation
        a_W = pin.getFrameClassicalAcceleration(model, data, sensor, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED).linear
        friction = 0.2 * np.sign(qd[i]) * (np.abs(qd[i]) > 1e-6)
        torque = pin.rnea(model, data, q[i], qd[i], qdd[i]) - J.T @ force_W + friction + rng.normal(0.0, 0.03, 7)
        load_W = force_W - ROBOT.tool_mass_kg * (a_W + GRAVITY * UP[:3])
        wrench = np.concatenate((R_WS.T @ load_W + (1.0, -0.5, 0.7) + rng.normal(0.0, 0.03, 3), np.zeros(3)))
        found.append(Measurement(q[i], qd[i], wrench, torque))
    return tuple(found)


def first_breach(lie: Lie = lambda t, true: true) -> tuple[float, str, ForceComparison] | None:
    """Return time [s], culprit and comparison of the first breach."""
    sense, judge = ToolSense(ROBOT), SensorJudge()
    for i, true in enumerate(measurements()):
        sense.sense(lie(i * DT, true), DT)
        depth = -0.2 if i * DT < PRESS_S else 0.0
        for breach in judge.judge(sense.comparison, depth):
            return i * DT, breach.culprit, sense.comparison
    return None


def wrong_ft(change: Callable[[float, np.ndarray], np.ndarray], since_s: float = LIE_S) -> Lie:
    return lambda t, true: true._replace(wrench_S=change(t, true.wrench_S)) if t >= since_s else true


@pytest.mark.parametrize("lie", [lambda t, true: true, lambda t, true: true._replace(torque=np.zeros(0))])
def test_true_senses_agree(lie: Lie) -> None:
    assert first_breach(lie) is None


RNG = np.random.default_rng(3)
SUDDEN: dict[str, Callable[[float, np.ndarray], np.ndarray]] = {
    "zero": lambda t, w: 0.0 * w,
    "sign": lambda t, w: -w,
    "bias": lambda t, w: w + 5.0 * UP,
    "gain 0.1": lambda t, w: 0.1 * w,
    "gain 2": lambda t, w: 2.0 * w,
    "noise": lambda t, w: w + RNG.normal(0.0, 2.0, 6),
}


@pytest.mark.parametrize(
    ("lie", "within_s"),
    [
        *((wrong_ft(change), 0.3) for change in SUDDEN.values()),
        (wrong_ft(lambda t, w: w + (t - LIE_S) * UP), 4.0),
        (wrong_ft(SUDDEN["gain 0.1"], 0.0), PRESS_S - LIE_S),
        (wrong_ft(SUDDEN["sign"], 0.0), PRESS_S - LIE_S),
        (wrong_ft(lambda t, w: 1e-2 * RNG.standard_normal(6), 0.0), PRESS_S - LIE_S),
        (wrong_ft(lambda t, w: w + RNG.normal(0.0, 0.6, 6), 0.5), 0.7 - LIE_S),
    ],
    ids=[*SUDDEN, "drift", "gain 0.1 from the start", "sign from the start", "dead from the start", "noise at rest"],
)
def test_a_wrong_force_sensor_is_named(lie: Lie, within_s: float) -> None:
    found = first_breach(lie)
    assert found is not None
    assert found[1] == FT
    assert found[0] - LIE_S <= within_s


@pytest.mark.parametrize(
    "change",
    [
        lambda m: m._replace(torque=-m.torque),
        lambda m: m._replace(torque=0.0 * m.torque),
        lambda m: m._replace(torque=1.3 * m.torque),
        lambda m: m._replace(q=m.q + 0.1),
        lambda m: m._replace(q=m.q[::-1].copy(), qd=m.qd[::-1].copy()),
    ],
)
def test_wrong_joints_are_named(change: Callable[[Measurement], Measurement]) -> None:
    found = first_breach(lambda t, true: change(true) if t >= LIE_S else true)
    assert found is not None
    assert found[1] == JOINTS
    assert found[0] - LIE_S <= 0.3


def test_a_tool_that_was_not_weighed_touches_nothing() -> None:
    judge, silent = SensorJudge(), ForceComparison(0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.1, 0.1)
    assert not judge.judge(silent, -0.1)
    (breach,) = judge.judge(silent, -0.01)
    assert breach.culprit == FT


R_WS = np.eye(3, order="F")
"""Laid out as the service's, for which the comparison is compiled already."""


@pytest.mark.parametrize(("gain", "excitation", "seen"), [(1.4, 5.0, False), (1.4, 50.0, True), (0.3, 5.0, True)])
def test_a_gain_weighed_while_the_bias_wanders_is_uncertain(gain: float, excitation: float, seen: bool) -> None:
    weighed = ForceComparison(0.0, 0.0, 0.0, 0.0, 0.0, gain, excitation, 0.1, 0.1)
    assert [breach.culprit for breach in SensorJudge().judge(weighed, None)] == [FT] * seen


def test_joints_whose_load_changed_fast_are_trusted_less_until_their_offset_is_learned() -> None:
    senses, J = ForceSenses(6, BY_CURRENT), 0.6 * np.eye(3, 6)
    sd = []
    for t in np.arange(0.0, 10.0, DT):
        reading = Measurement(np.zeros(6), np.zeros(6), np.zeros(6), np.full(6, -100.0 if t < 3.0 else -10.0))
        sd.append(senses.compare(reading, np.zeros(6), J, np.zeros(3), R_WS, 0.0, DT, (t < 1.0, True)).joint_sd)
    assert sd[310] > 2 * sd[-1]
    assert sd[-1] == pytest.approx(0.4 / 0.6, rel=0.1)


def test_joints_that_reverse_are_trusted_less_until_their_friction_is_learned() -> None:
    sense, sds = ToolSense(ROBOT), []
    true = measurements()[0]
    for speed in (*np.repeat((0.02, -0.02), 60), *np.tile(np.repeat((0.02, -0.02), 60), 10)):
        sense.sense(true._replace(qd=np.full_like(true.qd, speed)), DT, clear=True)
        sds.append(sense.comparison.joint_sd)
    assert max(sds[60:120]) > 1.1 * min(sds)
    assert max(sds[-120:]) < 1.03 * min(sds)


def test_a_tool_that_a_fast_arm_shakes_touches_nothing() -> None:
    sense, true = ToolSense(ROBOT), measurements()[0]._replace(torque=np.zeros(0))
    for _ in range(20):
        sense.sense(true, DT)
    sense.sense(true._replace(qd=np.full_like(true.qd, 0.01)), DT)
    J_W, R_SW, before_S = sense._observer.J_W, sense._R_SW, true.wrench_S[:3]
    inertia_S = -ROBOT.tool_mass_kg * (R_SW @ (J_W @ np.full(7, 0.2))) / DT
    shaken = true._replace(qd=np.full_like(true.qd, 0.21), wrench_S=np.concatenate((before_S + inertia_S, np.zeros(3))))
    tool = sense.sense(shaken, DT)
    assert tool.force > 5.0
    assert tool.contact_force < 1.0


def test_joints_that_turn_fast_are_trusted_less() -> None:
    sd = []
    for speed in (0.0, 0.3):
        senses = ForceSenses(6)
        reading = Measurement(np.zeros(6), np.full(6, speed), np.zeros(6), np.zeros(6))
        for _ in range(50):
            compared = senses.compare(reading, np.zeros(6), 0.6 * np.eye(3, 6), np.zeros(3), R_WS, 0.0, DT, (False, True))
        sd.append(compared.joint_sd)
    assert sd[1] > 2 * sd[0]


@pytest.mark.parametrize(("lie", "seen"), [("", False), ("stuck", True), ("gain", True), ("sign", True)])
def test_positions_agree_with_velocities(lie: str, seen: bool) -> None:
    agreement, rng = MotionAgreement(), np.random.default_rng(2)
    found = []
    for measured in measurements():
        q = measured.q + rng.normal(0.0, 1e-5, 7)
        q = {"": q, "stuck": measurements()[0].q + rng.normal(0.0, 1e-5, 7), "gain": 0.8 * q, "sign": q}[lie]
        found += agreement.judge(measured._replace(q=q, qd=-measured.qd if lie == "sign" else measured.qd), DT)
    assert bool(found) == seen


def test_positions_of_a_fast_arm_that_are_late_are_no_sensor_fault() -> None:
    agreement, fast = MotionAgreement(), np.full(7, 1.6)
    for k in range(100):
        late = 0.02 if k > 50 else 0.0
        assert not agreement.judge(Measurement(fast * (DT * k - late), fast, np.zeros(6), np.zeros(7)), DT)


def test_an_arm_that_braked_between_two_late_measurements_is_no_sensor_fault() -> None:
    agreement, moving, still = MotionAgreement(), np.full(7, 0.5), np.zeros(7)
    found = [agreement.judge(Measurement(moving * DT * k, moving, np.zeros(6), still), DT) for k in range(20)]
    found.append(agreement.judge(Measurement(moving * (DT * 19 + 0.01), still, np.zeros(6), still), 0.2))
    assert not any(found)


@pytest.mark.parametrize(
    ("stated", "seen"),
    [
        ({}, False),
        ({"depth": 0.038}, True),
        ({"depth": 0.3 * 0.008}, True),
        ({"depth": 0.009}, False),
        ({"depth": 0.038, "in_contact": False}, False),
        ({"depth": 0.038, "patient_moved": True}, False),
    ],
)
def test_the_stated_depth_agrees_with_the_joints(stated: dict[str, float], seen: bool) -> None:
    agreement, p_W = DepthAgreement(0.02), np.array((0.0, 0.0, 1.013))
    true = {"depth": 0.008, "wall_displacement": 0.001, "in_contact": True} | stated
    for k in range(12):
        state = exam_state(10_000_000 * k, ExamState.PHASE_SCAN, (0.0, 0.0, 1.0), **true)
        found = agreement.judge(state, (vector(state.surface_point), vector(state.surface_normal)), p_W)
    assert [breach.culprit for breach in found] == [EXAM] * seen
