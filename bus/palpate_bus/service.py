"""Interface of a service: a step function from an inbox to an outbox.

    class Control(Service):
        role = "control"

        def step(self, t: int, inbox: Inbox) -> Outbox:
            joints = inbox.latest("joint_states")
            ...
            return {"control/joint_torque": command}

A service uses no socket, thread or wall clock. The contract defines the topics it reads and writes and its period.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, ClassVar, Protocol

from palpate_bus.messages import Message

Outbox = Mapping[str, "Message | list[Message]"]
"""Messages by topic: one, or a list for an event topic. They must not be changed after the step, since readers in the same
process may share them."""


class Inbox(Protocol):
    """Input of a step, ordered by (stamp, topic, sequence). Messages are decoded at first access."""

    def latest(self, topic: str) -> Message | None:
        """Return the newest message, of this step or of an earlier one; None before the first."""

    def new(self, topic: str) -> Iterable[Message]:
        """Return the messages since the step before, oldest first."""

    def stamp(self, topic: str) -> int | None:
        """Return the time [ns] of `latest(topic)`: of the producer's tick in lockstep, of reception in wall-clock mode.

        In wall-clock mode it is one period of the topic earlier on the edge `previous`.
        """

    def lost(self, role: str) -> bool:
        """Return True if the service of that role is lost (its liveliness token vanished)."""


class Service(ABC):
    """Base class of services. `role` is the name of its row in the contract."""

    role: ClassVar[str]
    catches_up: ClassVar[bool] = True
    """True for simulated physics: in wall-clock mode a critical service that is late then steps every missed tick. False for a
    driver of real hardware, which has moved in the meantime."""

    def start(self) -> Outbox:
        """Return the latched messages, to be sent before the first tick. Called once."""
        return {}

    @abstractmethod
    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Advance to time `t` [ns] and return the messages to send.

        A periodic topic of this role needs a message at each of its ticks (t a multiple of the topic's period).
        Nothing here may depend on wall time, thread timing or an unseeded generator.
        """

    def parts(self, t: int, inbox: Inbox) -> Iterator[Outbox]:
        """Yield the outboxes of the step in parts, each sent before the next is computed; the runtimes call this.

        By default there is one part, from `step`. A service of the 1 kHz loop yields first the messages that others wait for.
        """
        yield self.step(t, inbox)

    def finish(self) -> Mapping[str, Any]:
        """Close files; return JSON-serialisable facts for the report. Called once at the end."""
        return {}
