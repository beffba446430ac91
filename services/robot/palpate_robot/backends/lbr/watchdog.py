"""The dead man's switch beside the stack: takes over when the driver's commands stop.

    python -m palpate_robot.backends.lbr.watchdog                     # on the robot's computer, before the driver

lbr_fri_ros2_stack applies the last torque for ever (its torque controller has no time-out): a driver that dies in contact would
leave its last push on the patient. This process hears state and commands; when commands stop while the session commands, it sends
damping and no torque, until another driver appears. The old driver, should it wake, hears that and holds. Driver and watchdog
share how messages are read, and nothing of what decides.
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
from palpate_models.scenario.schema import LbrConnection
from palpate_robot.backends.lbr.arm import STATE_AGE_NS, Arm
from palpate_robot.backends.lbr.port import STATE, TORQUE_COMMAND, LBRTorqueCommand, SessionState

log = logging.getLogger("watchdog")

TIMEOUT_NS: Final = contract().topics["control/joint_torque"].expiry
"""Without a command for so long [ns] the watchdog takes over."""
DAMPING: Final = np.full(7, 8.0)
"""[N m s/rad], below the arm's own friction: stable with any delay."""
PERIOD_S: Final = 0.002


class Watchdog:
    """Decides; time comes from outside [ns]."""

    def __init__(self, timeout: int = TIMEOUT_NS) -> None:
        self._timeout = timeout
        self._arm = Arm()
        self._commander = b""
        self._commanded: int | None = None
        self.holding = False
        """Whether it has taken over."""

    def state(self, t: int, state: Any) -> None:
        """An LBRState came. Whoever commanded before this process began may be dead already, so the time runs from then."""
        self._arm.update(t, state)
        if self._commanded is None and self._arm.session is SessionState.COMMANDING_ACTIVE:
            self._commanded = t

    def command(self, t: int, sender: bytes) -> None:
        """A command of a driver came. A new driver ends the hold; the old one, come back to life, does not."""
        if sender == self._commander and self.holding:
            return
        self._commander, self._commanded, self.holding = sender, t, False

    def decide(self, t: int) -> tuple[Array, Array] | None:
        """Joint positions [rad] and torque [N m] to send, shapes (7,); None while the driver lives or nothing is commanded."""
        if self._arm.session is not SessionState.COMMANDING_ACTIVE or self._commanded is None:
            return None
        if t - self._commanded > self._timeout:
            self.holding = True
        if not self.holding:
            return None
        known = self._arm.heard is not None and t - self._arm.heard <= STATE_AGE_NS  # an old speed is a constant push
        return self._arm.q, -DAMPING * self._arm.v if known else np.zeros(7)


def main() -> int:
    """Watches until a signal; returns the exit status."""
    parser = argparse.ArgumentParser(description="Damps the arm when its driver falls silent.")
    parser.add_argument("--router", default=LbrConnection().router, help="zenoh endpoint of the ROS side")
    parser.add_argument("--domain", type=int, default=0, help="its ROS domain")
    parser.add_argument("--namespace", default=LbrConnection().namespace, help="the stack's robot_name")
    words = parser.parse_args()
    logging.basicConfig(level="INFO", format="%(asctime)s watchdog %(levelname)s %(message)s", stream=sys.stderr)
    running = [True]

    def stop(number: int, frame: FrameType | None) -> None:
        running[0] = False

    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    node = RosNode("palpate_lbr_watchdog", words.domain, BusOptions(router=words.router))
    states = node.subscription(f"{words.namespace}/state", STATE)
    commands = node.subscription(f"{words.namespace}/command/torque", TORQUE_COMMAND)
    publisher = node.publisher(f"{words.namespace}/command/torque", TORQUE_COMMAND)
    watchdog = Watchdog()
    said = False
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
            if watchdog.holding is not said:
                said = watchdog.holding
                log.warning("the driver is silent: damping, no torque" if said else "a driver has taken over")
            sleep(PERIOD_S)
    finally:
        node.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
