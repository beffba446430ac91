"""Emulates an arm behind ros2_control on the ROS graph: a Franka with franka_ros2 or a UR with ur_robot_driver.

    python -m palpate_robot.backends.ros2_control.emulator scenario.yaml --listen tcp/127.0.0.1:7447

`rules.py` lists the rules that it keeps, each with its source. The scenario names the arm (`robot.arm`) and the profile
(`robot.driver.profile`), whose topics and conventions it has. `ft_sign`, `ft_weight` and `ft_yaw_deg` of `robot.driver` are the
driver's view alone; its names of topics count here too.
"""

import argparse
import logging
import sys
from itertools import count
from typing import Any

import numpy as np

from palpate_bus.messages import MS, NS, JointState, codec, header
from palpate_bus.wire.ros_node import RosNode
from palpate_bus.wire.zenoh_config import BusOptions
from palpate_errors import UserError
from palpate_models.numerics.frames import Array
from palpate_models.robot.arm import arm_of
from palpate_models.scenario.load import load_scenario, plant_input
from palpate_models.scenario.schema import CommandLevel, PlantInput
from palpate_robot.backends.arm_port import WRENCH
from palpate_robot.backends.emulated import EmulatedArm, serve
from palpate_robot.backends.hardware import GravityModel, tool_load
from palpate_robot.backends.ros2_control.port import ARRAY, BOOL, FLOAT, STATE, Ros2Port, StackStatus
from palpate_robot.backends.ros2_control.profile import Profile, profile_of
from palpate_robot.backends.ros2_control.rules import RULES, Rules, Sensed
from palpate_robot.position_loop import PositionLoop

log = logging.getLogger("emulator")


class Ros2Emulator(EmulatedArm):
    """Physics and rules; call `cycle` once per period. Time comes from the caller."""

    def __init__(self, known: PlantInput, profile: Profile) -> None:
        """Create the arm of a scenario. Raises UserError."""
        if profile.stack is None:
            raise UserError("robot.driver.profile: the emulator needs a profile with a stack")
        arm = arm_of(known.robot)
        self.rules = RULES[profile.stack](arm)
        if known.robot.level is not self.rules.commands:
            raise UserError(f"robot.level: {known.robot.level}: the emulator of {profile.stack} takes {self.rules.commands}")
        super().__init__(known, self.rules.period_ms)
        given = known.robot.driver.model_copy(update={"ft_sign": None, "ft_weight": None})
        self.profile = profile_of(known.robot.model_copy(update={"driver": given}))
        self.command: Array | None = None
        """Newest values of the controller, shape (n,); None before the first."""
        self._names, self._mass_kg = sorted(arm.joint_names), known.robot.tool_mass_kg
        self._order = [arm.joint_names.index(name) for name in self._names]
        self._model = GravityModel(known.robot)
        self._loop = PositionLoop(arm, self._joints.q) if self.rules.commands is CommandLevel.POSITION else None
        self._events = sorted(_split_time(text, self.rules) for text in known.robot.driver.events)
        self._begun: int | None = None

    def cycle(self, now: int) -> None:
        """Advance by one period under the newest command, at `now` [ns]."""
        self._begun = now if self._begun is None else self._begun
        while self._events and self._events[0][0] <= (now - self._begun) / NS:
            self.rules.event(self._events.pop(0)[1])
        self.measure()
        plant, loop, stopped = self._plant, self._loop, self.rules.stopped
        torque = self._model.external_torque(plant.q, np.concatenate((self.force_W, self.moment_W)))
        sensed = Sensed(self.measured, self.measured_v, float(np.linalg.norm(self.force_W)), torque)
        values = self.rules.cycle(sensed, self.command)
        if self.rules.stopped != stopped:
            log.error("the arm stops: %s", self.rules.stopped or "recovered")
            self.command = None

        ages = count(0, MS)

        def drive() -> tuple[Array, Array]:
            gravity = plant.gravity_torque()
            if loop is not None:
                return gravity + loop.torque(values, self._joints.q, self._joints.v, gravity, next(ages)), loop.damping
            return self.brake() if values is None else (gravity + values, np.zeros(self.joints))

        self.advance(drive)

    def state(self, now: int) -> Any:
        """Return sensor_msgs/JointState at `now` [ns], its joints in alphabetical order."""
        values = self.measured, self.measured_v, self.read_torques()
        return JointState(header(now), self._names, *(array[self._order] for array in values))

    def read_wrench(self) -> Array:
        """Return a reading of the F/T sensor with sign and weight as the stack has them, shape (6,)."""
        reading = super().read_wrench()
        if not self.profile.ft_weight:
            reading = reading - tool_load(self._mass_kg, self._model.at(self.measured).up_S)
        return self.profile.ft_sign * reading

    def status(self) -> StackStatus:
        """Return the status that the stack reports."""
        return StackStatus(self.rules.settings.get("speed"), self.rules.program)


class EmulatedPort(Ros2Port):
    """An emulator in this process; `states` is called once a millisecond and cycles it when its period has passed."""

    def __init__(self, known: PlantInput, profile: Profile) -> None:
        """Create the emulator. Raises UserError."""
        self.emulator = Ros2Emulator(known, profile)
        self._t = -MS
        self._fresh = False

    def states(self) -> list[Any]:
        """See `ArmPort.states`."""
        self._t += MS
        self._fresh = not (self._t // MS) % self.emulator.period_ms
        if not self._fresh:
            return []
        self.emulator.cycle(self._t)
        return [self.emulator.state(self._t)] if self.emulator.rules.publishes else []

    def wrenches(self) -> list[Any]:
        """See `ArmPort.wrenches`."""
        return [self.emulator.wrench(self._t)] if self._fresh else []

    def command(self, q: Array, values: Array) -> None:
        """See `ArmPort.command`."""
        self.emulator.command = values

    def contact(self, wrench: Any) -> None:
        """See `ArmPort.contact`."""
        self.emulator.touch(wrench)

    def physics(self) -> tuple[Any | None, Any | None]:
        """See `ArmPort.physics`."""
        return (self.emulator.tool(self._t), self.emulator.links(self._t)) if self._fresh else (None, None)

    def status(self) -> StackStatus:
        """See `Ros2Port.status`."""
        return self.emulator.status()

    def close(self) -> None:
        """See `ArmPort.close`: there is nothing to disconnect."""


def _split_time(text: str, rules: Rules) -> tuple[float, str]:
    time, _, event = text.partition(" ")
    rules.setting(event)
    try:
        return float(time), event
    except ValueError:
        raise UserError(f"robot.driver.events: {text!r}: expected a time [s] first, such as '12.5 speed 0.5'") from None


def serve_graph(emulator: Ros2Emulator, node: RosNode, level: CommandLevel) -> None:
    """Run in wall-clock time until a signal."""
    profile = emulator.profile
    states = node.publisher(profile.topic(profile.joint_states), STATE)
    wrenches = node.publisher(profile.topic(profile.ft_topic), WRENCH)
    commands = node.subscription(profile.commands(level), ARRAY)
    speed, running = profile.speed_scaling, profile.program_running
    speeds = None if speed is None else node.publisher(profile.topic(speed), FLOAT)
    programs = None if running is None else node.publisher(profile.topic(running), BOOL, latched=True)
    reported: StackStatus | None = None

    def cycle(stamp: int) -> None:
        nonlocal reported
        command = commands.newest()
        if command is not None:
            emulator.command = np.array(command.data)
        emulator.cycle(stamp)
        if emulator.rules.publishes:
            states.publish(emulator.state(stamp))
        wrenches.publish(emulator.wrench(stamp))
        status = emulator.status()
        if status != reported:
            reported = status
            if speeds is not None and status.speed is not None:
                speeds.publish(codec.message_type(FLOAT)(100 * status.speed))
            if programs is not None and status.running is not None:
                programs.publish(codec.message_type(BOOL)(status.running))

    serve(emulator, node, cycle)


def main(arguments: list[str] | None = None) -> int:
    """Run the emulator until a signal; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m palpate_robot.backends.ros2_control.emulator", description=__doc__.partition("\n")[0]
    )
    parser.add_argument("scenario", nargs="?", default="clean", help="arm, its placement and tool, and profile")
    parser.add_argument("--set", action="append", default=[], metavar="FIELD=VALUE", help="change the scenario")
    parser.add_argument("--listen", default="tcp/127.0.0.1:7447", help="zenoh endpoint that replaces rmw_zenohd")
    given = parser.parse_args(arguments)
    logging.basicConfig(level="INFO", format="%(asctime)s emulator %(levelname)s %(message)s", stream=sys.stderr)
    try:
        known = plant_input(load_scenario(given.scenario, given.set))
        profile = profile_of(known.robot)
        emulator = Ros2Emulator(known, profile)
        node = RosNode("palpate_emulator", known.robot.driver.domain, BusOptions(listen=(given.listen,)))
        log.info("%s with the rules of %s at %s, every %d ms", known.robot.arm, profile.stack, given.listen, emulator.period_ms)
        serve_graph(emulator, node, known.robot.level)
    except UserError as error:
        print(f"emulator: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
