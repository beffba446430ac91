"""LBR service: LBRState and F/T readings in, torque overlay out, with the rules of `palpate_robot.driver`.

At level `setpoint` the control service runs in this process and is stepped on every state (`InnerLoop`), so there is neither
transport nor another timer between a joint state and its torque.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Final

import numpy as np

from palpate_bus import implementations
from palpate_bus.contract import contract
from palpate_bus.messages import (
    JointState,
    RobotStatus,
    String,
    Vector3,
    Wrench,
    WrenchStamped,
)
from palpate_bus.messages.codec import Message
from palpate_bus.messages.stamps import NS, header, nanoseconds
from palpate_bus.service import Inbox, Outbox, Service
from palpate_bus.settings import Settings
from palpate_bus.wire.zenoh_config import BusConfigError
from palpate_models.numerics.frames import GRAVITY, Array
from palpate_models.robot import lbr
from palpate_models.robot.arm import urdf
from palpate_models.scenario.arm_file import CommandLevel
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.schema import ExamInput, Scenario
from palpate_robot.backends.lbr.arm import STATE_AGE_NS, GravityModel, MeasuredArm
from palpate_robot.backends.lbr.port import LbrPort, ZenohPort
from palpate_robot.driver import Command, Driver, DriverMode, HoldCause
from palpate_robot.stop_requests import StopRequests

JOINTS: Final = "joint_states"
SETPOINT: Final = "planning/setpoint"


class _Inbox:
    """Inbox of control: joint states of `t` [ns] and the set-points since the previous state; all else from the bus."""

    def __init__(self, t: int, joints: Message, setpoints: list[Message], bus: Inbox) -> None:
        self._t, self._joints, self._bus = t, joints, bus
        self._new = {JOINTS: [joints], SETPOINT: setpoints}

    def latest(self, topic: str) -> Message | None:
        return self._joints if topic == JOINTS else self._bus.latest(topic)

    def new(self, topic: str) -> Iterable[Message]:
        return self._new[topic] if topic in self._new else self._bus.new(topic)

    def stamp(self, topic: str) -> int | None:
        return self._t if topic == JOINTS else self._bus.stamp(topic)

    def lost(self, role: str) -> bool:
        return self._bus.lost(role)


class InnerLoop:
    """Steps a service of role control inside the driver."""

    def __init__(self, control: Service) -> None:
        self._control = control
        self._setpoints: list[Message] = []

    def collect(self, inbox: Inbox) -> None:
        """Collect set-points; call it on every tick."""
        self._setpoints.extend(inbox.new(SETPOINT))

    def command(self, t: int, inbox: Inbox, joints: Message) -> Any | None:
        """Return the torque command at `t` [ns] for these joint states."""
        setpoints, self._setpoints = self._setpoints, []
        return self._control.step(t, _Inbox(t, joints, setpoints, inbox))["control/joint_torque"]


def load_control(scenario: Scenario) -> Service:
    """Return the control service of the scenario. Raises PluginError if it does not exist."""
    return implementations.create("control", scenario.services.control, scenario)


STATUS_PERIOD = contract().topics["robot/status"].period
DAMPING = np.array([40.0, 40.0, 20.0, 20.0, 8.0, 8.0, 8.0])
"""Largest joint damping in a hold [N m s/rad] [A]. The overlay acts one to three cycles late on a filtered speed. Below the arm's
viscous friction (10) it is stable with any delay; joints with enough inertia take more."""
LINKS_PERIOD = contract().topics["sim/link_poses"].period
FT_AGE_NS = contract().topics["ft/wrench"].max_age
TAKE_OVER_NS = 100_000_000
"""Time after the first command in which commands of others are tolerated: the watchdog sends until it sees the new driver."""
_NAMES = list(lbr.JOINT_NAMES)


class LbrService(Service):
    """A real LBR in the role robot."""

    role: ClassVar[str] = "robot"
    catches_up: ClassVar[bool] = False
    """A real arm has moved on: missed ticks are skipped."""

    def __init__(self, exam: ExamInput, port: LbrPort, inner: InnerLoop | None = None) -> None:
        """`inner` follows set-points in this process; without it `control/joint_torque` is applied."""
        self._robot = exam.robot
        self._port = port
        self._inner = inner
        self._arm = MeasuredArm()
        self._model = GravityModel(exam.robot)
        self._driver = Driver(lbr.ARM, exam.limits.force_emergency_n)
        self._stop_requests = StopRequests(self._driver)
        given = exam.robot.driver
        self._emulated = given.emulated
        yaw = np.deg2rad(given.ft_yaw_deg)
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
        self._R_ST = given.ft_sign * turn
        self._command: Command | None = None
        self._command_message: Message | None = None
        self._commanding_since: int | None = None
        self._wrench = np.zeros(6)
        self._wrench_at: int | None = None
        self._tool: Message | None = None
        self._links: Message | None = None
        self._force = 0.0
        self._applied = np.zeros(7)
        self._sums, self._summed = np.zeros(27), 0
        self._means = np.zeros(27)
        self._states = self._commands = 0
        self._peak_force = 0.0
        self._peak_torque = np.zeros(7)

    def start(self) -> Outbox:
        """Publish the robot description."""
        return {"robot_description": String(urdf(self._robot))}

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Run one tick: arm state, driver, command to the arm."""
        outbox: dict[str, Message] = {}
        fresh = self._receive(t)
        self._stop_requests.apply(t, inbox)
        if self._inner is not None:
            self._inner.collect(inbox)
        if self._arm.received is not None and t - self._arm.received <= STATE_AGE_NS:
            joints = JointState(header(self._arm.received), _NAMES, self._arm.q, self._arm.v, self._applied.copy())
            outbox["joint_states"] = joints  # on every tick: between two states the newest, with its stamp
            if self._wrench_at is not None and t - self._wrench_at <= FT_AGE_NS:
                outbox["ft/wrench"] = WrenchStamped(header(self._wrench_at, "ft_sensor"), _wrench(self._wrench))
            if fresh:
                self._drive(t, inbox, joints)
        if self._arm.received is not None:
            self._check_connection(t)
            # Damping of an old speed would be a constant push. Zero torque is sent once; then the watchdog takes over.
            if self._driver.held and t - self._arm.received > STATE_AGE_NS and self._applied.any():
                self._applied = np.zeros(7)
                self._port.command(self._arm.q, self._applied)
        if not t % STATUS_PERIOD:
            outbox["robot/status"] = self._status(t)
        if self._emulated:
            self._relay(t, inbox, outbox)
        return outbox

    def finish(self) -> Mapping[str, Any]:
        """Return safe holds, counts, and the largest force and torques; leaves the arm without overlay."""
        if self._arm.received is not None:
            self._port.command(self._arm.q, np.zeros(7))
        driver = self._driver
        self._port.close()
        return {
            "mode": driver.mode.name,
            "holds": [{"t_s": t / NS, "cause": cause.name, "reason": reason} for t, cause, reason in driver.holds],
            "commands_rejected": driver.rejected,
            "peak_external_force_N": self._peak_force,
            "peak_torque_nm": [round(float(x), 3) for x in self._peak_torque],
            "states": self._states,
            "commands": self._commands,
            "level": "torque" if self._inner is None else "setpoint",
        }

    def _receive(self, t: int) -> bool:
        """Take messages of the ROS side; return True if the joint state is new."""
        since = self._commanding_since
        if self._port.rivals() and since is not None and t - since > TAKE_OVER_NS:
            self._driver.hold(t, HoldCause.DEVICE, "another process (watchdog?) commands the arm")
        fresh = False
        for state in self._port.states():
            fresh = self._arm.update(t, state) or fresh
        for reading in self._port.wrenches():
            force, torque = reading.wrench.force, reading.wrench.torque
            values = np.array((force.x, force.y, force.z, torque.x, torque.y, torque.z))
            if not np.isfinite(values).all():
                self._driver.hold(t, HoldCause.DEVICE, f"F/T reading {values}: must be finite")
                continue
            self._wrench = np.concatenate((self._R_ST @ values[:3], self._R_ST @ values[3:]))
            self._wrench_at = t
        if fresh:
            self._states += 1
            self._sums += np.concatenate((self._arm.q, self._arm.v, self._wrench, self._arm.torque))
            self._summed += 1
        return fresh

    def _check_connection(self, t: int) -> bool:
        """Return True if the arm accepts commands and the F/T sensor is alive; else an active driver holds."""
        fault = self._arm.fault(t)
        if fault is None and (self._wrench_at is None or t - self._wrench_at > FT_AGE_NS):
            fault = "no F/T reading" if self._wrench_at is None else f"no F/T reading for {(t - self._wrench_at) / 1e6:.0f} ms"
        if fault is not None and self._driver.mode is DriverMode.ACTIVE:
            self._driver.hold(t, HoldCause.DEVICE, fault)
        return fault is None

    def _drive(self, t: int, inbox: Inbox, joints: Message) -> None:
        """Answer a new state with a command."""
        arm = self._arm
        tool = self._model.at(arm.q)
        weight = self._robot.tool_mass_kg * GRAVITY
        self._force = float(np.linalg.norm(self._wrench[:3] + weight * tool.up_S))
        self._peak_force = max(self._peak_force, self._force)
        command = self._newest_command(t, inbox, joints) if self._check_connection(t) else None
        lost = inbox.lost("control") and self._inner is None
        torque = self._driver.update(t, arm.q, arm.v, tool.gravity, self._force, command, lost=lost)
        if self._driver.mode is not DriverMode.ACTIVE:
            torque = -np.minimum(self._driver.damping(arm.v, tool.gravity), DAMPING) * arm.v
        self._applied = np.asarray(torque, dtype=float)
        np.maximum(self._peak_torque, np.abs(self._applied), out=self._peak_torque)
        self._port.command(arm.q, self._applied)
        self._commanding_since = t if self._commanding_since is None else self._commanding_since
        self._commands += 1

    def _newest_command(self, t: int, inbox: Inbox, joints: Message) -> Command | None:
        message = inbox.latest("control/joint_torque") if self._inner is None else self._inner.command(t, inbox, joints)
        if message is not None and message is not self._command_message:
            stamp = nanoseconds(message.header.stamp)
            expires = stamp + nanoseconds(message.valid_for)
            self._command = Command(np.array(message.torque), stamp, expires, message.problem, message.culprit)
            self._command_message = message
        return self._command

    def _status(self, t: int) -> Message:
        driver, measured = self._driver, t
        if self._summed:
            self._means = self._sums / self._summed
            self._sums, self._summed = np.zeros(27), 0
        elif self._arm.received is not None:
            measured = self._arm.received  # no new measurement
        means = self._means
        cause, reason, fault = driver.cause, driver.reason, self._arm.fault(t)
        if not driver.held and fault is not None:
            cause, reason = HoldCause.DEVICE, fault
        return RobotStatus(
            header(measured), int(driver.mode), int(cause), reason, means[:7], means[7:14], _wrench(means[14:20]),
            self._applied.copy(), driver.rejected, driver.culprit, means[20:],
        )  # fmt: skip

    def _relay(self, t: int, inbox: Inbox, outbox: dict[str, Message]) -> None:
        """Relay exact poses and contact wrenches between the emulator and the simulated tissue and camera."""
        for contact in inbox.new("sim/contact_wrench"):
            self._port.contact(contact)
        tool, links = self._port.physics()
        self._tool = self._tool if tool is None else tool
        if self._tool is not None:
            outbox["sim/tool_state"] = self._tool
        self._links = self._links if links is None else links
        if self._links is not None and not t % LINKS_PERIOD:
            outbox["sim/link_poses"] = self._links


def _wrench(values: Array) -> Message:
    fx, fy, fz, mx, my, mz = values.tolist()
    return Wrench(Vector3(fx, fy, fz), Vector3(mx, my, mz))


def create(scenario: Scenario) -> LbrService:
    """Return the driver of a scenario, connected to the ROS side that `robot.driver` names."""
    if Settings.read().runtime != "wallclock":
        raise BusConfigError("services.robot = lbr drives hardware and cannot run in simulated time: use --wallclock")
    exam = exam_input(scenario)
    inner = InnerLoop(load_control(scenario)) if exam.robot.level is CommandLevel.SETPOINT else None
    return LbrService(exam, ZenohPort(exam.robot.driver), inner)
