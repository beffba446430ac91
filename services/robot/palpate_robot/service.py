"""Robot service: driver, plant and sensors in one step of a millisecond."""

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import numpy as np

from palpate_bus.contract import contract
from palpate_bus.messages import NS, Header, JointState, Message, RobotStatus, String, Time, Vector3, Wrench, WrenchStamped
from palpate_bus.messages.codes import DriverMode, HoldCause
from palpate_bus.messages.geometry import frames_message, tool_message, wrench_message
from palpate_bus.service import Inbox, Outbox, Service
from palpate_models.numerics.frames import GRAVITY, Array
from palpate_models.numerics.seeds import generators
from palpate_models.robot.arm import arm_of, link_names, urdf
from palpate_models.scenario.errors import draw_errors
from palpate_models.scenario.schema import CommandLevel, PlantInput
from palpate_robot.driver import TUNING, Driver
from palpate_robot.plant import DT, PlantFactory
from palpate_robot.position_loop import PositionLoop
from palpate_robot.sensors import FtSensor, JointSensor, TorqueSensors
from palpate_robot.stop_requests import ReceivedCommands, StopRequests

_TICK = round(DT * NS)
_STATUS_PERIOD = contract().topics["robot/status"].period
_LINKS_PERIOD = contract().topics["sim/link_poses"].period
_CONTACT_AGE = contract().topics["sim/contact_wrench"].max_age


class RobotService(Service):
    """The arm with F/T sensor and spherical indenter, simulated."""

    role: ClassVar[str] = "robot"

    def __init__(self, known: PlantInput, plant: PlantFactory) -> None:
        """Start at rest at home. `plant` creates the physics."""
        robot, arm = known.robot, arm_of(known.robot)
        drawn = draw_errors(known.errors, known.seed, arm.joints)
        joint_rng, ft_rng, torque_rng = generators(known.seed, "robot", 3)
        self._robot, self._names, self._links = robot, list(arm.joint_names), link_names(robot)
        self._plant = plant(robot, drawn=drawn.arm)
        self._sensor = FtSensor(drawn.force, ft_rng, DT)
        self._joints = JointSensor(drawn.arm, joint_rng, self._plant.q, self._plant.gravity_torque())
        self._torque_sensors = TorqueSensors(robot, drawn.torque, torque_rng)
        positions = robot.level is CommandLevel.POSITION
        self._driver = Driver(arm, known.limits.force_emergency_n, positions=positions)
        self._loop = PositionLoop(arm, self._joints.q) if positions else None
        self._commands = ReceivedCommands(positions=positions)
        self._stop_requests = StopRequests(self._driver)
        self._weight = robot.tool_mass_kg * GRAVITY
        self._t: int | None = None
        self._force_W = np.zeros(3)
        self._moment_W = np.zeros(3)
        self._pressed = False
        self._applied: Array = np.zeros(arm.joints)  # never written to: messages keep it
        self._joint_readings: list[Array] = []
        """Positions and velocities since the last status [rad, rad/s], one after the other."""
        self._ft_readings: list[list[float]] = []
        """F/T readings since the last status [N, N m]."""
        self._drive_torques: list[Array] = [self._plant.gravity_torque()]
        """Torques of the drives since the last status [N m]."""
        self._friction_torques: list[Array] = [np.zeros(arm.joints)]
        """Torques of friction since the last status [N m]."""
        self._external_force = 0.0
        self._peak_force = 0.0

    def start(self) -> Outbox:
        """Publish the robot description."""
        return {"robot_description": String(urdf(self._robot))}

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Advance the plant to `t` under the messages of the previous tick, and measure."""
        return {topic: message for part in self.parts(t, inbox) for topic, message in part.items()}

    def parts(self, t: int, inbox: Inbox) -> Iterator[Outbox]:
        """Do what `step` does, in the order in which control and tissue wait for the messages."""
        self._stop_requests.apply(t, inbox)
        self._drive(t, inbox)
        stamp = Time(t // NS, t % NS)
        yield {"joint_states": self._joint_state(stamp)}
        motion = self._plant.tool_motion().tolist()
        yield {"sim/tool_state": tool_message(Header(stamp, "world"), motion, self._robot.indenter_radius_m)}
        x, y, z, w = motion[3:7]
        up_S = (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
        outbox: dict[str, Message] = {"ft/wrench": self._wrench(stamp, up_S)}
        if not t % _STATUS_PERIOD:
            outbox["robot/status"] = self._status(stamp)
        if not t % _LINKS_PERIOD:
            outbox["sim/link_poses"] = frames_message(Header(stamp, "world"), self._links, self._plant.link_poses())
        yield outbox

    def finish(self) -> Mapping[str, Any]:
        """Return safe holds, rejected commands, and the largest measured external force."""
        return {**self._driver.facts(), "peak_external_force_N": self._peak_force}

    def _drive(self, t: int, inbox: Inbox) -> None:
        """Step driver and plant up to `t`. The first tick is the initial state.

        In wall-clock mode a slow machine skips ticks. No command came in this time: the arm brakes, as a real one does.
        """
        plant, driver, joints = self._plant, self._driver, self._joints
        steps = 0 if self._t is None else (t - self._t) // _TICK
        self._t = t
        command = self._commands.newest(inbox.latest("control/joint_torque"))
        self._read_contact(t, inbox)
        if steps * _TICK > TUNING.validity_ns and driver.mode is DriverMode.ACTIVE:
            reason = f"this machine is too slow: the simulation of the arm stood still for {steps * DT * 1e3:.0f} ms"
            driver.hold(t, HoldCause.COMMAND_EXPIRED, reason, self.role)
            self._clear_readings()
        for step in range(steps):
            gravity = plant.gravity_torque()
            values = driver.update(t, joints.q, joints.v, gravity, self._external_force, command, lost=inbox.lost("control"))
            age = 0 if command is None else t - (steps - 1 - step) * _TICK - command.stamp
            torque, damping = self._act(values, gravity, age)
            driven = gravity + torque
            plant.step(driven, self._force_W if self._pressed else None, self._moment_W, damping)
            joints.update(plant.q, plant.v, driven)
            self._drive_torques.append(driven)
            self._friction_torques.append(plant.friction)
            if self._loop is not None:
                self._applied = torque - damping * joints.v
            else:
                self._applied = torque if driver.mode is DriverMode.ACTIVE else -damping * joints.v

    def _act(self, values: Array, gravity: Array, age: int) -> tuple[Array, Array]:
        """Return torque without gravity [N m] and damping [N m s/rad] of a step, for values of that `age` [ns]."""
        if self._loop is None:
            return values, self._driver.damping(self._joints.v, gravity)
        command = values if self._driver.mode is DriverMode.ACTIVE else None
        return self._loop.torque(command, self._joints.q, self._joints.v, gravity, age), self._loop.damping

    def _read_contact(self, t: int, inbox: Inbox) -> None:
        """Read the tissue's wrench: zero before its first message and after the tissue is lost.

        In wall-clock mode the driver holds if tissue is late in contact: the missed deformation would act on the arm at once.
        """
        message = inbox.latest("sim/contact_wrench")
        force, moment = self._force_W, self._moment_W
        if message is None or inbox.lost("tissue"):
            self._pressed = False
            return
        received = inbox.stamp("sim/contact_wrench")
        if self._pressed and received is not None and t - received > _CONTACT_AGE:
            age, limit = (t - received) / 1e6, _CONTACT_AGE / 1e6
            reason = f"no message on sim/contact_wrench for {age:.0f} ms, limit {limit:.0f} ms: tissue is late"
            self._driver.hold(t, HoldCause.COMMAND_EXPIRED, reason, "sim/contact_wrench")
        f, m = message.wrench.force, message.wrench.torque
        self._pressed = bool(f.x or f.y or f.z or m.x or m.y or m.z)
        if self._pressed:
            force[0], force[1], force[2] = f.x, f.y, f.z
            moment[0], moment[1], moment[2] = m.x, m.y, m.z

    def _joint_state(self, stamp: Message) -> Message:
        q, v = self._joints.read()
        self._joint_readings += (q, v)
        return JointState(Header(stamp, ""), self._names, q, v, self._applied)

    def _wrench(self, stamp: Message, up_S: tuple[float, float, float]) -> Message:
        """Return the sensor reading. `up_S`: world z axis in sensor axes, for subtracting the tool weight."""
        reading = self._sensor.read(self._plant.sensor_wrench())
        self._ft_readings.append(reading)
        fx, fy, fz, mx, my, mz = reading
        weight = self._weight
        external = (fx + weight * up_S[0]) ** 2 + (fy + weight * up_S[1]) ** 2 + (fz + weight * up_S[2]) ** 2
        self._external_force = external**0.5
        self._peak_force = max(self._peak_force, self._external_force)
        return WrenchStamped(Header(stamp, "ft_sensor"), Wrench(Vector3(fx, fy, fz), Vector3(mx, my, mz)))

    def _status(self, stamp: Message) -> Message:
        driver = self._driver
        ticks = len(self._ft_readings)
        mean = np.add.reduce(np.concatenate(self._joint_readings).reshape(ticks, -1)) / ticks
        wrench = np.add.reduce(self._ft_readings) / ticks
        if self._drive_torques:
            torque = (np.add.reduce(self._drive_torques) - np.add.reduce(self._friction_torques)) / len(self._drive_torques)
            self._measured_torque = self._torque_sensors.read(self._plant.q, self._plant.v, torque, len(self._drive_torques))
        self._clear_readings()
        state, n = (int(driver.mode), int(driver.cause), driver.reason), len(self._names)
        sensed, faults = (mean[:n], mean[n:], wrench_message(wrench)), (driver.rejected, driver.culprit)
        return RobotStatus(Header(stamp, ""), *state, *sensed, self._applied, *faults, self._measured_torque)

    def _clear_readings(self) -> None:
        for readings in (self._drive_torques, self._friction_torques, self._joint_readings, self._ft_readings):
            readings.clear()
