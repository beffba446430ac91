"""What a monitor saw as `diagnostic_msgs/DiagnosticStatus`, one a topic, as ROS tools show it."""

from __future__ import annotations

from collections.abc import Iterable

from palpate_bus.contract import contract
from palpate_bus.messages import DiagnosticArray, DiagnosticStatus, KeyValue, codec
from palpate_bus.messages.stamps import header
from palpate_bus.monitor.health import SeenViolation, TopicHealth

RECENT_S = 3.0
"""A violation that was last seen longer ago than this is over: a warning, no error any more."""
PREFIX = "palpate/topic/"
"""Before the topic's name: ROS tools group by path."""


def topic_statuses(health: Iterable[TopicHealth], active: Iterable[SeenViolation], now: float) -> list[codec.Message]:
    """A status a topic. ERROR while the contract is violated, WARN when it was, STALE when nobody sends the topic.

    `now` [s] is the monitor's clock.
    """
    by_topic: dict[str, list[SeenViolation]] = {}
    for seen in active:
        by_topic.setdefault(seen.violation.topic, []).append(seen)
    return [_status(row, sorted(by_topic.get(row.topic.name, []), key=lambda seen: seen.last), now) for row in health]


def _status(row: TopicHealth, found: list[SeenViolation], now: float) -> codec.Message:
    level, message = _judged(row, found, now)
    values = [KeyValue("sent_by", ", ".join(row.senders))]
    if row.heard:
        values += [KeyValue("rate_hz", f"{row.rate_hz:.4g}"), KeyValue("missing", str(row.missing))]
    if row.topic.periodic and row.bus_rate_hz is not None:
        values.append(KeyValue("bus_rate_hz", f"{row.bus_rate_hz:.4g}"))
    if row.age_ms is not None:
        values.append(KeyValue("age_ms", f"{row.age_ms:.1f}"))
    values += [KeyValue(str(seen.violation.kind), f"{seen.violation} ({_how_often(seen)})") for seen in found]
    return DiagnosticStatus(level, f"{PREFIX}{row.topic.name}", message, row.topic.producer, values)


def _judged(row: TopicHealth, found: list[SeenViolation], now: float) -> tuple[int, str]:
    """Level and words."""
    if found:
        worst = found[-1]
        if now - worst.last <= RECENT_S:
            return DiagnosticStatus.ERROR, str(worst.violation)
        return DiagnosticStatus.WARN, f"was: {worst.violation} ({_how_often(worst)})"
    if not row.senders:
        producer = contract().roles.get(row.topic.producer)
        optional = producer is not None and producer.optional
        return (DiagnosticStatus.OK if optional else DiagnosticStatus.STALE), "nobody sends it"
    if not row.heard:
        return DiagnosticStatus.OK, "sent; not listened to"
    rests = row.alive is None and not row.rate_hz
    if row.alive is False:
        return DiagnosticStatus.WARN, "nothing comes"
    return DiagnosticStatus.OK, "rests" if rests else "as the contract says"


def _how_often(seen: SeenViolation) -> str:
    return "once" if seen.count == 1 else f"{seen.count} times"


def diagnostics(health: Iterable[TopicHealth], active: Iterable[SeenViolation], t: int, now: float) -> codec.Message:
    """The statuses as `diagnostic_msgs/DiagnosticArray` stamped `t` [ns]."""
    return DiagnosticArray(header(t), topic_statuses(health, active, now))
