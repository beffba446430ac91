"""Stop and release requests of operator and supervisor, applied to a driver."""

from typing import Final

from palpate_bus.messages import OperatorRequest, SupervisorState
from palpate_bus.service import Inbox
from palpate_robot.driver import Driver, HoldCause

REQUESTS: Final = (OperatorRequest.STOP, OperatorRequest.RELEASE, OperatorRequest.END, OperatorRequest.SOFT_STOP)


class StopRequests:
    """Applies requests of operator and supervisor to a driver, simulated or real."""

    def __init__(self, driver: Driver) -> None:
        self._driver = driver
        self._releases = 0  # granted by the supervisor

    def apply(self, t: int, inbox: Inbox) -> None:
        """Releases, then holds, at `t` [ns]: a release never undoes a stop of the same tick."""
        for message in inbox.new("supervisor/state"):
            if message.releases > self._releases:
                self._driver.release(t)
            self._releases = message.releases
            if message.level == SupervisorState.LEVEL_EMERGENCY:
                reason = f"emergency stop of the supervisor: {message.reason}"
                self._driver.hold(t, HoldCause.STOP_REQUESTED, reason, message.culprit)
        for message in inbox.new("operator/request"):
            if message.request == OperatorRequest.STOP:
                self._driver.hold(t, HoldCause.STOP_REQUESTED, f"stopped by the operator: {message.reason}")
            elif message.request not in REQUESTS:
                reason = f"operator/request: unknown request {message.request} is treated as a stop"
                self._driver.hold(t, HoldCause.STOP_REQUESTED, reason, "operator/request")
