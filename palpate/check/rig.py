"""What a conformance suite drives: one implementation of a role, with the suite in place of all other roles.

`ServiceRig` holds a service of ours in this process, in simulated time. `LiveRig` in `live_rig` talks to an unknown
implementation on a bus, by the wall clock. The same suites run on both.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from palpate_bus.contract import MS, Contract, contract
from palpate_bus.messages import codec
from palpate_bus.messages.codec import Message
from palpate_bus.runtime.lockstep import Packet, Sent, Stepper
from palpate_bus.service import Service
from palpate_models.scenario.schema import Scenario

Source = Callable[[int], "Message | None"]
"""The message of a topic at a time [ns] on the rig's clock; None for silence."""
Feed = Mapping[str, Source]
"""What the suite sends, by topic; a topic that is not in it is silent."""


class HeardMessage(NamedTuple):
    """A message of the implementation."""

    t: int
    """When it came [ns], on the rig's clock."""
    message: Any
    sequence: int
    sent: int
    """Source time [ns]: of the wall clock on a live bus, else `t`."""


@dataclass(frozen=True)
class RigSettings:
    """How a check is to be done."""

    scenario: Scenario
    slack_ms: float = 150.0
    """What transport and an ordinary scheduler may add to a reaction of a live implementation."""
    motion: bool = True
    """Whether the implementation may be moved: never on a real arm without its operator's consent."""


class Rig(ABC):
    """One implementation of a role under test."""

    live = False
    """Whether it runs in real time and the implementation is a separate process."""

    def __init__(self, role: str, settings: RigSettings, rules: Contract | None = None) -> None:
        self.rules = rules or contract()
        self.role = self.rules.roles[role]
        self.settings = settings
        self.log: dict[str, list[HeardMessage]] = {topic.name: [] for topic in self.rules.outputs(role)}
        """Everything that the implementation sent, by topic."""
        self.undecodable: list[str] = []
        """What it sent that is no message, a sentence each."""
        self.t = 0
        """Now [ns]."""
        self.memory: dict[str, int] = {}
        """What a suite keeps from one check to the next."""

    @property
    def slack(self) -> int:
        """What transport and an ordinary scheduler may add to a reaction [ns]; nothing in simulated time."""
        return round(self.settings.slack_ms * MS) if self.live else 0

    def run(self, seconds: float, feed: Feed) -> dict[str, list[HeardMessage]]:
        """Lets time pass while `feed` is sent; returns what the implementation sent meanwhile, by topic."""
        before = {name: len(heard) for name, heard in self.log.items()}
        self._advance(self.t + round(seconds * 1e9), feed)
        return {name: heard[before[name] :] for name, heard in self.log.items()}

    def last(self, topic: str) -> Any:
        """The newest message of a topic, None before the first."""
        heard = self.log[topic]
        return heard[-1].message if heard else None

    @abstractmethod
    def _advance(self, end: int, feed: Feed) -> None:
        """Lets time pass up to `end` [ns]."""

    @abstractmethod
    def send(self, topic: str, message: Message) -> None:
        """Sends one message now."""

    @abstractmethod
    def lose(self, role: str) -> None:
        """Tells the implementation that a role is gone."""


class ServiceRig(Rig):
    """A service of ours in this process: simulated time, exact."""

    def __init__(self, service: Service, settings: RigSettings) -> None:
        super().__init__(service.role, settings)
        self._stepper = Stepper(service, self.rules, strict=False)
        self._sequences = dict.fromkeys(self._stepper.buffers, 0)
        self._take(self._stepper.start())

    def _advance(self, end: int, feed: Feed) -> None:
        due = [(name, self.rules.topics[name].period, source) for name, source in feed.items()]
        while self.t < end:
            for name, period, source in due:
                if not self.t % period and (message := source(self.t)) is not None:
                    self.send(name, message)
            if not self.t % self.role.period:
                self._take(self._stepper.step(self.t))
            self.t += MS

    def send(self, topic: str, message: Message) -> None:
        """Delivers a message, by its bytes as the wire would."""
        self._sequences[topic] += 1
        buffer = self._stepper.buffers[topic]
        buffer.deliver(Packet(codec.encode(message, self.rules.topics[topic].type), self.t, self._sequences[topic]))

    def lose(self, role: str) -> None:
        """Marks a role lost."""
        self._stepper.inbox.lost_roles.add(role)

    def _take(self, sent: list[Sent]) -> None:
        for port, packet in sent:
            message = codec.decode(packet.payload, port.topic.type)
            self.log[port.topic.name].append(HeardMessage(self.t, message, packet.sequence, self.t))
