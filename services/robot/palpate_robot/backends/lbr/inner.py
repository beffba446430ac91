"""The fast loop in the driver's process: whatever service plays control, stepped on every state of the arm.

Between a joint state and the torque that answers it there is then no transport and no other process's timer.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from palpate_bus.implementations import create
from palpate_bus.messages.codec import Message
from palpate_bus.service import Inbox, Service
from palpate_models.scenario import Scenario


class _Inbox:
    """Control's inbox: joint states from this process, set-points from the bus."""

    def __init__(self) -> None:
        self.t = 0
        self.joints: Message | None = None
        self.outer: Inbox | None = None

    def _bus(self) -> Inbox:
        assert self.outer is not None
        return self.outer

    def latest(self, topic: str) -> Message | None:
        return self.joints if topic == "joint_states" else self._bus().latest(topic)

    def new(self, topic: str) -> Iterable[Message]:
        return [self.joints] if topic == "joint_states" else self._bus().new(topic)

    def stamp(self, topic: str) -> int | None:
        return self.t if topic == "joint_states" else self._bus().stamp(topic)

    def lost(self, role: str) -> bool:
        return self._bus().lost(role)


class _Kept:
    """Set-points that came between two states of the arm, so that none is passed over."""

    def __init__(self, outer: Inbox, setpoints: list[Message]) -> None:
        self._outer, self._setpoints = outer, setpoints

    def latest(self, topic: str) -> Message | None:
        return self._outer.latest(topic)

    def new(self, topic: str) -> Iterable[Message]:
        return self._setpoints if topic == "planning/setpoint" else self._outer.new(topic)

    def stamp(self, topic: str) -> int | None:
        return self._outer.stamp(topic)

    def lost(self, role: str) -> bool:
        return self._outer.lost(role)


class InnerLoop:
    """Steps a service of role control."""

    def __init__(self, control: Service) -> None:
        self._control = control
        self._inbox = _Inbox()
        self._setpoints: list[Message] = []

    def listen(self, inbox: Inbox) -> None:
        """Keeps the tick's set-points; call it on every tick."""
        self._setpoints.extend(inbox.new("planning/setpoint"))

    def command(self, t: int, inbox: Inbox, joints: Message) -> Any | None:
        """The torque command at `t` [ns] for these joint states."""
        self._inbox.t, self._inbox.joints = t, joints
        self._inbox.outer = _Kept(inbox, self._setpoints)
        command = self._control.step(t, self._inbox)["control/joint_torque"]
        self._setpoints = []
        return command


def load_control(scenario: Scenario) -> Service:
    """The control service that the scenario chooses. Raises ChoiceError when there is none."""
    return create("control", scenario.services.control, scenario)
