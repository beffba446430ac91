"""Physics, sensors and pace of an emulated arm, and its exchange with simulated tissue and camera over a ROS graph.

A subclass of `EmulatedArm` decides what the drives do in a cycle. Exact poses and contact wrenches are on topics under
`emulator/`.
"""

import gc
from collections.abc import Callable
from contextlib import closing
from time import monotonic_ns, sleep, time_ns
from typing import Any, Final

import numpy as np

from palpate_bus.messages import WrenchStamped, header
from palpate_bus.messages.geometry import frames_message, tool_message, wrench_message
from palpate_bus.settings import Settings
from palpate_bus.wire.ros_node import RosNode
from palpate_bus.wire.zenoh_config import catch_signals
from palpate_models.numerics.frames import Array
from palpate_models.robot.arm import arm_of, link_names
from palpate_models.scenario.errors import draw_errors
from palpate_models.scenario.schema import PlantInput
from palpate_robot.backends.arm_port import CONTACT_TOPIC, LINKS, LINKS_TOPIC, TOOL_STATE, TOOL_TOPIC, WRENCH
from palpate_robot.backends.dart.plant import DartPlant
from palpate_robot.sensors import FtSensor, JointSensor, TorqueSensors

BRAKE_NMS: Final = 2000.0
"""Joint damping without commands: the arm's position control and brakes hold it."""
CONTACT_AGE_NS: Final = 200_000_000
"""Age above which a contact wrench is dropped: the tissue is lost."""


class EmulatedArm:
    """Physics and sensors of a scenario's arm, with its errors. Time comes from the caller."""

    def __init__(self, known: PlantInput, period_ms: int) -> None:
        """Start at rest at home; the F/T sensor is read every `period_ms`."""
        self.joints = arm_of(known.robot).joints
        drawn = draw_errors(known.errors, known.seed, self.joints)
        self.period_ms = period_ms
        self._plant = DartPlant(known.robot, drawn=drawn.arm)
        streams = np.random.SeedSequence([known.seed, 0x4C4252]).spawn(4)
        joints, ft, self._load_rng, torque = (np.random.Generator(np.random.PCG64(stream)) for stream in streams)
        self._ft = FtSensor(drawn.force, ft, period_ms * 1e-3)
        self._joints = JointSensor(drawn.arm, joints, self._plant.q, self._plant.gravity_torque())
        self._torque_sensors = TorqueSensors(known.robot, drawn.torque, torque)
        self._link_torque: Array = self._plant.gravity_torque()
        """Mean torque on the links in the last cycle [N m]."""
        self._radius, self._links = known.robot.indenter_radius_m, link_names(known.robot)
        self.force_W, self.moment_W = np.zeros(3), np.zeros(3)
        self.measured: Array = self._joints.q.copy()
        self.measured_v: Array = np.zeros(self.joints)

    def measure(self) -> None:
        """Read the joint sensors."""
        self.measured, self.measured_v = self._joints.read()

    def advance(self, drive: Callable[[], tuple[Array, Array]]) -> None:
        """Advance by a cycle. `drive`, called every millisecond, returns torques [N m] and damping [N m s/rad] of the drives."""
        plant, total = self._plant, np.zeros(self.joints)
        for _ in range(self.period_ms):
            torque, damping = drive()
            plant.step(torque, self.force_W, self.moment_W, damping)
            self._joints.update(plant.q, plant.v, torque)
            total += torque - plant.friction
        self._link_torque = total / self.period_ms

    def brake(self) -> tuple[Array, Array]:
        """Return the drive of an arm that stands."""
        return self._plant.gravity_torque(), np.full(self.joints, BRAKE_NMS)

    def read_torques(self) -> Array:
        """Return a reading of the joint torque sensors, gravity included [N m], shape (n,)."""
        return self._torque_sensors.read(self._plant.q, self._plant.v, self._link_torque, self.period_ms)

    def touch(self, wrench: Any) -> None:
        """Take the tissue's wrench on the indenter."""
        f, m = wrench.wrench.force, wrench.wrench.torque
        self.force_W[:], self.moment_W[:] = (f.x, f.y, f.z), (m.x, m.y, m.z)

    def read_wrench(self) -> Array:
        """Return a reading of the F/T sensor, the tool's weight included, shape (6,)."""
        return np.array(self._ft.read(self._plant.sensor_wrench()))

    def wrench(self, now: int) -> Any:
        """Return the F/T reading as WrenchStamped."""
        return WrenchStamped(header(now, "ft_sensor"), wrench_message(self.read_wrench()))

    def tool(self, now: int) -> Any:
        """Return the exact palpation_msgs/ToolState."""
        return tool_message(header(now, "world"), self._plant.tool_motion().tolist(), self._radius)

    def links(self, now: int) -> Any:
        """Return the exact tf2_msgs/TFMessage of all links in world."""
        return frames_message(header(now, "world"), self._links, self._plant.link_poses())


class Metronome:
    """Due times and stamps of cycles. Time comes from the caller.

    A real arm does not catch up: a late cycle delays all that follow, and its own clock advances one period per cycle.
    """

    def __init__(self, period: int, now: int, wall: int, rate: float = 1.0) -> None:
        """Put the first cycle one `period` [ns] after `now` [ns] (steady clock) at time of day `wall` [ns].

        At a `rate` below 1 the arm's clock is slower.
        """
        self._period, self._pace = period, round(period / rate)
        self._due = now + self._pace
        self._stamp = wall

    def wait(self, now: int) -> int:
        """Return the time until the next cycle [ns], 0 when it is due."""
        return max(self._due - now, 0)

    def begin(self, now: int) -> int:
        """Begin a cycle; return its stamp [ns]."""
        if now - self._due > self._pace:
            self._due = now
        self._due += self._pace
        self._stamp += self._period
        return self._stamp


def serve(arm: EmulatedArm, node: RosNode, cycle: Callable[[int], None]) -> None:
    """Run cycles in wall-clock time, or at the rate of PALPATE_RATE, until a signal.

    `cycle` takes the stamp [ns], exchanges messages and advances the arm.
    """
    contacts = node.subscription(CONTACT_TOPIC, WRENCH)
    tools, links = node.publisher(TOOL_TOPIC, TOOL_STATE), node.publisher(LINKS_TOPIC, LINKS)
    gc.freeze()  # avoids garbage collections of 0.1 s
    metronome = Metronome(arm.period_ms * 1_000_000, monotonic_ns(), time_ns(), Settings.read().rate or 1.0)
    contact_at = cycles = 0
    with catch_signals() as stop, closing(node):
        while not stop.is_set():
            sleep(metronome.wait(monotonic_ns()) / 1e9)
            now = monotonic_ns()
            stamp = metronome.begin(now)
            contact = contacts.newest()
            if contact is not None:
                arm.touch(contact)
                contact_at = now
            elif now - contact_at > CONTACT_AGE_NS:
                arm.force_W[:] = arm.moment_W[:] = 0.0
            cycle(stamp)
            tools.publish(arm.tool(stamp))
            if cycles % (50 // arm.period_ms or 1) == 0:
                links.publish(arm.links(stamp))
            cycles += 1
