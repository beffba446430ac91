"""A KUKA LBR with lbr_fri_ros2_stack and an F/T sensor, as they look from the ROS graph: a process to test the driver against.

    python -m palpate_robot.backends.lbr.emulator scenario.yaml --listen tcp/127.0.0.1:7447

It publishes and takes exactly the stack's messages under rmw_zenoh's keys and keeps the rules in `fri`. Its physics is that of
`palpate_robot`. For simulated tissue and camera it also exchanges what no sensor knows, on topics under `emulator/`.
"""

from __future__ import annotations

import argparse
import gc
import logging
import signal
import sys
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
from palpate_bus.settings import BusConfigError
from palpate_bus.wire.ros_node import RosNode
from palpate_bus.wire.zenoh_config import BusOptions
from palpate_models.numerics.frames import Array
from palpate_models.robot import lbr
from palpate_models.scenario.errors import draw_errors
from palpate_models.scenario.load import ScenarioError, load_scenario, plant_input
from palpate_models.scenario.schema import PlantInput
from palpate_robot.backends.dart.plant import DartPlant
from palpate_robot.backends.lbr.fri import Drive, FriSession
from palpate_robot.backends.lbr.idl import (
    STATE,
    TORQUE_COMMAND,
    ClientCommandMode,
    FriControlMode,
    LBRState,
    SafetyState,
    SessionState,
)
from palpate_robot.backends.lbr.port import CONTACT_TOPIC, LINKS, LINKS_TOPIC, TOOL_STATE, TOOL_TOPIC, WRENCH
from palpate_robot.ft_sensor import FtSensor
from palpate_robot.joint_sensor import JointSensor

log = logging.getLogger("emulator")

BRAKE: Final = np.full(7, 2000.0)
"""Joint damping while nothing is commanded [N m s/rad]: the arm's own position control, then its brakes, hold it."""
CONTACT_AGE_NS: Final = 200_000_000
"""A contact wrench older than this is none: the tissue is gone."""


@dataclass(frozen=True)
class Options:
    """How the emulated arm is set up; see `main`."""

    period_ms: int = 2
    stiffness_nm: float = 0.0
    gravity_error_nm: float = 0.0
    command_timeout_ms: int = 0
    namespace: str = "lbr"
    ft_topic: str = "ft_sensor/wrench"


class Emulator:
    """Physics and session; `cycle` once a send period. Time comes from outside."""

    def __init__(self, known: PlantInput, options: Options) -> None:
        """The arm of a scenario, with its errors."""
        drawn = draw_errors(known.errors, known.seed)
        self._options = options
        self._plant = DartPlant(known.robot, drawn=drawn.arm)
        streams = np.random.SeedSequence([known.seed, 0x4C4252]).spawn(3)
        joints, ft, load = (np.random.Generator(np.random.PCG64(stream)) for stream in streams)
        self._ft = FtSensor(drawn.force, ft, options.period_ms * 1e-3)
        self._joints = JointSensor(drawn.arm, joints, self._plant.q, self._plant.gravity_torque())
        self.session = FriSession(options.period_ms, self._joints.q.copy(), command_timeout_ms=options.command_timeout_ms)
        self._radius = known.robot.indenter_radius_m
        self._load_error = load.uniform(-1.0, 1.0, 7) * options.gravity_error_nm
        """What the arm's load data get wrong [N m], constant."""
        self._applied = Drive(self._joints.q.copy(), np.zeros(7))
        self.force_W, self.moment_W = np.zeros(3), np.zeros(3)
        self.measured: Array = self._joints.q.copy()

    def cycle(self, *, answered: bool = True) -> None:
        """Moves the arm by one send period under the newest command."""
        plant, joints, options = self._plant, self._joints, self._options
        self.measured, _ = joints.read()
        self._applied = drive = self.session.cycle(self.measured, plant.gravity_torque(), answered=answered)
        active = self.session.state is SessionState.COMMANDING_ACTIVE
        damping = 2 * 0.7 * np.sqrt(np.full(7, options.stiffness_nm)) if active else BRAKE
        for _ in range(options.period_ms):
            spring = options.stiffness_nm * (drive.position - joints.q)
            error = self._load_error if active else 0.0
            torque = plant.gravity_torque() + drive.torque + spring + error
            plant.step(torque, self.force_W, self.moment_W, damping)
            joints.update(plant.q, plant.v, torque)

    def state(self, now: int) -> Any:
        """LBRState at wall time `now` [ns]."""
        session, drive = self.session, self._applied
        gravity = self._plant.gravity_torque()
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
            measured_torque=gravity + drive.torque,
            commanded_torque=drive.torque,
            external_torque=np.zeros(7),
            ipo_joint_position=ipo,
            tracking_performance=1.0,
        )

    def wrench(self, now: int) -> Any:
        """What the F/T sensor's driver publishes."""
        fx, fy, fz, mx, my, mz = self._ft.read(self._plant.sensor_wrench())
        return WrenchStamped(header(now, "ft_sensor"), Wrench(Vector3(fx, fy, fz), Vector3(mx, my, mz)))

    def tool(self, now: int) -> Any:
        """palpation_msgs/ToolState, exact."""
        motion = self._plant.tool_motion().tolist()
        pose = Pose(Point(*motion[:3]), Quaternion(*motion[3:7]))
        return ToolState(header(now, "world"), pose, Twist(Vector3(*motion[7:10]), Vector3(*motion[10:])), self._radius)

    def links(self, now: int) -> Any:
        """tf2_msgs/TFMessage of all links in world, exact."""
        found = []
        for link, pose in zip(lbr.LINK_NAMES, self._plant.link_poses().tolist(), strict=True):
            transform = Transform(Vector3(*pose[:3]), Quaternion(*pose[3:]))
            found.append(TransformStamped(header(now, "world"), link, transform))
        return TFMessage(found)


class Metronome:
    """When cycles are due and what they are stamped with. Time comes from outside.

    A real arm never hurries: a late cycle moves all that follow, and by its own clock one period passes in every cycle.
    """

    def __init__(self, period: int, now: int, wall: int) -> None:
        """The first cycle is one `period` [ns] after `now` [ns] of a steady clock, when the time of day is `wall` [ns]."""
        self._period = period
        self._due = now + period
        self._stamp = wall

    def wait(self, now: int) -> int:
        """How long it is until the next cycle [ns], 0 when it is due."""
        return max(self._due - now, 0)

    def begin(self, now: int) -> int:
        """Begins a cycle; returns its stamp [ns]."""
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
    """Cycles on the wall clock while `running[0]`; after the session's end the arm stands, and the stack says no more."""
    metronome = Metronome(options.period_ms * 1_000_000, monotonic_ns(), time_ns())
    contact_at = 0
    cycles = 0
    said = ""
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
        elif said != emulator.session.ended:
            said = emulator.session.ended
            log.error("the session has ended: %s", said)
        graph.wrench.publish(emulator.wrench(stamp))
        graph.tool.publish(emulator.tool(stamp))
        if cycles % (50 // options.period_ms or 1) == 0:
            graph.links.publish(emulator.links(stamp))
        cycles += 1


def main(arguments: list[str] | None = None) -> int:
    """Runs the emulator until a signal; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m palpate_robot.backends.lbr.emulator", description=__doc__.partition("\n")[0])
    parser.add_argument("scenario", nargs="?", default="clean", help="where the arm stands and what tool it has")
    parser.add_argument("--listen", default="tcp/127.0.0.1:7447", help="zenoh endpoint, where rmw_zenohd would be")
    parser.add_argument("--domain", type=int, default=0, help="ROS domain")
    parser.add_argument("--period-ms", type=int, default=2, help="FRI send period")
    parser.add_argument("--stiffness", type=float, default=0.0, help="of the joint impedance controller [N m/rad]")
    parser.add_argument("--gravity-error", type=float, default=0.0, help="error of the load data, up to this a joint [N m]")
    parser.add_argument(
        "--command-timeout-ms", type=int, default=0, help="end the session without commands; 0: never, as the stack"
    )
    given = parser.parse_args(arguments)
    logging.basicConfig(level="INFO", format="%(asctime)s emulator %(levelname)s %(message)s", stream=sys.stderr)
    options = Options(given.period_ms, given.stiffness, given.gravity_error, given.command_timeout_ms)
    try:
        emulator = Emulator(plant_input(load_scenario(given.scenario)), options)
        node = RosNode("lbr_emulator", given.domain, BusOptions(listen=(given.listen,)))
    except (ScenarioError, BusConfigError, ValueError) as error:
        print(f"emulator: {error}", file=sys.stderr)
        return 2
    running = [True]

    def stop(number: int, frame: FrameType | None) -> None:
        running[0] = False

    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    log.info("an LBR at %s, FRI every %d ms", given.listen, options.period_ms)
    gc.freeze()  # a controller cabinet takes no tenth of a second to collect garbage
    try:
        serve(emulator, Graph(node, options), options, running)
    finally:
        node.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
