"""Inputs of a driver: the commands of control, and stop and release requests of operator and supervisor."""

from typing import Final

import numpy as np

from palpate_bus.messages import Message, OperatorRequest, SupervisorState, nanoseconds
from palpate_bus.messages.codes import HoldCause
from palpate_bus.service import Inbox
from palpate_robot.driver import Command, Driver

REQUESTS: Final = (OperatorRequest.STOP, OperatorRequest.RELEASE, OperatorRequest.END, OperatorRequest.SOFT_STOP)


class ReceivedCommands:
    """Commands of control from messages."""

    def __init__(self, *, positions: bool) -> None:
        """`positions`: commands are joint positions, else torques."""
        self._positions = positions
        self._message: Message | None = None
        self._command: Command | None = None

    def newest(self, message: Message | None) -> Command | None:
        """Return the command in the newest `JointTorqueCommand`, the same object for the same message; None before the first."""
        if message is not None and message is not self._message:
            stamp = nanoseconds(message.header.stamp)
            expires = stamp + nanoseconds(message.valid_for)
            values = message.position if self._positions else message.torque
            self._message = message
            self._command = Command(np.array(values), stamp, expires, message.problem, message.culprit)
        return self._command


class StopRequests:
    """Applies requests of operator and supervisor to a driver, simulated or real."""

    def __init__(self, driver: Driver) -> None:
        self._driver = driver
        self._releases = 0  # granted by the supervisor

    def apply(self, t: int, inbox: Inbox) -> None:
        """Releases, then holds, at `t` [ns]: a release undoes neither a stop of the same tick nor one after it was granted."""
        for message in inbox.new("supervisor/state"):
            held_at = self._driver.holds[-1][0] if self._driver.holds else 0
            if message.releases > self._releases and nanoseconds(message.header.stamp) >= held_at:
                self._driver.release(t)
            self._releases = message.releases
            if message.level == SupervisorState.LEVEL_EMERGENCY:
                reason = f"emergency stop of the supervisor: {message.reason}"
                self._driver.hold(t, HoldCause.SUPERVISOR, reason, message.culprit)
        for message in inbox.new("operator/request"):
            if message.request == OperatorRequest.STOP:
                self._driver.hold(t, HoldCause.STOP_REQUESTED, f"stopped by the operator: {message.reason}")
            elif message.request not in REQUESTS:
                reason = f"operator/request: unknown request {message.request} is treated as a stop"
                self._driver.hold(t, HoldCause.STOP_REQUESTED, reason, "operator/request")
