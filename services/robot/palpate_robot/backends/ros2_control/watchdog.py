"""The watchdog of an arm that takes torques behind ros2_control: forward_command_controller applies the last ones for ever.

python -m palpate_robot.backends.ros2_control.watchdog my_arm.yaml     # on the robot's computer, before the driver
"""

import argparse
import sys

from palpate_bus.wire.ros_node import RosNode
from palpate_bus.wire.zenoh_config import BusOptions
from palpate_errors import UserError
from palpate_models.robot.arm import arm_of
from palpate_models.scenario.arm_file import CommandLevel
from palpate_models.scenario.load import exam_input, load_scenario
from palpate_robot.backends.ros2_control.joints import MeasuredJoints
from palpate_robot.backends.ros2_control.port import ARRAY, STATE, array_message
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
        if robot.level is not CommandLevel.TORQUE:
            raise UserError(f"robot.level: {robot.level}: only an arm that takes torques has a watchdog; others stay")
        profile, arm = profile_of(robot), arm_of(robot)
        node = RosNode("palpate_watchdog", robot.driver.domain, BusOptions(router=robot.driver.router))
    except UserError as error:
        print(f"watchdog: {error}", file=sys.stderr)
        return 2
    measured = MeasuredJoints(arm, effort_is_torque=profile.effort_is_torque)
    state, command = (profile.topic(profile.joint_states), STATE), (profile.commands(robot.level), ARRAY)
    watch(Watchdog(measured, DAMPING_SHARE * arm.hold_damping_nms), node, state, command, lambda q, torque: array_message(torque))
    return 0


if __name__ == "__main__":
    sys.exit(main())
