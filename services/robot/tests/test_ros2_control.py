"""The driver of ros2_control on the emulator of each profile, in simulated time."""

from typing import Any

import numpy as np
import pytest

from palpate_bus.messages import JointTorqueCommand, RobotStatus
from palpate_bus.messages.stamps import duration_message, header
from palpate_bus.testing import HandInbox
from palpate_models.scenario.load import load_scenario
from palpate_robot.backends.ros2_control.checks import FirstContactCheck
from palpate_robot.backends.ros2_control.service import create
from palpate_robot.driver import DriverMode

MS = 1_000_000
ARMS = [("panda", "franka"), ("ur5", "ur")]


class Ros2Bench:
    """Driver and emulator; every tick commands zero torque, or that the first joint moves."""

    def __init__(self, arm: str, profile: str, *changes: str) -> None:
        settings = [f"robot.arm={arm}", f"robot.driver.profile={profile}", "robot.driver.emulated=true", *changes]
        self.driver = create(load_scenario("clean", ["services.robot=ros2_control", *settings]))
        self.inbox = HandInbox()
        self.t = -MS
        self.status: Any = None
        self.speed_radps = 0.0
        self._start: Any = None

    def tick(self, ticks: int) -> None:
        for _ in range(ticks):
            self.t += MS
            outbox = self.driver.step(self.t, self.inbox)
            self.status = outbox.get("robot/status", self.status)
            if self._start is None and "joint_states" in outbox:
                self._start, begun = outbox["joint_states"].position.copy(), self.t
                self._begun = begun
            if self._start is not None:
                self.inbox.messages["control/joint_torque"] = self._command()

    def _command(self) -> Any:
        values, none = np.zeros(len(self._start)), np.zeros(0)
        if self.driver._positions:
            values = self._start.copy()
            values[0] += self.speed_radps * (self.t - self._begun) * 1e-9
        torque, position = (none, values) if self.driver._positions else (values, none)
        return JointTorqueCommand(header(self.t), torque, position, duration_message(50 * MS), "", "")


@pytest.mark.parametrize(("arm", "profile"), ARMS)
def test_the_emulated_arm_takes_commands(arm: str, profile: str) -> None:
    bench = Ros2Bench(arm, profile)
    bench.speed_radps = 0.1
    bench.tick(400)
    assert bench.status.mode == RobotStatus.MODE_ACTIVE, bench.status.reason
    moved = bench.driver._arm.q - bench._start
    assert moved[0] == pytest.approx(0.1 * 0.4 if bench.driver._positions else 0.0, abs=0.02)
    assert np.abs(moved[1:]).max() < 0.01
    external = np.linalg.norm(bench.driver._external_S)
    assert external < 6.0, "the tool's weight is in ft/wrench, whatever the stack reports"


def test_commands_without_effect_are_reported() -> None:
    bench = Ros2Bench("ur5", "ur", 'robot.driver.events=["0.1 controller 0"]')
    bench.speed_radps = 0.1
    bench.tick(1200)
    assert bench.driver._driver.mode is DriverMode.SAFE_HOLD
    assert "does not follow" in bench.status.reason


@pytest.mark.parametrize(("push", "wrong"), [((0.0, 0.0, -3.0), False), ((0.0, 0.0, 3.0), True), ((3.0, 0.0, 0.5), False)])
def test_the_first_contact_pushes_the_tool_back(push: tuple[float, float, float], wrong: bool) -> None:
    contact = FirstContactCheck()
    bias = np.array((1.0, -1.0, 2.0))
    assert not any(contact.wrong(t * MS, bias) for t in range(100))
    assert contact.wrong(100 * MS, bias + push) is wrong
    assert contact.passed is (push[2] < 0)
