"""Dead man's switch next to the stack: takes over when the driver's commands stop.

    python -m palpate_robot.backends.lbr.watchdog                     # on the robot's computer, before the driver

lbr_fri_ros2_stack applies the last torque for ever (its torque controller has no time-out): a driver that dies in contact would
leave its last push on the patient. This process receives state and commands. When commands stop while the session is active, it
sends damping without torque until another driver appears. If the old driver resumes, it sees these commands and holds. Driver and
watchdog share message parsing, but no decision logic.
"""

from __future__ import annotations

import argparse
import logging
import signal
import sys
from time import monotonic_ns, sleep
from types import FrameType
from typing import Any, Final

import numpy as np

from palpate_bus.contract import contract
from palpate_bus.wire.ros_node import RosNode
from palpate_bus.wire.zenoh_config import BusOptions
from palpate_models.numerics.frames import Array
from palpate_models.scenario.schema import RobotDriver
from palpate_robot.backends.lbr.arm import STATE_AGE_NS, MeasuredArm
from palpate_robot.backends.lbr.port import NAMESPACE, STATE, TORQUE_COMMAND, LBRTorqueCommand, SessionState

log = logging.getLogger("watchdog")

TIMEOUT_NS: Final = contract().topics["control/joint_torque"].expiry
"""Time without a command after which the watchdog takes over [ns]."""
DAMPING: Final = np.full(7, 8.0)
"""[N m s/rad], below the arm's own friction: stable with any delay."""
PERIOD_S: Final = 0.002


class Watchdog:
    """Decides when to take over. Time comes from the caller [ns]."""

    def __init__(self, timeout: int = TIMEOUT_NS) -> None:
        self._timeout = timeout
        self._arm = MeasuredArm()
        self._commander = b""
        self._commanded: int | None = None
        self.holding = False

    def state(self, t: int, state: Any) -> None:
        """Take an LBRState. A driver from before this process started may be dead, so the time-out starts with the first
        state.
        """
        self._arm.update(t, state)
        if self._commanded is None and self._arm.session is SessionState.COMMANDING_ACTIVE:
            self._commanded = t

    def command(self, t: int, sender: bytes) -> None:
        """Take a command of a driver. A new driver ends the hold; the old one does not."""
        if sender == self._commander and self.holding:
            return
        self._commander, self._commanded, self.holding = sender, t, False

    def decide(self, t: int) -> tuple[Array, Array] | None:
        """Return joint positions [rad] and torque [N m] to send, shapes (7,); None while the driver is alive or absent."""
        if self._arm.session is not SessionState.COMMANDING_ACTIVE or self._commanded is None:
            return None
        if t - self._commanded > self._timeout:
            self.holding = True
        if not self.holding:
            return None
        fresh = self._arm.received is not None and t - self._arm.received <= STATE_AGE_NS  # an old speed is a constant push
        return self._arm.q, -DAMPING * self._arm.v if fresh else np.zeros(7)


def main() -> int:
    """Run until a signal; return the exit status."""
    parser = argparse.ArgumentParser(description="Damps the arm when the driver's commands stop.")
    parser.add_argument("--router", default=RobotDriver().router, help="zenoh endpoint of the ROS side")
    parser.add_argument("--domain", type=int, default=0, help="its ROS domain")
    parser.add_argument("--namespace", default=NAMESPACE, help="the stack's robot_name")
    given = parser.parse_args()
    logging.basicConfig(level="INFO", format="%(asctime)s watchdog %(levelname)s %(message)s", stream=sys.stderr)
    running = [True]

    def stop(number: int, frame: FrameType | None) -> None:
        running[0] = False

    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    node = RosNode("palpate_lbr_watchdog", given.domain, BusOptions(router=given.router))
    states = node.subscription(f"{given.namespace}/state", STATE)
    commands = node.subscription(f"{given.namespace}/command/torque", TORQUE_COMMAND)
    publisher = node.publisher(f"{given.namespace}/command/torque", TORQUE_COMMAND)
    watchdog = Watchdog()
    reported = False
    try:
        while running[0]:
            now = monotonic_ns()
            for state in states.take():
                watchdog.state(now, state)
            for sender in commands.others(publisher.gid):
                watchdog.command(now, sender)
            answer = watchdog.decide(now)
            if answer is not None:
                publisher.publish(LBRTorqueCommand(*answer))
            if watchdog.holding is not reported:
                reported = watchdog.holding
                log.warning("driver commands stopped: damping, no torque" if reported else "a driver has taken over")
            sleep(PERIOD_S)
    finally:
        node.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
