"""The driver on an emulated arm without transport and without a wall clock: time is the caller's."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from palpate_bus.messages import JointTorqueCommand, RobotStatus, duration_message, header
from palpate_bus.messages.geometry import vector
from palpate_bus.testing import HandInbox
from palpate_models.robot import lbr
from palpate_models.scenario.load import exam_input, load_scenario, plant_input
from palpate_models.scenario.schema import CommandLevel, Scenario
from palpate_robot.backends.arm_port import ArmPort
from palpate_robot.backends.hardware import HardwareService, InnerLoop
from palpate_robot.backends.lbr.emulator import Emulator
from palpate_robot.backends.lbr.service import lbr_service

MS = 1_000_000
UNIX = 1_700_000_000_000_000_000
"""The emulator's clock at the start [ns]: it is not the run's."""


class DirectPort(ArmPort):
    """Hands messages over; `states` is called once a millisecond and cycles the emulator when its period has passed."""

    def __init__(self, emulator: Emulator, period_ms: int) -> None:
        self.emulator = emulator
        self.period_ms = period_ms
        self.t = -MS
        self.silent = False
        self.ft_silent = False
        self.spoiled: dict[str, Any] = {}
        """Fields of the state that are not the emulator's."""
        self.torques: list[np.ndarray] = []
        self.commanded_by: list[bytes] = []
        self._readings: list[Any] = []
        self._moved = True

    def states(self) -> list[Any]:
        self.t += MS
        if (self.t // MS) % self.period_ms:
            return []
        if self.t:
            self.emulator.cycle()
        self._moved = True
        self._readings = [] if self.ft_silent else [self.emulator.wrench(self.t)]
        if self.silent or self.emulator.session.ended:
            return []
        state = self.emulator.state(self.t)
        for name, value in self.spoiled.items():
            setattr(state, name, value)
        return [state]

    def wrenches(self) -> list[Any]:
        readings, self._readings = self._readings, []
        return readings

    def command(self, q: Any, values: Any) -> None:
        self.torques.append(np.array(values))
        self.emulator.session.take(np.array(q), np.array(values))

    def rivals(self) -> list[bytes]:
        others, self.commanded_by = self.commanded_by, []
        return others

    def contact(self, wrench: Any) -> None:
        self.emulator.force_W[:], self.emulator.moment_W[:] = vector(wrench.wrench.force), vector(wrench.wrench.torque)

    def physics(self) -> tuple[Any | None, Any | None]:
        moved, self._moved = self._moved, False
        return (self.emulator.tool(UNIX + self.t), self.emulator.links(UNIX + self.t)) if moved else (None, None)


def driver_on_emulator(scenario: Scenario, level: str = "torque", **options: Any) -> tuple[HardwareService, DirectPort]:
    """Driver and port; options are the emulator's."""
    exam = exam_input(scenario)
    emulator = Emulator(plant_input(scenario), **options)
    port = DirectPort(emulator, emulator.period_ms)
    inner = InnerLoop(scenario) if level == "setpoint" else None
    connection = exam.robot.driver.model_copy(update={"emulated": True})
    robot = exam.robot.model_copy(update={"driver": connection, "level": CommandLevel(level)})
    return lbr_service(exam.model_copy(update={"robot": robot}), port, inner), port


SCENARIO = load_scenario("clean")
GAIN = np.array([400.0, 400.0, 300.0, 300.0, 100.0, 60.0, 30.0])


class Rig:
    """Driver, emulated arm, and a joint servo that commands it."""

    def __init__(self, **options: Any) -> None:
        self.driver, self.port = driver_on_emulator(SCENARIO, **options)
        self.inbox = HandInbox()
        self.t = -MS
        self.outbox: Mapping[str, Any] = {}
        self.status: Any = None
        self.target = np.array(lbr.HOME)
        self.torque = np.zeros(7)
        self.commanding = True

    @property
    def plant(self) -> Any:
        return self.port.emulator._plant

    def tick(self, ticks: int) -> None:
        for _ in range(ticks):
            self.t += MS
            joints = self.outbox.get("joint_states")
            if joints is not None and joints.name and self.commanding:
                error = self.target - joints.position
                torque = GAIN * error - 0.5 * np.sqrt(GAIN) * joints.velocity
                self.torque = np.clip(torque, self.torque - 1.0, self.torque + 1.0)  # as the driver wants it
                command = JointTorqueCommand(header(self.t), self.torque, np.zeros(0), duration_message(50 * MS), "", "")
                self.inbox.messages["control/joint_torque"] = command
            self.outbox = self.driver.step(self.t, self.inbox)
            self.status = self.outbox.get("robot/status", self.status)


def active_rig() -> Rig:
    """Return a rig whose driver obeys commands."""
    rig = Rig()
    rig.tick(600)
    assert rig.status.mode == RobotStatus.MODE_ACTIVE, rig.status.reason
    return rig
