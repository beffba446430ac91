"""Emulates a KUKA LBR with lbr_fri_ros2_stack and an F/T sensor on the ROS graph.

    python -m palpate_robot.backends.lbr.emulator scenario.yaml --listen tcp/127.0.0.1:7447

It publishes and accepts the stack's messages under rmw_zenoh's keys. Its physics is that of `palpate_robot`. For simulated tissue
and camera it also exchanges exact poses and contact wrenches on topics under `emulator/`.

`FriSession` keeps the rules of lbr_fri_ros2_stack (rolling) and of KUKA's FRI manual:

- the send period is a whole number of milliseconds, 1 to 100;
- the session passes IDLE, MONITORING_WAIT, MONITORING_READY, COMMANDING_WAIT, COMMANDING_ACTIVE, and leaves the last for good:
  the stack then ends ("LBR left COMMANDING_ACTIVE", system_interface.cpp);
- commands are accepted only in COMMANDING_ACTIVE; the last one is kept for ever (lbr_torque_command_controller.cpp: no time-out);
- a NaN in the command means "position as measured, no torque" (torque_command.cpp);
- the command guard ends the session when the commanded position leaves the joint limits or the measured speed exceeds the joint
  limit; it does not check torques (command_guard.cpp: `is_valid_command`);
- the joint position sent to the arm is the previous one plus `pid_p` times the difference (filters.cpp, `JointPIDArray`);
- the controller ends the session when overlay plus gravity exceed a torque limit, or when the client does not answer: connection
  quality falls from EXCELLENT to POOR, at which commanding ends.
"""

from __future__ import annotations

import argparse
import gc
import logging
import signal
import sys
from collections import deque
from dataclasses import dataclass
from time import monotonic_ns, sleep, time_ns
from types import FrameType
from typing import Any, Final

import numpy as np

from palpate_bus.messages import (
    Point,
    Pose,
    Quaternion,
    TFMessage,
    ToolState,
    Transform,
    TransformStamped,
    Twist,
    Vector3,
    Wrench,
    WrenchStamped,
)
from palpate_bus.messages.stamps import header
from palpate_bus.wire.ros_node import RosNode
from palpate_bus.wire.zenoh_config import BusOptions
from palpate_errors import UserError
from palpate_models.numerics.frames import Array
from palpate_models.robot import lbr
from palpate_models.robot.arm import link_names
from palpate_models.scenario.errors import draw_errors
from palpate_models.scenario.load import load_scenario, plant_input
from palpate_models.scenario.schema import PlantInput
from palpate_robot.backends.dart.plant import DartPlant
from palpate_robot.backends.lbr.port import (
    CONTACT_TOPIC,
    LINKS,
    LINKS_TOPIC,
    STATE,
    TOOL_STATE,
    TOOL_TOPIC,
    TORQUE_COMMAND,
    WRENCH,
    ClientCommandMode,
    ConnectionQuality,
    FriControlMode,
    LBRState,
    SafetyState,
    SessionState,
)
from palpate_robot.sensors import FtSensor, JointSensor, TorqueSensors

PERIODS_MS: Final = range(1, 101)
MONITORING_S: Final = 0.2
"""Time in each monitoring state [A]; on the arm it lasts until the Sunrise application continues."""
SYNC_S: Final = 0.1
"""Time in COMMANDING_WAIT [A]."""
QUALITY_WINDOW: Final = 100
"""Answers over which connection quality is computed."""
QUALITY: Final = ((0.02, ConnectionQuality.EXCELLENT), (0.10, ConnectionQuality.GOOD), (0.30, ConnectionQuality.FAIR))
"""Largest fraction of lost answers per quality [A]; above the last it is POOR."""


@dataclass(frozen=True, slots=True)
class Drive:
    """Position and overlay applied by the arm's controller in a cycle."""

    position: Array
    """Commanded joint position [rad], shape (7,): set-point of the joint springs if the controller has stiffness."""
    torque: Array
    """Overlay [N m], shape (7,)."""


class FriSession:
    """One FRI session behind the stack."""

    def __init__(self, period_ms: int, q: Array, *, pid_p: float = 0.1, command_timeout_ms: int = 0) -> None:
        """`command_timeout_ms`: optional time-out on commands; 0 for none, as in the stack.

        Raises UserError for a period outside FRI's range.
        """
        if period_ms not in PERIODS_MS:
            raise UserError(f"send period {period_ms} ms: want whole milliseconds from {PERIODS_MS[0]} to {PERIODS_MS[-1]}")
        self._dt = period_ms * 1e-3
        self._pid_p = pid_p
        self._timeout = command_timeout_ms * 1e-3
        self.state = SessionState.IDLE
        self.quality = ConnectionQuality.POOR
        self.ended = ""
        """Message on the end of the session; empty while it runs."""
        self._in_state = 0.0
        self._answers: deque[bool] = deque(maxlen=QUALITY_WINDOW)
        self._target = Drive(q.copy(), np.zeros(7))
        self._position = q.copy()
        self._since_command: float | None = None
        self._q_before: Array | None = None

    def _enter(self, state: SessionState) -> None:
        self.state, self._in_state = state, 0.0

    def end(self, why: str) -> None:
        """End the session."""
        if not self.ended:
            self.ended = why
            self._enter(SessionState.IDLE)

    def take(self, position: Array, torque: Array) -> None:
        """Take a command: joint positions [rad], overlay [N m], shapes (7,). Ignored unless COMMANDING_ACTIVE."""
        if self.state is SessionState.COMMANDING_ACTIVE:
            self._target = Drive(position, torque)
            self._since_command = 0.0

    def cycle(self, q: Array, gravity: Array, *, answered: bool = True) -> Drive:
        """Run one send period at measured positions q [rad] and gravity torques [N m]; returns the applied drive."""
        self._in_state += self._dt
        self._answers.append(answered)
        lost = 1.0 - sum(self._answers) / len(self._answers)
        self.quality = next((quality for share, quality in QUALITY if lost <= share), ConnectionQuality.POOR)
        if not self.ended:
            self._advance(q)
        if self.state is not SessionState.COMMANDING_ACTIVE:
            return Drive(q, np.zeros(7))
        return self._apply(q, gravity)

    def _advance(self, q: Array) -> None:
        state = self.state
        if state is SessionState.IDLE:
            self._enter(SessionState.MONITORING_WAIT)
        elif state is SessionState.MONITORING_WAIT and self._in_state > MONITORING_S and self.quality >= ConnectionQuality.GOOD:
            self._enter(SessionState.MONITORING_READY)
        elif state is SessionState.MONITORING_READY and self._in_state > MONITORING_S:
            self._enter(SessionState.COMMANDING_WAIT)
        elif state is SessionState.COMMANDING_WAIT and self._in_state > SYNC_S:
            self._enter(SessionState.COMMANDING_ACTIVE)
            self._target, self._position = Drive(q.copy(), np.zeros(7)), q.copy()
            self._since_command = None
        elif state >= SessionState.COMMANDING_WAIT and self.quality is ConnectionQuality.POOR:
            self.end("connection quality is POOR: the client does not answer in time")

    def _apply(self, q: Array, gravity: Array) -> Drive:
        if self._since_command is not None:
            self._since_command += self._dt
            if 0.0 < self._timeout < self._since_command:
                self.end(f"no command for {self._since_command * 1e3:.0f} ms, time-out {self._timeout * 1e3:.0f} ms")
        if not (np.isfinite(self._target.position).all() and np.isfinite(self._target.torque).all()):
            self._target, self._position = Drive(q.copy(), np.zeros(7)), q.copy()
        self._position = self._position + self._pid_p * (self._target.position - q)
        self._guard(q, gravity)
        return Drive(q, np.zeros(7)) if self.ended else Drive(self._position, self._target.torque)

    def _guard(self, q: Array, gravity: Array) -> None:
        speed = np.zeros(7) if self._q_before is None else np.abs(q - self._q_before) / self._dt
        self._q_before = q.copy()
        for i, joint in enumerate(lbr.JOINT_NAMES):
            if abs(self._position[i]) > lbr.POSITION_LIMIT[i]:
                self.end(f"command guard: {joint} commanded to {self._position[i]:.3f} rad")
            elif speed[i] > lbr.VELOCITY_LIMIT[i]:
                self.end(f"command guard: {joint} at {speed[i]:.2f} rad/s, limit {lbr.VELOCITY_LIMIT[i]:.2f} rad/s")
            elif abs(self._target.torque[i] + gravity[i]) > lbr.TORQUE_LIMIT[i]:
                self.end(
                    f"controller: {joint} at {self._target.torque[i] + gravity[i]:.0f} N m, limit {lbr.TORQUE_LIMIT[i]:.0f} N m"
                )


log = logging.getLogger("emulator")

BRAKE: Final = np.full(7, 2000.0)
"""Joint damping without commands [N m s/rad]: the arm's position control and brakes hold it."""
CONTACT_AGE_NS: Final = 200_000_000
"""Age above which a contact wrench is dropped: the tissue is lost."""


@dataclass(frozen=True)
class Options:
    """Options of the emulated arm; see `main`."""

    period_ms: int = 2
    stiffness_nm: float = 0.0
    gravity_error_nm: float = 0.0
    command_timeout_ms: int = 0
    namespace: str = "lbr"
    ft_topic: str = "ft_sensor/wrench"


class Emulator:
    """Physics and session; call `cycle` once per send period. Time comes from the caller."""

    def __init__(self, known: PlantInput, options: Options) -> None:
        """Create the arm of a scenario, with its errors."""
        drawn = draw_errors(known.errors, known.seed)
        self._options = options
        self._plant = DartPlant(known.robot, drawn=drawn.arm)
        streams = np.random.SeedSequence([known.seed, 0x4C4252]).spawn(4)
        joints, ft, load, torque = (np.random.Generator(np.random.PCG64(stream)) for stream in streams)
        self._ft = FtSensor(drawn.force, ft, options.period_ms * 1e-3)
        self._joints = JointSensor(drawn.arm, joints, self._plant.q, self._plant.gravity_torque())
        self._torque_sensors = TorqueSensors(known.robot, drawn.torque, torque)
        self._link_torque: Array = self._plant.gravity_torque()
        """Mean torque on the links in the last send period [N m]."""
        self.session = FriSession(options.period_ms, self._joints.q.copy(), command_timeout_ms=options.command_timeout_ms)
        self._radius, self._links = known.robot.indenter_radius_m, link_names(known.robot)
        self._load_error = load.uniform(-1.0, 1.0, 7) * options.gravity_error_nm
        """Constant error of the arm's load data [N m]."""
        self._applied = Drive(self._joints.q.copy(), np.zeros(7))
        self.force_W, self.moment_W = np.zeros(3), np.zeros(3)
        self.measured: Array = self._joints.q.copy()

    def cycle(self, *, answered: bool = True) -> None:
        """Advance the arm by one send period under the newest command."""
        plant, joints, options = self._plant, self._joints, self._options
        self.measured, _ = joints.read()
        self._applied = drive = self.session.cycle(self.measured, plant.gravity_torque(), answered=answered)
        active = self.session.state is SessionState.COMMANDING_ACTIVE
        damping = 2 * 0.7 * np.sqrt(np.full(7, options.stiffness_nm)) if active else BRAKE
        total = np.zeros(7)
        for _ in range(options.period_ms):
            spring = options.stiffness_nm * (drive.position - joints.q)
            error = self._load_error if active else 0.0
            torque = plant.gravity_torque() + drive.torque + spring + error
            plant.step(torque, self.force_W, self.moment_W, damping)
            joints.update(plant.q, plant.v, torque)
            total += torque - plant.friction
        self._link_torque = total / options.period_ms

    def state(self, now: int) -> Any:
        """Return LBRState at wall time `now` [ns]."""
        session, drive = self.session, self._applied
        plant, readings = self._plant, self._options.period_ms
        ipo = self.measured if session.state >= SessionState.COMMANDING_WAIT else np.full(7, np.nan)
        return LBRState(
            sample_time=self._options.period_ms * 1e-3,
            session_state=int(session.state),
            connection_quality=int(session.quality),
            safety_state=int(SafetyState.NORMAL_OPERATION),
            operation_mode=2,
            drive_state=1,
            client_command_mode=int(ClientCommandMode.TORQUE),
            overlay_type=1,
            control_mode=int(FriControlMode.JOINT_IMP_CONTROL_MODE),
            time_stamp_sec=now // 1_000_000_000,
            time_stamp_nano_sec=now % 1_000_000_000,
            measured_joint_position=self.measured,
            commanded_joint_position=drive.position,
            measured_torque=self._torque_sensors.read(plant.q, plant.v, self._link_torque, readings),
            commanded_torque=drive.torque,
            external_torque=np.zeros(7),
            ipo_joint_position=ipo,
            tracking_performance=1.0,
        )

    def wrench(self, now: int) -> Any:
        """Return the F/T reading."""
        fx, fy, fz, mx, my, mz = self._ft.read(self._plant.sensor_wrench())
        return WrenchStamped(header(now, "ft_sensor"), Wrench(Vector3(fx, fy, fz), Vector3(mx, my, mz)))

    def tool(self, now: int) -> Any:
        """Return the exact palpation_msgs/ToolState."""
        motion = self._plant.tool_motion().tolist()
        pose = Pose(Point(*motion[:3]), Quaternion(*motion[3:7]))
        return ToolState(header(now, "world"), pose, Twist(Vector3(*motion[7:10]), Vector3(*motion[10:])), self._radius)

    def links(self, now: int) -> Any:
        """Return the exact tf2_msgs/TFMessage of all links in world."""
        found = []
        for link, pose in zip(self._links, self._plant.link_poses().tolist(), strict=True):
            transform = Transform(Vector3(*pose[:3]), Quaternion(*pose[3:]))
            found.append(TransformStamped(header(now, "world"), link, transform))
        return TFMessage(found)


class Metronome:
    """Due times and stamps of cycles. Time comes from the caller.

    A real arm does not catch up: a late cycle delays all that follow, and its own clock advances one period per cycle.
    """

    def __init__(self, period: int, now: int, wall: int) -> None:
        """Put the first cycle one `period` [ns] after `now` [ns] (steady clock) at time of day `wall` [ns]."""
        self._period = period
        self._due = now + period
        self._stamp = wall

    def wait(self, now: int) -> int:
        """Return the time until the next cycle [ns], 0 when it is due."""
        return max(self._due - now, 0)

    def begin(self, now: int) -> int:
        """Begin a cycle; return its stamp [ns]."""
        if now - self._due > self._period:
            self._due = now
        self._due += self._period
        self._stamp += self._period
        return self._stamp


class Graph:
    """The emulator's publishers and subscriptions."""

    def __init__(self, node: RosNode, options: Options) -> None:
        name = options.namespace
        self.state = node.publisher(f"{name}/state", STATE)
        self.wrench = node.publisher(options.ft_topic, WRENCH)
        self.command = node.subscription(f"{name}/command/torque", TORQUE_COMMAND)
        self.contact = node.subscription(CONTACT_TOPIC, WRENCH)
        self.tool = node.publisher(TOOL_TOPIC, TOOL_STATE)
        self.links = node.publisher(LINKS_TOPIC, LINKS)


def serve(emulator: Emulator, graph: Graph, options: Options, running: list[bool]) -> None:
    """Run cycles in wall-clock time while `running[0]`; after the session ends the arm stands and no state is published."""
    metronome = Metronome(options.period_ms * 1_000_000, monotonic_ns(), time_ns())
    contact_at = 0
    cycles = 0
    reported = ""
    while running[0]:
        sleep(metronome.wait(monotonic_ns()) / 1e9)
        now = monotonic_ns()
        stamp = metronome.begin(now)
        contact = graph.contact.newest()
        if contact is not None:
            f, m = contact.wrench.force, contact.wrench.torque
            emulator.force_W[:], emulator.moment_W[:] = (f.x, f.y, f.z), (m.x, m.y, m.z)
            contact_at = now
        elif now - contact_at > CONTACT_AGE_NS:
            emulator.force_W[:] = emulator.moment_W[:] = 0.0
        command = graph.command.newest()
        if command is not None:
            emulator.session.take(np.array(command.joint_position), np.array(command.torque))
        emulator.cycle()
        if not emulator.session.ended:
            graph.state.publish(emulator.state(stamp))
        elif reported != emulator.session.ended:
            reported = emulator.session.ended
            log.error("the session has ended: %s", reported)
        graph.wrench.publish(emulator.wrench(stamp))
        graph.tool.publish(emulator.tool(stamp))
        if cycles % (50 // options.period_ms or 1) == 0:
            graph.links.publish(emulator.links(stamp))
        cycles += 1


def main(arguments: list[str] | None = None) -> int:
    """Run the emulator until a signal; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m palpate_robot.backends.lbr.emulator", description=__doc__.partition("\n")[0])
    parser.add_argument("scenario", nargs="?", default="clean", help="base placement and tool")
    parser.add_argument("--listen", default="tcp/127.0.0.1:7447", help="zenoh endpoint that replaces rmw_zenohd")
    parser.add_argument("--domain", type=int, default=0, help="ROS domain")
    parser.add_argument("--period-ms", type=int, default=2, help="FRI send period")
    parser.add_argument("--stiffness", type=float, default=0.0, help="stiffness of the joint impedance controller [N m/rad]")
    parser.add_argument("--gravity-error", type=float, default=0.0, help="largest error of the load data per joint [N m]")
    parser.add_argument(
        "--command-timeout-ms", type=int, default=0, help="end the session without commands; 0: never, as the stack"
    )
    given = parser.parse_args(arguments)
    logging.basicConfig(level="INFO", format="%(asctime)s emulator %(levelname)s %(message)s", stream=sys.stderr)
    options = Options(given.period_ms, given.stiffness, given.gravity_error, given.command_timeout_ms)
    try:
        emulator = Emulator(plant_input(load_scenario(given.scenario)), options)
        node = RosNode("lbr_emulator", given.domain, BusOptions(listen=(given.listen,)))
    except UserError as error:
        print(f"emulator: {error}", file=sys.stderr)
        return 2
    running = [True]

    def stop(number: int, frame: FrameType | None) -> None:
        running[0] = False

    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    log.info("an LBR at %s, FRI every %d ms", given.listen, options.period_ms)
    gc.freeze()  # avoids garbage collections of 0.1 s
    try:
        serve(emulator, Graph(node, options), options, running)
    finally:
        node.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
