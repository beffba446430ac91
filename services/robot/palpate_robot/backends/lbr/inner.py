"""The fast loop in the driver's process: whatever service plays control, stepped on every state of the arm.

Between a joint state and the torque that answers it there is then no transport and no other process's timer.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

from palpate_bus.implementations import create
from palpate_bus.messages.codec import Message
from palpate_bus.service import Inbox, Service
from palpate_models.scenario.schema import Scenario

JOINTS: Final = "joint_states"
SETPOINT: Final = "planning/setpoint"


class _Inbox:
    """Control's inbox: joint states of `t` [ns] from here, the set-points since the state before, all else from the bus."""

    def __init__(self, t: int, joints: Message, setpoints: list[Message], bus: Inbox) -> None:
        self._t, self._joints, self._bus = t, joints, bus
        self._new = {JOINTS: [joints], SETPOINT: setpoints}

    def latest(self, topic: str) -> Message | None:
        return self._joints if topic == JOINTS else self._bus.latest(topic)

    def new(self, topic: str) -> Iterable[Message]:
        return self._new[topic] if topic in self._new else self._bus.new(topic)

    def stamp(self, topic: str) -> int | None:
        return self._t if topic == JOINTS else self._bus.stamp(topic)

    def lost(self, role: str) -> bool:
        return self._bus.lost(role)


class InnerLoop:
    """Steps a service of role control."""

    def __init__(self, control: Service) -> None:
        self._control = control
        self._setpoints: list[Message] = []

    def listen(self, inbox: Inbox) -> None:
        """Keeps the tick's set-points; call it on every tick."""
        self._setpoints.extend(inbox.new(SETPOINT))

    def command(self, t: int, inbox: Inbox, joints: Message) -> Any | None:
        """The torque command at `t` [ns] for these joint states."""
        setpoints, self._setpoints = self._setpoints, []
        return self._control.step(t, _Inbox(t, joints, setpoints, inbox))["control/joint_torque"]


def load_control(scenario: Scenario) -> Service:
    """The control service that the scenario chooses. Raises ChoiceError when there is none."""
    return create("control", scenario.services.control, scenario)
