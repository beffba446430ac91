"""Admittance control: the static law, the tare, and the limits of what it commands."""

from math import acos
from typing import Any

import numpy as np
import pytest
from control_plant import WORKING, reference, setpoint

from palpate_bus.messages import MS
from palpate_bus.setpoint import ControlMode
from palpate_control.impedance import ADMITTANCE, AdmittanceController
from palpate_control.model import ArmModel
from palpate_models.numerics.frames import GRAVITY
from palpate_models.robot import lbr
from palpate_models.robot.arm import arm_of, urdf
from palpate_models.scenario.schema import Robot

MASS, REST = 0.35, np.zeros(7)
ZONE = 0.05, 0.01
"""Limit zone [rad] and time between readings [s]."""
BIAS = np.array((1.5, -2.0, 3.0))
PUSH = np.array((0.0, 0.0, 10.0))
SETTLED = round(8 * ADMITTANCE.yield_s * 1e3)


class Contact:
    """A controller, its F/T sensor, and an arm that does what it commands."""

    def __init__(self, posture: int = 1) -> None:
        self.asked, self.q = WORKING[posture], np.array(WORKING[posture])
        self.model = ArmModel(urdf(Robot()))
        self.law = AdmittanceController(self.model, lbr.ARM, MASS, *ZONE)
        self.t = 0

    def follow(self, mode: ControlMode, force_W: np.ndarray, ticks: int = SETTLED, held: bool = False, **changes: Any) -> Any:
        """Return where the tool is [m] after some ticks under a force on it [N]; a driver that holds it ignores the commands."""
        asked = setpoint(self.model, self.asked, mode=mode, **changes)
        for _ in range(ticks):
            self.t += MS
            self.law.sense(self.tool()[1].T @ (force_W - (0, 0, MASS * GRAVITY)) + BIAS, commanded=not held)
            command = self.law.command(self.q, REST, reference(asked, self.t))
            self.q = self.q if held else command
        return self.tool()[0]

    def tool(self) -> tuple[np.ndarray, np.ndarray]:
        self.model.update_kinematics(self.q)
        return self.model.p_WI.copy(), self.model.R_WI.copy()


@pytest.mark.parametrize("posture", range(3))
def test_at_rest_the_tool_yields_by_force_over_stiffness(posture: int) -> None:
    contact = Contact(posture)
    start = contact.follow(ControlMode.JOINT, np.zeros(3), 20)
    K = np.full(6, 4000.0)
    np.testing.assert_allclose(contact.follow(ControlMode.CARTESIAN, np.zeros(3), stiffness=K), start, atol=2e-5)
    pushed = contact.follow(ControlMode.CARTESIAN, PUSH, stiffness=K)
    np.testing.assert_allclose(pushed - start, PUSH / K[0], atol=2e-5)
    fed = contact.follow(ControlMode.CARTESIAN, PUSH, stiffness=K, F_W=np.concatenate((-0.9 * PUSH, np.zeros(3))))
    np.testing.assert_allclose(fed - start, 0.1 * PUSH / K[0], atol=2e-5)


def test_an_arm_that_its_driver_holds_in_contact_takes_no_bias() -> None:
    contact = Contact()
    start = contact.follow(ControlMode.JOINT, np.zeros(3), 20)
    contact.follow(ControlMode.JOINT, PUSH, held=True)
    np.testing.assert_allclose(contact.follow(ControlMode.CARTESIAN, np.zeros(3)), start, atol=2e-5)


def test_without_a_tare_no_force_moves_the_tool() -> None:
    contact = Contact()
    start = contact.tool()[0]
    np.testing.assert_allclose(contact.follow(ControlMode.CARTESIAN, PUSH), start, atol=1e-5)


def test_a_free_motion_forgets_how_far_the_tool_has_yielded() -> None:
    contact = Contact()
    contact.follow(ControlMode.JOINT, np.zeros(3), 20)
    contact.follow(ControlMode.CARTESIAN, 2.5 * PUSH)
    start = contact.follow(ControlMode.JOINT, np.zeros(3), 3000)
    np.testing.assert_allclose(contact.follow(ControlMode.CARTESIAN, np.zeros(3), 20), start, atol=2e-5)


def test_it_yields_no_further_than_its_limit() -> None:
    contact = Contact()
    start = contact.follow(ControlMode.JOINT, np.zeros(3), 20)
    R_WD = contact.tool()[1]
    far_D = R_WD.T @ (contact.follow(ControlMode.CARTESIAN, 100 * PUSH) - start)
    assert np.abs(far_D).max() == pytest.approx(ADMITTANCE.yield_max_m, abs=1e-3)


@pytest.mark.parametrize("mode", list(ControlMode))
def test_no_set_point_turns_a_joint_faster_or_further_than_it_may(mode: ControlMode) -> None:
    contact = Contact()
    far, rate = contact.asked + 3.0, np.zeros(7)
    for _ in range(400):
        before = contact.q
        contact.follow(mode, np.zeros(3), 1, q=far, p_WD=np.array((2.0, 0.0, 2.0)))
        slower, rate = rate, (contact.q - before) * 1e3
        assert (np.abs(rate) <= 1.001 * ADMITTANCE.speed_share * contact.model.velocity_limit).all()
        assert (rate - slower <= 1.001e-3 * lbr.ARM.acceleration_radps2).all()
    assert (np.abs(contact.q) <= contact.model.position_upper).all()


def test_a_far_posture_is_approached_slowly() -> None:
    contact = Contact()
    contact.follow(ControlMode.JOINT, np.zeros(3), 20)
    before, self_motion = contact.q, np.linalg.svd(contact.model.J_W)[2][-1]
    contact.follow(ControlMode.CARTESIAN, np.zeros(3), 100, q=contact.asked + 2.0 * self_motion)
    assert 0.01 < np.linalg.norm(contact.q - before) < 0.105 * ADMITTANCE.posture_radps


@pytest.mark.parametrize("beside_m", [-0.01, 0.01])
def test_beside_a_path_through_a_singular_wrist_the_tool_tilts_and_stays_in_place(beside_m: float) -> None:
    """Two axes of the wrist align: 10 mm from the planned path they turned at their limits, and the tool was 12 mm off."""
    pytest.importorskip("coal")
    robot = Robot(arm="ur5")
    model = ArmModel(urdf(robot))
    law, aside = AdmittanceController(model, arm_of(robot), MASS, *ZONE), np.array((0.0, beside_m, 0.0))
    start, travel = np.array((0.3, -1.2, 1.9, -2.2, 0.25, 0.0)), np.array((0.0, 0.0, 0.0, 0.0, -0.5, 0.0))
    q, off, fastest = start, np.zeros(3), 0.0
    for ms in range(2000):
        x = ms / 2000
        planned, rate = start + travel * x * x * (3 - 2 * x), travel * 3 * x * (1 - x)
        asked = setpoint(model, planned, qd=rate)
        asked = asked._replace(p_WD=asked.p_WD + aside, V_WD=model.J_W @ rate)
        before = q
        q = law.command(q, rate, reference(asked, ms * MS))
        fastest = max(fastest, float(np.abs(q - before).max()) * 1e3)
        model.update_kinematics(q)
        off = np.maximum(off, (np.abs(q - planned).max(), acos(asked.R_WD[:, 2] @ model.R_WI[:, 2]), 0.0))
        if ms > 300:
            off[2] = max(off[2], np.linalg.norm(asked.p_WD - model.p_WI))
    assert (off < (0.2, 0.04, 5e-4)).all()
    assert fastest < 0.5 * model.velocity_limit.min()


def test_the_arm_keeps_its_speed_where_calls_are_missed() -> None:
    """By the wall clock a busy machine skips ticks; each step of 1 ms then left the tool behind, which caught up with a jerk."""
    calls = {"all": range(300), "some": [ms for ms in range(300) if ms % 7 < 3 or ms == 299]}
    reached = {}
    for name, times in calls.items():
        contact = Contact()
        for ms in times:
            asked = setpoint(contact.model, contact.asked + 0.2e-3 * ms, mode=ControlMode.JOINT, qd=np.full(7, 0.2))
            contact.q = contact.law.command(contact.q, REST, reference(asked, ms * MS))
        reached[name] = contact.q
    np.testing.assert_allclose(reached["some"], reached["all"], atol=2e-4)


def test_a_late_arm_catches_up_at_little_more_than_the_planned_speed() -> None:
    """It doubled its speed after 60 ms: the supervisor stopped it."""
    contact, fastest, rate = Contact(), 0.0, np.full(7, 0.4)
    for ms in (*range(200), *range(260, 600)):
        asked = setpoint(contact.model, contact.asked + 1e-3 * ms * rate, mode=ControlMode.JOINT, qd=rate)
        before, contact.q = contact.q, contact.law.command(contact.q, REST, reference(asked, ms * MS))
        fastest = max(fastest, 1e3 * float(np.abs(contact.q - before).max()) if ms != 260 else 0.0)
    assert fastest < 1.3 * rate[0]
    np.testing.assert_allclose(contact.q, contact.asked + 0.599 * rate, atol=1e-3)


def test_after_a_reset_it_starts_where_the_arm_is() -> None:
    contact = Contact()
    contact.follow(ControlMode.CARTESIAN, PUSH, 50)
    contact.law.reset()
    contact.q = WORKING[1] + 0.2
    before = contact.q
    contact.follow(ControlMode.JOINT, np.zeros(3), 1)
    assert (np.abs(contact.q - before) <= 1.001e-3 * ADMITTANCE.speed_share * contact.model.velocity_limit).all()
