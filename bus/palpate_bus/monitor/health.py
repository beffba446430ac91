"""Findings of a monitor: the health of each topic and violations of the contract, also as `diagnostic_msgs/DiagnosticStatus`."""

from collections.abc import Iterable
from dataclasses import dataclass

from palpate_bus.contract import Topic, contract
from palpate_bus.contract.conformance import ViolationKind as Kind
from palpate_bus.messages import DiagnosticArray, DiagnosticStatus, KeyValue, codec
from palpate_bus.messages.stamps import header


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
    """A violation with its count and times of first and last occurrence, by the caller's clock [s]."""

    violation: Violation
    first: float
    last: float
    count: int = 1


@dataclass(frozen=True)
class TopicHealth:
    """State of a topic as of the last check while it was subscribed to."""

    topic: Topic
    senders: tuple[str, ...]
    alive: bool | None
    """True if it carries messages; None if unknown (no sender, or an event topic without events)."""
    messages: int
    rate_hz: float
    """Messages per second of wall time, over the window."""
    bus_rate_hz: float | None
    """Messages per second of bus time."""
    age_ms: float | None
    """Age of the newest message by its source time (wall clock); None before the first."""
    bytes_per_s: float
    missing: int
    """Number of missing sequence numbers."""
    violations: int
    observed: bool = True
    """True if it was ever subscribed to; of other topics only senders, types and hashes are known."""


RECENT_S = 3.0
"""A violation is an error for this time after its last occurrence, then a warning."""
PREFIX = "palpate/topic/"
"""Prefix of a topic's name in `DiagnosticStatus.name`; ROS tools group statuses by path."""


def topic_statuses(health: Iterable[TopicHealth], active: Iterable[SeenViolation], now: float) -> list[codec.Message]:
    """Return a status per topic: ERROR while the contract is violated, WARN if it was before, STALE if it has no sender.

    `now` [s] is the monitor's clock.
    """
    by_topic: dict[str, list[SeenViolation]] = {}
    for seen in active:
        by_topic.setdefault(seen.violation.topic, []).append(seen)
    return [_status(row, sorted(by_topic.get(row.topic.name, []), key=lambda seen: seen.last), now) for row in health]


def _status(row: TopicHealth, found: list[SeenViolation], now: float) -> codec.Message:
    level, message = _level(row, found, now)
    values = [KeyValue("sent_by", ", ".join(row.senders))]
    if row.observed:
        values += [KeyValue("rate_hz", f"{row.rate_hz:.4g}"), KeyValue("missing", str(row.missing))]
    if row.topic.periodic and row.bus_rate_hz is not None:
        values.append(KeyValue("bus_rate_hz", f"{row.bus_rate_hz:.4g}"))
    if row.age_ms is not None:
        values.append(KeyValue("age_ms", f"{row.age_ms:.1f}"))
    values += [KeyValue(str(seen.violation.kind), f"{seen.violation} ({_how_often(seen)})") for seen in found]
    return DiagnosticStatus(level, f"{PREFIX}{row.topic.name}", message, row.topic.producer, values)


def _level(row: TopicHealth, found: list[SeenViolation], now: float) -> tuple[int, str]:
    """Return level and text of the status of a topic with the violations `found`, the newest last."""
    if found:
        newest = found[-1]
        if now - newest.last <= RECENT_S:
            return DiagnosticStatus.ERROR, str(newest.violation)
        return DiagnosticStatus.WARN, f"was: {newest.violation} ({_how_often(newest)})"
    if not row.senders:
        producer = contract().roles.get(row.topic.producer)
        optional = producer is not None and producer.optional
        return (DiagnosticStatus.OK if optional else DiagnosticStatus.STALE), "no sender"
    if not row.observed:
        return DiagnosticStatus.OK, "sent; not observed"
    idle = row.alive is None and not row.rate_hz
    if row.alive is False:
        return DiagnosticStatus.WARN, "no messages"
    return DiagnosticStatus.OK, "no events" if idle else "as in the contract"


def _how_often(seen: SeenViolation) -> str:
    return "once" if seen.count == 1 else f"{seen.count} times"


def diagnostics(health: Iterable[TopicHealth], active: Iterable[SeenViolation], t: int, now: float) -> codec.Message:
    """Return the statuses as `diagnostic_msgs/DiagnosticArray` stamped `t` [ns]."""
    return DiagnosticArray(header(t), topic_statuses(health, active, now))
