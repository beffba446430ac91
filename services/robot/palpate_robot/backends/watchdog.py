"""Dead man's switch next to a torque controller that applies the last torque for ever: it takes over when commands stop.

A driver that dies in contact would leave its last push on the patient. This process receives state and commands. When commands
stop while the arm accepts them, it sends damping without torque until another driver appears. If the old driver resumes, it sees
these commands and holds. Driver and watchdog share message parsing, but no decision logic.
"""

import logging
import sys
from collections.abc import Callable
from contextlib import closing
from time import monotonic_ns, sleep
from typing import Any, Final

import numpy as np

from palpate_bus.contract import contract
from palpate_bus.wire.ros_node import RosNode
from palpate_bus.wire.zenoh_config import catch_signals
from palpate_models.numerics.frames import Array
from palpate_robot.backends.hardware import STATE_AGE_NS, MeasuredArm

log = logging.getLogger("watchdog")

TIMEOUT_NS: Final = contract().topics["control/joint_torque"].expiry
"""Time without a command after which the watchdog takes over [ns]."""
PERIOD_S: Final = 0.002


class Watchdog:
    """Decides when to take over. Time comes from the caller [ns]."""

    def __init__(self, arm: MeasuredArm, damping: Array) -> None:
        """`arm` measures the state; `damping` [N m s/rad], shape (n,), acts late, so it is below the arm's own friction."""
        self._arm, self._damping = arm, damping
        self._commander = b""
        self._commanded: int | None = None
        self.holding = False

    def state(self, t: int, state: Any) -> None:
        """Take a state of the arm. A driver from before this process started may be dead, so the time-out starts with the first
        state.
        """
        self._arm.update(t, state)
        if self._commanded is None and self._arm.accepts:
            self._commanded = t

    def command(self, t: int, sender: bytes) -> None:
        """Take a command of a driver. A new driver ends the hold; the old one does not."""
        if sender == self._commander and self.holding:
            return
        self._commander, self._commanded, self.holding = sender, t, False

    def decide(self, t: int) -> tuple[Array, Array] | None:
        """Return joint positions [rad] and torque [N m] to send, shapes (n,); None while the driver is alive or absent."""
        if not self._arm.accepts or self._commanded is None:
            return None
        if t - self._commanded > TIMEOUT_NS:
            self.holding = True
        if not self.holding:
            return None
        fresh = self._arm.received is not None and t - self._arm.received <= STATE_AGE_NS  # an old speed is a constant push
        return self._arm.q, -self._damping * self._arm.v if fresh else np.zeros_like(self._damping)


def watch(
    watchdog: Watchdog, node: RosNode, state: tuple[str, str], command: tuple[str, str], message: Callable[[Array, Array], Any]
) -> None:
    """Run until a signal; `state` and `command` are topics with their types, `message` makes a command of the latter."""
    logging.basicConfig(level="INFO", format="%(asctime)s watchdog %(levelname)s %(message)s", stream=sys.stderr)
    states, commands, publisher = node.subscription(*state), node.subscription(*command), node.publisher(*command)
    reported = False
    with catch_signals() as stop, closing(node):
        while not stop.is_set():
            now = monotonic_ns()
            for received in states.take():
                watchdog.state(now, received)
            for sender in commands.others(publisher.gid):
                watchdog.command(now, sender)
            answer = watchdog.decide(now)
            if answer is not None:
                publisher.publish(message(*answer))
            if watchdog.holding is not reported:
                reported = watchdog.holding
                log.warning("driver commands stopped: damping, no torque" if reported else "a driver has taken over")
            sleep(PERIOD_S)
