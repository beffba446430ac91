"""The service against its contract: what it sends, when, and what it does when its inputs fail."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from palpate_bus.contract import contract
from palpate_bus.messages import (
    JointTorqueCommand,
    RobotStatus,
    SupervisorState,
    Vector3,
    Wrench,
    WrenchStamped,
    duration_message,
    header,
)
from palpate_bus.messages.codec import encode
from palpate_bus.messages.geometry import vector
from palpate_bus.testing import HandInbox
from palpate_models.numerics.frames import GRAVITY
from palpate_models.robot import lbr
from palpate_models.scenario.errors import Errors, ForceErrors
from palpate_models.scenario.schema import Robot, Scenario
from palpate_robot.backends.dart.service import create
from palpate_robot.service import RobotService

MS = 1_000_000


class Rig:
    """A robot whose command law and tissue are functions of the last tick's outbox."""

    def __init__(self, scenario: Scenario) -> None:
        self.robot: RobotService = create(scenario)
        self.inbox = HandInbox()
        self.t = -MS
        self.outbox: Mapping[str, Any] = {}
        self.status: Any = None

    def command(self, torque: np.ndarray) -> None:
        valid = duration_message(50 * MS)
        self.inbox.messages["control/joint_torque"] = JointTorqueCommand(header(self.t), torque, np.empty(0), valid, "", "")

    def press(self, fx: float, fy: float, fz: float) -> None:
        wrench = Wrench(Vector3(fx, fy, fz), Vector3(0.0, 0.0, 0.0))
        self.inbox.messages["sim/contact_wrench"] = WrenchStamped(header(self.t, "world"), wrench)

    def supervise(self, level: int) -> None:
        state = SupervisorState(header(self.t), level, SupervisorState.CAUSE_FORCE, "force 41 N", 0, 41.0, 0.0, 0.0, 0, "", 0.0)
        self.inbox.events["supervisor/state"] = [state]

    def tick(self, ticks: int = 1) -> None:
        for _ in range(ticks):
            self.t += MS
            self.outbox = self.robot.step(self.t, self.inbox)
            self.status = self.outbox.get("robot/status", self.status)

    def servo(self, ticks: int, target: np.ndarray = lbr.HOME) -> None:
        """Commands a joint impedance for a while."""
        for _ in range(ticks):
            self.tick()
            state = self.outbox["joint_states"]
            self.command(200.0 * (target - state.position) - 5.0 * state.velocity)

    @property
    def mode(self) -> tuple[int, int]:
        while self.t % (10 * MS):
            self.tick()
        return self.status.mode, self.status.cause


@pytest.fixture
def rig() -> Rig:
    return Rig(Scenario(errors=Errors(level="none")))


def test_sensor_topic_carries_weight_and_bias_until_tared(rig: Rig) -> None:
    readings = []
    for _ in range(400):
        rig.tick()
        readings.append(vector(rig.outbox["ft/wrench"].wrench.force))
    mean = np.mean(readings, axis=0)
    weight = Robot().tool_mass_kg * GRAVITY
    assert abs(mean[2] - weight) < ForceErrors().bias_n + 0.05
    assert np.abs(mean - [0, 0, weight]).max() > 0.01, "a bias is there"
    assert np.std(readings, axis=0) == pytest.approx([ForceErrors().noise_n] * 3, rel=0.2)


def test_status_carries_the_means_since_the_last_one(rig: Rig) -> None:
    def measured(joints: Any, force: Any, torque: Any) -> list[float]:
        return [*joints.position, *joints.velocity, *vector(force), *vector(torque)]

    rig.tick()
    seen = []
    for _ in range(10):
        rig.servo(1, lbr.HOME + 0.05)
        wrench = rig.outbox["ft/wrench"].wrench
        seen.append(measured(rig.outbox["joint_states"], wrench.force, wrench.torque))
    reported = measured(rig.status, rig.status.wrench.force, rig.status.wrench.torque)
    np.testing.assert_allclose(reported, np.mean(seen, axis=0), atol=1e-12)


def test_a_soft_stop_does_not_hold_the_driver(rig: Rig) -> None:
    rig.servo(50)
    rig.supervise(SupervisorState.LEVEL_SOFT_STOP)
    rig.servo(20)
    assert rig.mode[0] == RobotStatus.MODE_ACTIVE


def test_hard_contact_holds(rig: Rig) -> None:
    rig.servo(50)
    rig.press(0.0, 0.0, 45.0)
    rig.servo(3)
    assert rig.mode == (RobotStatus.MODE_SAFE_HOLD, RobotStatus.CAUSE_FORCE_LIMIT)


def test_in_contact_with_tissue_that_stands_still_it_holds(rig: Rig) -> None:
    rig.servo(50)
    rig.inbox.stamps["sim/contact_wrench"] = rig.t
    rig.servo(150)
    assert rig.mode[0] == RobotStatus.MODE_ACTIVE, "no contact, nothing to be met"
    rig.press(0.0, 0.0, 5.0)
    rig.inbox.stamps["sim/contact_wrench"] = rig.t
    rig.servo(100)
    assert rig.mode[0] == RobotStatus.MODE_ACTIVE
    rig.servo(12)
    assert rig.mode == (RobotStatus.MODE_SAFE_HOLD, RobotStatus.CAUSE_COMMAND_EXPIRED)


def test_a_simulation_that_stood_still_brakes_and_states_the_present(rig: Rig) -> None:
    for k in range(100):
        rig.servo(1, lbr.HOME + 0.0005 * k)
    before = rig.outbox["joint_states"]
    assert np.abs(before.velocity).max() > 0.2
    rig.t += 219 * MS
    rig.servo(1, lbr.HOME + 0.05)
    now = rig.outbox["joint_states"]
    assert rig.mode == (RobotStatus.MODE_SAFE_HOLD, RobotStatus.CAUSE_COMMAND_EXPIRED)
    assert rig.status.culprit == "robot" and np.abs(now.velocity).max() < 0.01
    assert np.abs(now.position - before.position).max() < 0.02
    np.testing.assert_allclose(rig.status.position, now.position, atol=1e-4)


def test_a_controller_that_gives_up_is_obeyed_however_far_its_clock_is_ahead(rig: Rig) -> None:
    rig.servo(50)
    rig.command(np.zeros(7))
    problem = {"header": header(rig.t + 180 * MS), "valid_for": duration_message(0), "problem": "joint_states are 34 ms old"}
    rig.inbox.messages["control/joint_torque"] = replace(rig.inbox.messages["control/joint_torque"], **problem)
    rig.tick(20)
    assert rig.mode == (RobotStatus.MODE_SAFE_HOLD, RobotStatus.CAUSE_COMMAND_EXPIRED)
    assert "joint_states" in rig.status.reason


def test_runaway_command_is_stopped_at_a_limit(rig: Rig) -> None:
    rig.tick()
    while rig.robot.finish()["mode"] != "SAFE_HOLD" and rig.t < 3_000 * MS:
        rig.command(np.array([0, 0, 0, 0, 0, 0, 19.0]))
        rig.tick()
    (hold,) = rig.robot.finish()["holds"]
    assert hold["cause"] in ("VELOCITY_LIMIT", "POSITION_LIMIT")
    rig.tick(300)
    assert np.abs(rig.outbox["joint_states"].velocity).max() < 0.05, "and damped to rest"


def test_held_arm_yields_to_tissue_so_the_force_falls(rig: Rig) -> None:
    """A spring under the indenter: from the hold on, the force never rises above what it was, and falls."""
    stiffness = 1000.0
    rig.servo(20)
    rest = rig.outbox["sim/tool_state"].pose.position.z + 0.005  # so 5 N at once
    forces = []
    for tick in range(1500):
        forces.append(stiffness * max(0.0, rest - rig.outbox["sim/tool_state"].pose.position.z))
        rig.press(0.0, 0.0, forces[-1])
        if tick == 200:
            rig.inbox.gone.add("control")
        rig.servo(1)
    held = np.array(forces[202:])
    assert rig.mode == (RobotStatus.MODE_SAFE_HOLD, RobotStatus.CAUSE_COMMANDER_LOST)
    assert held.max() <= forces[201] + 0.02
    assert held[-1] < 0.8 * held[0]


def test_runs_are_identical_to_the_bit_and_seeds_differ() -> None:
    def run(seed: int) -> list[bytes]:
        rig = Rig(Scenario(seed=seed))
        sent = []
        for _ in range(120):
            rig.press(0.5, 0.0, 2.0)
            rig.servo(1, lbr.HOME + 0.01)
            sent += [encode(m, contract().topics[name].type) for name, m in rig.outbox.items()]
        return sent

    assert run(7) == run(7)
    assert run(7) != run(8)


def test_outbox_is_not_changed_by_later_steps(rig: Rig) -> None:
    def encoded() -> list[bytes]:
        return [encode(message, contract().topics[name].type) for name, message in sent.items()]

    rig.servo(5)
    sent = rig.outbox
    before = encoded()
    rig.press(1.0, 2.0, 3.0)
    rig.servo(50, lbr.HOME + 0.1)
    assert encoded() == before
