"""What a service is: a step function between an inbox and an outbox.

    class Control(Service):
        role = "control"

        def step(self, t: int, inbox: Inbox) -> Outbox:
            joints = inbox.latest("joint_states")
            ...
            return {"control/joint_torque": command}

A service never touches a socket, a thread or a wall clock. The contract says which topics it reads and writes and when it steps.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, ClassVar, Protocol

from palpate_bus.messages.codec import Message

Outbox = Mapping[str, "Message | list[Message]"]
"""Messages by topic: one, or a list for an event topic. They must not be changed after the step: readers in the same
process may get them as they are."""


class Inbox(Protocol):
    """What a service receives at a step, ordered by (stamp, topic, sequence). Messages are decoded when first looked at."""

    def latest(self, topic: str) -> Message | None:
        """The newest message so far, of this step or of an earlier one; None before the first."""

    def new(self, topic: str) -> Iterable[Message]:
        """The messages that arrived since the step before, oldest first."""

    def stamp(self, topic: str) -> int | None:
        """The time [ns] of `latest(topic)`: of the producer's tick in lockstep, of reception in wall-clock mode."""

    def lost(self, role: str) -> bool:
        """Whether that role's service is known to be gone (its liveliness token vanished)."""


class Service(ABC):
    """Base of every service. `role` names its row in the contract."""

    role: ClassVar[str]
    catches_up: ClassVar[bool] = True
    """Whether its physics has to keep time: in wall-clock mode a critical service that is late then steps every tick that it
    missed. A driver of real hardware says False: the arm has moved on by itself, and what was due a while ago is past."""

    def start(self) -> Outbox:
        """Messages to send before the first tick: the latched ones. Called once."""
        return {}

    @abstractmethod
    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Advances to time `t` [ns] and returns what is to be sent.

        A periodic topic of this role needs a message at each of its ticks (t a multiple of the topic's period).
        Nothing here may depend on wall time, thread timing or an unseeded generator.
        """

    def parts(self, t: int, inbox: Inbox) -> Iterator[Outbox]:
        """The step in parts, each sent before the next is computed; the runtimes call this.

        By default one part, `step`'s. A service on the 1 kHz path yields first what others wait for, then the rest.
        """
        yield self.step(t, inbox)

    def finish(self) -> Mapping[str, Any]:
        """Called once at the end; returns JSON-able facts for the report. Write files and close them here."""
        return {}
