"""A real arm behind a ROS 2 system in the role robot: its states and F/T readings in, commands out, with the rules of
`palpate_robot.driver`.

With an `InnerLoop` the control service runs in this process and is stepped on every state, so there is neither transport nor
another timer between a joint state and its torque.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np
import pinocchio as pin

from palpate_bus import implementations
from palpate_bus.contract import contract
from palpate_bus.messages import NS, JointState, Message, RobotStatus, String, WrenchStamped, header
from palpate_bus.messages.codes import DriverMode, HoldCause
from palpate_bus.messages.geometry import wrench, wrench_message
from palpate_bus.service import Inbox, Outbox, Service
from palpate_models.numerics.frames import GRAVITY, Array
from palpate_models.robot.arm import TOOL, arm_of, urdf
from palpate_models.scenario.schema import CommandLevel, ExamInput, Robot, Scenario
from palpate_robot.backends.arm_port import ArmPort
from palpate_robot.driver import Command, Driver
from palpate_robot.position_loop import TUNING as LOOP
from palpate_robot.stop_requests import ReceivedCommands, StopRequests

JOINTS: Final = "joint_states"
SETPOINT: Final = "planning/setpoint"
STATE_AGE_NS: Final = contract().topics[JOINTS].max_age
FT_AGE_NS: Final = contract().topics["ft/wrench"].max_age
STATUS_PERIOD: Final = contract().topics["robot/status"].period
LINKS_PERIOD: Final = contract().topics["sim/link_poses"].period
NEVER_NS: Final = -NS
"""Time before the first tick."""
TAKE_OVER_NS: Final = 100_000_000
"""Time after the first command in which commands of others are tolerated: the watchdog sends until it sees the new driver."""


class MeasuredArm(ABC):
    """Joint state from the arm's own messages."""

    def __init__(self, joints: int) -> None:
        self.q = np.zeros(joints)
        """Measured positions [rad], shape (n,)."""
        self.v = np.zeros(joints)
        """Velocities [rad/s], shape (n,)."""
        self.torque = np.zeros(joints)
        """Measured joint torques, gravity included [N m], shape (n,), or (0,) if the arm has none."""
        self.received: int | None = None
        """Arrival of the newest state [ns], None before the first."""

    @abstractmethod
    def update(self, t: int, state: Any) -> bool:
        """Take a state received at `t` [ns]; return True if it is new and usable."""

    @property
    def accepts(self) -> bool:
        """True if the newest state is of an arm that accepts commands."""
        return self.received is not None

    @abstractmethod
    def fault(self, t: int) -> str | None:
        """Return None if the arm accepts commands at `t` [ns], else a message that says why not."""


def tool_load(mass_kg: float, up_S: Array) -> Array:
    """Return the wrench of a tool's weight on the F/T sensor, in its axes, shape (6,), with the mass half-way to the indenter."""
    force = -mass_kg * GRAVITY * up_S
    return np.concatenate((force, np.cross((0.0, 0.0, TOOL.ft_to_indenter_m / 2), force)))


class CarriedLoad(NamedTuple):
    """Gravity and sensor orientation at a posture."""

    gravity: Array
    """Gravity torques [N m], shape (n,)."""
    up_S: Array
    """World z axis in F/T sensor axes, shape (3,)."""


class GravityModel:
    """Evaluates gravity torques, the sensor's orientation and the torques of an external wrench."""

    def __init__(self, robot: Robot) -> None:
        self._model = pin.buildModelFromXML(urdf(robot, geometry=False))
        self._data = self._model.createData()
        self._sensor, self._indenter = (self._model.getFrameId(name) for name in ("ft_sensor", "indenter"))

    def at(self, q: Array) -> CarriedLoad:
        """Return both at joint positions q [rad], shape (n,)."""
        pin.forwardKinematics(self._model, self._data, q)
        rotation = pin.updateFramePlacement(self._model, self._data, self._sensor).rotation
        gravity = pin.computeGeneralizedGravity(self._model, self._data, q)
        return CarriedLoad(np.array(gravity), rotation[2].copy())

    def external_torque(self, q: Array, wrench_W: Array) -> Array:
        """Return the joint torques [N m], shape (n,), of a wrench on the indenter at its centre, world axes, shape (6,)."""
        J_W = pin.computeFrameJacobian(self._model, self._data, q, self._indenter, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        return np.asarray(J_W.T @ wrench_W)


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

    def __init__(self, scenario: Scenario) -> None:
        """Take the control service of the scenario. Raises PluginError if it does not exist."""
        self._control: Service = implementations.create("control", scenario.services.control, scenario)
        self._setpoints: list[Message] = []

    def collect(self, inbox: Inbox) -> None:
        """Collect set-points; call it on every tick."""
        self._setpoints.extend(inbox.new(SETPOINT))

    def command(self, t: int, inbox: Inbox, joints: Message) -> Any | None:
        """Return the torque command at `t` [ns] for these joint states."""
        setpoints, self._setpoints = self._setpoints, []
        return self._control.step(t, _Inbox(t, joints, setpoints, inbox))["control/joint_torque"]


class HardwareService(Service):
    """A real arm in the role robot. Subclasses give its measurement, its port and its damping."""

    role: ClassVar[str] = "robot"
    catches_up: ClassVar[bool] = False
    """A real arm has moved on: missed ticks are skipped."""

    def __init__(
        self,
        exam: ExamInput,
        port: ArmPort,
        measured: MeasuredArm,
        damping: Array,
        *,
        ft_sign: int,
        ft_weight: bool,
        inner: InnerLoop | None = None,
    ) -> None:
        """Create the driver of an arm.

        Args:
            exam: the scenario as the examination knows it.
            port: connection to the arm.
            measured: joint state from its messages.
            damping: largest joint damping in a hold [N m s/rad], shape (n,); it acts some cycles late on a measured speed.
            ft_sign: -1 if the sensor reports the wrench of the sensor on the tool.
            ft_weight: True if its wrench includes the tool's weight.
            inner: follows set-points in this process; without it `control/joint_torque` is applied.
        """
        arm, given = arm_of(exam.robot), exam.robot.driver
        self._robot, self._names, n = exam.robot, list(arm.joint_names), arm.joints
        self._port = port
        self._inner = inner
        self._arm = measured
        self._damping = damping
        self._model = GravityModel(exam.robot)
        self._positions = exam.robot.level is CommandLevel.POSITION
        self._driver = Driver(arm, exam.limits.force_emergency_n, positions=self._positions)
        self._received = ReceivedCommands(positions=self._positions)
        self._stop_requests = StopRequests(self._driver)
        self._emulated = given.emulated
        yaw = np.deg2rad(given.ft_yaw_deg)
        turn = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
        self._R_ST, self._ft_weight = ft_sign * turn, ft_weight
        self._commanding_since: int | None = None
        self._wrench = np.zeros(6)
        self._wrench_at: int | None = None
        self._tool: Message | None = None
        self._links: Message | None = None
        self._force, self._external_S = 0.0, np.zeros(3)
        self._applied = np.zeros(n)
        self._limits, self._braking = (arm.lower_rad, arm.upper_rad), LOOP.acceleration_factor * arm.acceleration_radps2
        self._sent, self._sent_v, self._sent_at = np.zeros(n), np.zeros(n), NEVER_NS
        """Newest positions sent [rad], their speed [rad/s] and their time [ns]."""
        self._taken, self._taken_at = self._sent, NEVER_NS
        """Newest command of positions [rad] and the time at which it was sent first [ns]."""
        self._pushing = False
        """True while the newest command may push."""
        self._fault: str | None = None
        """Fault of the arm or the F/T sensor; no command is accepted with one."""
        self._readings: list[Array] = []
        """Positions, velocities, wrench and torques of the states since the last status, without a gap."""
        self._mean_wrench = np.zeros(6)
        self._states = self._commands = 0
        self._peak_force = 0.0
        self._peak_torque = np.zeros(n)

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
        self._check_connection(t)
        if self._arm.received is not None:
            joints = JointState(header(self._arm.received), self._names, self._arm.q, self._arm.v, self._applied.copy())
            if self._wrench_at is not None and t - self._wrench_at <= FT_AGE_NS:
                outbox["ft/wrench"] = WrenchStamped(header(self._wrench_at, "ft_sensor"), wrench_message(self._wrench))
            if fresh:
                self._drive(t, inbox, joints)
            elif t - self._arm.received > STATE_AGE_NS:
                none = np.zeros(0)  # lockstep needs a message on every tick
                joints = JointState(header(t), [], none, none, none)
                # Damping of an old speed would be a constant push. The arm is relaxed once; then the watchdog takes over.
                if self._pushing:
                    self._relax()
            outbox[JOINTS] = joints  # on every tick: between two states the newest, with its stamp
        if not t % STATUS_PERIOD:
            outbox["robot/status"] = self._status(t)
        if self._emulated:
            self._relay(t, inbox, outbox)
        return outbox

    def finish(self) -> Mapping[str, Any]:
        """Leave the arm without torque. Return safe holds, counts, and the largest force and torques."""
        try:
            if self._arm.received is not None:
                self._relax()
        finally:
            self._port.close()
        return {
            **self._driver.facts(),
            "peak_external_force_N": self._peak_force,
            "peak_torque_nm": [round(float(x), 3) for x in self._peak_torque],
            "states": self._states,
            "commands": self._commands,
            "level": str(self._robot.level),
        }

    def _relax(self) -> None:
        """Send no torque; an arm that takes positions stays."""
        self._pushing = False
        if not self._positions:
            self._put(np.zeros_like(self._applied), active=False)

    def _receive(self, t: int) -> bool:
        """Take messages of the ROS side; return True if the joint state is new."""
        since = self._commanding_since
        if self._port.rivals() and since is not None and t - since > TAKE_OVER_NS:
            self._driver.hold(t, HoldCause.DEVICE, "another process (watchdog?) commands the arm")
        fresh, before = False, self._arm.received
        for state in self._port.states():
            fresh = self._arm.update(t, state) or fresh
        for reading in self._port.wrenches():
            values = wrench(reading.wrench)
            if not np.isfinite(values).all():
                self._driver.hold(t, HoldCause.DEVICE, f"F/T reading {values}: must be finite")
                continue
            self._wrench, self._wrench_at = self._wrench_on_sensor(values), t
        if fresh:
            self._states += 1
            if before is not None and t - before > STATUS_PERIOD:
                self._readings.clear()
            self._readings.append(np.concatenate((self._arm.q, self._arm.v, self._wrench, self._arm.torque)))
        return fresh

    def _wrench_on_sensor(self, reading: Array) -> Array:
        """Return the wrench of tool and environment on the sensor in its axes, shape (6,)."""
        wrench_S = np.concatenate((self._R_ST @ reading[:3], self._R_ST @ reading[3:]))
        if self._ft_weight:
            return wrench_S
        return np.asarray(wrench_S + tool_load(self._robot.tool_mass_kg, self._model.at(self._arm.q).up_S))

    def _check_connection(self, t: int) -> None:
        """Find what the arm and the F/T sensor lack for commands; an active driver then holds."""
        fault = self._arm.fault(t)
        if fault is None and (self._wrench_at is None or t - self._wrench_at > FT_AGE_NS):
            fault = "no F/T reading" if self._wrench_at is None else f"no F/T reading for {(t - self._wrench_at) / 1e6:.0f} ms"
        if fault is not None and self._driver.mode is DriverMode.ACTIVE:
            self._driver.hold(t, HoldCause.DEVICE, fault)
        self._fault = fault

    def _drive(self, t: int, inbox: Inbox, joints: Message) -> None:
        """Answer a new state with a command."""
        arm = self._arm
        load = self._model.at(arm.q)
        weight = self._robot.tool_mass_kg * GRAVITY
        self._external_S = self._wrench[:3] + weight * load.up_S
        self._force = float(np.linalg.norm(self._external_S))
        self._peak_force = max(self._peak_force, self._force)
        command = self._command(t, inbox, joints) if self._fault is None else None
        lost = inbox.lost("control") and self._inner is None
        values = self._driver.update(t, arm.q, arm.v, load.gravity, self._force, command, lost=lost)
        active = self._driver.mode is DriverMode.ACTIVE
        if self._positions:
            if not active and not self._driver.held:
                return
            values = self._moved(t, values if active else None)
        elif not active:
            values = -np.minimum(self._driver.damping(arm.v, load.gravity), self._damping) * arm.v
        if active and (fault := self._check_response(t, values, load)):
            self._driver.hold(t, HoldCause.DEVICE, fault)
            self._sent_at = NEVER_NS  # the arm is not where it was sent
            return  # the next state is answered by the hold
        self._put(values, active=active)
        self._commanding_since = t if self._commanding_since is None else self._commanding_since
        self._pushing = True
        self._commands += 1

    def _moved(self, t: int, values: Array | None) -> Array:
        """Return the positions to send at `t` [ns]: `values`, or where the arm stops from the last ones, and stays [rad].

        Values that come again are late ones: the motion continues for a short time. An arm that takes no commands, or had no
        recent one, may have been moved by hand: it stays where it is.
        """
        arm, elapsed_s = self._arm, (t - self._sent_at) / NS
        if values is not None and values is not self._taken:
            self._taken, self._taken_at = values, t
            speed = (values - self._sent) / elapsed_s
            self._sent_v = np.clip(speed, np.minimum(arm.v, 0.0), np.maximum(arm.v, 0.0))  # a leap of one is not a speed
        elif not arm.accepts or t - self._sent_at > STATE_AGE_NS:
            values, self._sent_v = arm.q, np.zeros_like(arm.q)
        else:
            late = values is None or t - self._taken_at > LOOP.extrapolation_ns
            slower = elapsed_s * self._braking * late
            self._sent_v = self._sent_v - np.clip(self._sent_v, -slower, slower)
            values = np.clip(self._sent + elapsed_s * self._sent_v, *self._limits)
        self._sent, self._sent_at = values, t
        return values

    def _check_response(self, t: int, values: Array, load: CarriedLoad) -> str:
        """Return a message if the arm does not respond to commands as it should, else an empty text."""
        return ""

    def _put(self, values: Array, *, active: bool) -> None:
        """Send torques [N m] or positions [rad]; `active` if they are control's."""
        self._port.command(self._arm.q, values)
        if not self._positions:
            self._applied = values
            np.maximum(self._peak_torque, np.abs(values), out=self._peak_torque)

    def _command(self, t: int, inbox: Inbox, joints: Message) -> Command | None:
        message = inbox.latest("control/joint_torque") if self._inner is None else self._inner.command(t, inbox, joints)
        return self._received.newest(message)

    def _status(self, t: int) -> Message:
        driver, n = self._driver, len(self._names)
        q = v = torque = np.zeros(0)
        if self._readings:
            q, v, self._mean_wrench, torque = np.split(np.mean(self._readings, axis=0), (n, 2 * n, 2 * n + 6))
            self._readings.clear()
        cause, reason = driver.cause, driver.reason
        if not driver.held and self._fault is not None:
            cause, reason = HoldCause.DEVICE, self._fault
        return RobotStatus(
            header(t), int(driver.mode), int(cause), reason, q, v, wrench_message(self._mean_wrench),
            self._applied.copy(), driver.rejected, driver.culprit, torque,
        )  # fmt: skip

    def _relay(self, t: int, inbox: Inbox, outbox: dict[str, Message]) -> None:
        """Relay exact poses and contact wrenches between the emulator and the simulated tissue and camera."""
        for contact in inbox.new("sim/contact_wrench"):
            self._port.contact(contact)
        tool, links = self._port.physics()
        self._tool = self._tool if tool is None else tool
        if self._tool is not None:  # the emulator has a clock of its own
            outbox["sim/tool_state"] = replace(self._tool, header=header(t, "world"))
        self._links = self._links if links is None else links
        if self._links is not None and not t % LINKS_PERIOD:
            outbox["sim/link_poses"] = self._links
