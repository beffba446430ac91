"""The watchdog of an LBR: lbr_fri_ros2_stack applies the last torque for ever, as its torque controller has no time-out.

python -m palpate_robot.backends.lbr.watchdog                     # on the robot's computer, before the driver
"""

import argparse
import sys
from typing import Final

import numpy as np

from palpate_bus.wire.ros_node import RosNode
from palpate_bus.wire.zenoh_config import BusOptions
from palpate_models.scenario.schema import RobotDriver
from palpate_robot.backends.lbr.port import NAMESPACE, STATE, TORQUE_COMMAND, LBRTorqueCommand, MeasuredLbr
from palpate_robot.backends.watchdog import Watchdog, watch

DAMPING: Final = np.full(7, 8.0)
"""[N m s/rad], below the arm's own friction: stable with any delay."""


def lbr_watchdog() -> Watchdog:
    """Return the watchdog of an LBR."""
    return Watchdog(MeasuredLbr(), DAMPING)


def main() -> int:
    """Run until a signal; return the exit status."""
    parser = argparse.ArgumentParser(description="Damps the arm when the driver's commands stop.")
    parser.add_argument("--router", default=RobotDriver().router, help="zenoh endpoint of the ROS side")
    parser.add_argument("--domain", type=int, default=0, help="its ROS domain")
    parser.add_argument("--namespace", default=NAMESPACE, help="the stack's robot_name")
    given = parser.parse_args()
    node = RosNode("palpate_lbr_watchdog", given.domain, BusOptions(router=given.router))
    name = given.namespace
    watch(lbr_watchdog(), node, (f"{name}/state", STATE), (f"{name}/command/torque", TORQUE_COMMAND), LBRTorqueCommand)
    return 0


if __name__ == "__main__":
    sys.exit(main())
