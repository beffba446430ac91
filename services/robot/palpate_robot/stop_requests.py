"""What stops a driver from outside, and what releases it: the operator's word and the supervisor's."""

from __future__ import annotations

from typing import Final

from palpate_bus.messages import OperatorRequest, SupervisorState
from palpate_bus.service import Inbox
from palpate_robot.driver import Driver, HoldCause

REQUESTS: Final = (OperatorRequest.STOP, OperatorRequest.RELEASE, OperatorRequest.END, OperatorRequest.SOFT_STOP)


class StopRequests:
    """Carries out on a driver what operator and supervisor ask for, whatever arm is behind it."""

    def __init__(self, driver: Driver) -> None:
        self._driver = driver
        self._releases = 0
        """Releases that the supervisor has granted so far."""

    def obey(self, t: int, inbox: Inbox) -> None:
        """Holds or releases at `t` [ns]. A hold comes last: a release never undoes a stop of the same tick."""
        for message in inbox.new("supervisor/state"):
            if message.releases > self._releases:
                self._driver.release(t)
            self._releases = message.releases
            if message.level == SupervisorState.LEVEL_EMERGENCY:
                self._driver.hold(t, HoldCause.STOP_REQUESTED, f"emergency stop of the supervisor: {message.reason}")
        for message in inbox.new("operator/request"):
            if message.request == OperatorRequest.STOP:
                self._driver.hold(t, HoldCause.STOP_REQUESTED, f"an operator asked to stop: {message.reason}")
            elif message.request not in REQUESTS:
                words = f"operator/request: request = {message.request} is unknown, which counts as a stop"
                self._driver.hold(t, HoldCause.STOP_REQUESTED, words)
