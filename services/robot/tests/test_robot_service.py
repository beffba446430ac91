"""The service against its contract: what it sends, when, and what it does when its inputs fail."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from palpate_bus.contract import contract
from palpate_bus.messages import duration_message, header
from palpate_bus.messages.codec import encode, message_type
from palpate_bus.testing import HandInbox
from palpate_models.numerics.frames import GRAVITY
from palpate_models.robot import lbr
from palpate_models.scenario.errors import Errors, ForceErrors
from palpate_models.scenario.schema import Robot, Scenario
from palpate_robot.backends.dart.service import create
from palpate_robot.service import RobotService

MS = 1_000_000
STATUS = message_type("palpation_msgs/msg/RobotStatus")
REQUEST = message_type("palpation_msgs/msg/OperatorRequest")
SUPERVISOR = message_type("palpation_msgs/msg/SupervisorState")
COMMAND = message_type("palpation_msgs/msg/JointTorqueCommand")
WRENCH = message_type("geometry_msgs/msg/WrenchStamped")
PARTS = message_type("geometry_msgs/msg/Wrench")
VECTOR = message_type("geometry_msgs/msg/Vector3")


class Rig:
    """A robot whose command law and tissue are functions of the last tick's outbox."""

    def __init__(self, scenario: Scenario) -> None:
        self.robot: RobotService = create(scenario)
        self.inbox = HandInbox()
        self.t = -MS
        self.outbox: Mapping[str, Any] = {}
        self.status: Any = None

    def command(self, torque: np.ndarray, valid_ms: int = 50) -> None:
        self.inbox.messages["control/joint_torque"] = COMMAND(
            header(self.t), np.asarray(torque), np.empty(0), duration_message(valid_ms * MS), "", ""
        )

    def press(self, fx: float, fy: float, fz: float) -> None:
        wrench = PARTS(VECTOR(fx, fy, fz), VECTOR(0.0, 0.0, 0.0))
        self.inbox.messages["sim/contact_wrench"] = WRENCH(header(self.t, "world"), wrench)

    def request(self, request: int) -> None:
        self.inbox.events["operator/request"] = [REQUEST(header(self.t), request, "test")]

    def supervise(self, level: int, releases: int = 0) -> None:
        state = SUPERVISOR(header(self.t), level, SUPERVISOR.CAUSE_FORCE, "force 41 N", releases, 41.0, 0.0, 0.0, 0, "", 0.0)
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


def test_holds_still_without_any_command(rig: Rig) -> None:
    rig.tick(500)
    np.testing.assert_allclose(rig.outbox["joint_states"].position, lbr.HOME, atol=1e-5)
    assert rig.mode[0] == STATUS.MODE_IDLE


def test_sensor_topic_carries_weight_and_bias_until_tared(rig: Rig) -> None:
    readings = []
    for _ in range(400):
        rig.tick()
        force = rig.outbox["ft/wrench"].wrench.force
        readings.append((force.x, force.y, force.z))
    mean = np.mean(readings, axis=0)
    weight = Robot().tool_mass_kg * GRAVITY
    assert abs(mean[2] - weight) < ForceErrors().bias_n + 0.05
    assert np.abs(mean - [0, 0, weight]).max() > 0.01, "a bias is there"
    assert np.std(readings, axis=0) == pytest.approx([ForceErrors().noise_n] * 3, rel=0.2)


def test_status_carries_the_means_since_the_last_one(rig: Rig) -> None:
    rig.tick()
    seen = []
    for _ in range(10):
        rig.servo(1, lbr.HOME + 0.05)
        joints, wrench = rig.outbox["joint_states"], rig.outbox["ft/wrench"].wrench
        seen.append([*joints.position, *joints.velocity, wrench.force.x, wrench.force.z, wrench.torque.y])
    mean = np.mean(seen, axis=0)
    np.testing.assert_allclose(rig.status.position, mean[:7], atol=1e-12)
    np.testing.assert_allclose(rig.status.velocity, mean[7:14], atol=1e-12)
    wrench = rig.status.wrench
    np.testing.assert_allclose([wrench.force.x, wrench.force.z, wrench.torque.y], mean[14:], atol=1e-12)


def test_silent_controller_brings_a_latched_hold_at_its_expiry(rig: Rig) -> None:
    rig.servo(100)
    sent = rig.t
    rig.tick(50)
    assert rig.robot.finish()["holds"] == []
    rig.tick(1)
    (hold,) = rig.robot.finish()["holds"]
    assert hold["cause"] == "COMMAND_EXPIRED"
    assert hold["t_s"] * 1e9 == pytest.approx(sent + 51 * MS)
    rig.servo(100)
    assert rig.mode == (STATUS.MODE_SAFE_HOLD, STATUS.CAUSE_COMMAND_EXPIRED), "new commands do not unlatch it"
    assert rig.status.reason
    rig.supervise(SUPERVISOR.LEVEL_OK, releases=1)
    rig.servo(20)
    assert rig.mode == (STATUS.MODE_ACTIVE, STATUS.CAUSE_NONE)


def test_the_supervisor_stops_and_releases_the_driver(rig: Rig) -> None:
    rig.servo(50)
    rig.supervise(SUPERVISOR.LEVEL_SOFT_STOP)
    rig.servo(20)
    assert rig.mode[0] == STATUS.MODE_ACTIVE, "a soft stop is planning's"
    rig.supervise(SUPERVISOR.LEVEL_EMERGENCY)
    rig.tick()
    assert rig.mode == (STATUS.MODE_SAFE_HOLD, STATUS.CAUSE_STOP_REQUESTED)
    rig.servo(20)
    assert rig.mode[0] == STATUS.MODE_SAFE_HOLD
    rig.supervise(SUPERVISOR.LEVEL_OK, releases=1)
    rig.servo(20)
    assert rig.mode[0] == STATUS.MODE_ACTIVE


def test_hard_contact_holds(rig: Rig) -> None:
    rig.servo(50)
    rig.press(0.0, 0.0, 45.0)
    rig.servo(3)
    assert rig.mode == (STATUS.MODE_SAFE_HOLD, STATUS.CAUSE_FORCE_LIMIT)


def test_in_contact_with_tissue_that_stands_still_it_holds(rig: Rig) -> None:
    rig.servo(50)
    rig.inbox.stamps["sim/contact_wrench"] = rig.t
    rig.servo(150)
    assert rig.mode[0] == STATUS.MODE_ACTIVE, "no contact, nothing to be met"
    rig.press(0.0, 0.0, 5.0)
    rig.inbox.stamps["sim/contact_wrench"] = rig.t
    rig.servo(100)
    assert rig.mode[0] == STATUS.MODE_ACTIVE
    rig.servo(12)
    assert rig.mode == (STATUS.MODE_SAFE_HOLD, STATUS.CAUSE_DEVICE)


def test_a_controller_that_gives_up_is_obeyed_however_far_its_clock_is_ahead(rig: Rig) -> None:
    rig.servo(50)
    late = COMMAND(header(rig.t + 180 * MS), np.zeros(7), np.empty(0), duration_message(0), "joint_states are 34 ms old", "")
    rig.inbox.messages["control/joint_torque"] = late
    rig.tick(20)
    assert rig.mode == (STATUS.MODE_SAFE_HOLD, STATUS.CAUSE_COMMAND_EXPIRED)
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
    start = rig.outbox["sim/tool_state"].pose.position.z
    rest = start + 0.005  # so 5 N at once
    forces = []
    for tick in range(1500):
        z = rig.outbox["sim/tool_state"].pose.position.z
        forces.append(stiffness * max(0.0, rest - z))
        rig.press(0.0, 0.0, forces[-1])
        if tick < 200:
            rig.servo(1)
        else:
            rig.inbox.gone.add("control")
            rig.tick()
    held = np.array(forces[202:])
    assert rig.mode == (STATUS.MODE_SAFE_HOLD, STATUS.CAUSE_COMMANDER_LOST)
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
    rig.servo(5)
    before = rig.outbox
    topics = contract().topics
    bytes_before = {name: encode(message, topics[name].type) for name, message in before.items()}
    rig.press(1.0, 2.0, 3.0)
    rig.servo(50, lbr.HOME + 0.1)
    assert bytes_before == {name: encode(message, topics[name].type) for name, message in before.items()}
