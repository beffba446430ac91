"""The findings of a monitor: the health of each topic, and violations of the contract."""

from __future__ import annotations

from dataclasses import dataclass

from palpate_bus.contract import Topic
from palpate_bus.contract.conformance import ViolationKind as Kind


@dataclass(frozen=True)
class Violation:
    """One violation of the contract."""

    topic: str
    sender: str
    kind: Kind
    expected: str
    got: str
    field: str = ""

    def __str__(self) -> str:
        where = f".{self.field}" if self.field else ""
        return f"{self.topic}{where} from {self.sender}: {self.kind}: expected {self.expected}, got {self.got}"


@dataclass
class SeenViolation:
    """A violation with how often and when it was seen, by the caller's clock [s]."""

    violation: Violation
    first: float
    last: float
    count: int = 1


@dataclass(frozen=True)
class TopicHealth:
    """One topic, as of the last `look` at which it was listened to."""

    topic: Topic
    senders: tuple[str, ...]
    alive: bool | None
    """Whether it carries what it should; None while that cannot be told (nobody sends it, or an event topic that rests)."""
    messages: int
    rate_hz: float
    """Messages a wall second, over the window."""
    bus_rate_hz: float | None
    """Messages a second of the bus's time."""
    age_ms: float | None
    """Age of the newest message by its source stamp (wall clock)."""
    bytes_per_s: float
    missing: int
    """Sequence numbers that never came."""
    violations: int
    heard: bool = True
    """Whether it was ever listened to: of the others only senders, types and hashes are known."""
