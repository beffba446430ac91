"""The watchdog of an arm behind ros2_control that takes torques or set-points: its controller follows the last ones for ever.

python -m palpate_robot.backends.ros2_control.watchdog my_arm.yaml     # on the robot's computer, before the driver
"""

import argparse
import sys
from collections.abc import Callable
from typing import Any

from palpate_bus.wire.ros_node import RosNode
from palpate_bus.wire.zenoh_config import BusOptions
from palpate_errors import UserError
from palpate_models.numerics.frames import Array
from palpate_models.robot.arm import arm_of
from palpate_models.scenario.load import exam_input, load_scenario
from palpate_models.scenario.schema import CommandLevel, Robot
from palpate_robot.backends.ros2_control.port import ARRAY, POSE, STATE, FlangePose, MeasuredJoints, array_message, pose_command
from palpate_robot.backends.ros2_control.profile import profile_of
from palpate_robot.backends.watchdog import Watchdog, watch

DAMPING_SHARE = 0.05
"""Share of the simulated driver's damping in a hold (assumed): it acts later than that of the driver."""


def main() -> int:
    """Run until a signal; return the exit status."""
    parser = argparse.ArgumentParser(description="Damps the arm when the driver's commands stop.")
    parser.add_argument("scenario", help="the scenario of the run: arm and profile")
    parser.add_argument("--set", action="append", default=[], metavar="FIELD=VALUE", help="change the scenario")
    given = parser.parse_args()
    try:
        robot = exam_input(load_scenario(given.scenario, given.set)).robot
        if robot.level is CommandLevel.POSITION:
            raise UserError(f"robot.level: {robot.level}: expected torque or setpoint; an arm that takes positions stays")
        profile, arm = profile_of(robot), arm_of(robot)
        node = RosNode("palpate_watchdog", robot.driver.domain, BusOptions(router=robot.driver.router))
    except UserError as error:
        print(f"watchdog: {error}", file=sys.stderr)
        return 2
    measured = MeasuredJoints(arm, effort_is_torque=profile.effort_is_torque)
    kind, message = command_of(robot)
    state, command = (profile.topic(profile.joint_states), STATE), (profile.commands(robot.level), kind)
    watch(Watchdog(measured, DAMPING_SHARE * arm.hold_damping_nms), node, state, command, message)
    return 0


def command_of(robot: Robot) -> tuple[str, Callable[[Array, Array], Any]]:
    """Return type and maker of commands, from positions and torque, shapes (n,): the torque, or the pose, which does not pull."""
    if robot.level is CommandLevel.TORQUE:
        return ARRAY, lambda q, torque: array_message(torque)
    flange, base = FlangePose(robot), next(iter(arm_of(robot).link_names))
    return POSE, lambda q, torque: pose_command(flange.at(q), base)


if __name__ == "__main__":
    sys.exit(main())
