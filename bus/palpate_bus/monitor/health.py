"""Streams of messages with their rate, silence and age, and the findings of a monitor, also as `DiagnosticStatus`.

A rate is the number of messages over the time that passed by their own stamps, so that a run at a third of real time has correct
rates and a busy monitor does not misjudge; in wall-clock mode, by their source times and the rate of the run. A topic is silent
if nothing was received while the time of the bus, the median of all periodic topics' stamps, advanced.
"""

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from statistics import median
from typing import NamedTuple

from palpate_bus.contract import Topic, contract
from palpate_bus.contract.port_check import MessageViolation, ViolationKind as Kind
from palpate_bus.messages import MS, DiagnosticStatus, KeyValue, codec


class Violation(NamedTuple):
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
    """A violation with its count and the time of its last occurrence, by the caller's clock [s]."""

    violation: Violation
    last: float
    count: int = 1


class TopicHealth(NamedTuple):
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


class StreamTuning(NamedTuple):
    """Tolerances of rate, silence and age."""

    window_s: float = 0.7
    """Averaging window of rates [s], wall time; a wrong rate is found within a second."""
    rate_tolerance: float = 0.2
    min_off: int = 3
    """A rate is wrong when more than this many messages, and more than `rate_tolerance` of them, are missing or too many."""
    silence_ns: int = 100 * MS
    """Bus time without a message after which a topic is silent."""
    grace_s: float = 0.5
    """Time after a first message until its rate is checked."""
    ages: int = 5
    """Number of checks over which the median age is taken."""
    slack_ms: float = 100.0
    """Wall time of one check of all topics [ms]."""


TUNING = StreamTuning()


class Passed(NamedTuple):
    """Progress of a stream over the window."""

    seconds: float
    messages: int
    bytes: int
    stamps: int | None
    """Progress of the stamps [ns]."""
    sent: int
    """Progress of the source times [ns]."""


@dataclass
class Stream:
    """Messages of one sender on one topic, counted over a window of wall time."""

    sender: str
    began: float
    count: int = 0
    size: int = 0
    missing: int = 0
    sequence: int = 0
    stamp: int | None = None
    sent: int = 0
    window: deque[tuple[float, int, int, int | None, int]] = field(default_factory=deque)
    """(now, messages, bytes, stamp, source time) at each check of the last `TUNING.window_s`."""
    ages: deque[float] = field(default_factory=lambda: deque(maxlen=16))

    def mark(self, now: float) -> None:
        """Add the current counts to the window."""
        self.window.append((now, self.count, self.size, self.stamp, self.sent))
        while len(self.window) > 2 and now - self.window[1][0] >= TUNING.window_s:
            self.window.popleft()

    def passed(self) -> Passed:
        """Return the progress over the window."""
        first, last = self.window[0], self.window[-1]
        progress = None if first[3] is None or last[3] is None else last[3] - first[3]
        return Passed(last[0] - first[0], last[1] - first[1], last[2] - first[2], progress, last[4] - first[4])


class BusTime(NamedTuple):
    """Progress of the bus time over the window."""

    seconds: float
    """Wall time [s]."""
    passed: int
    """Bus time [ns]; in wall-clock mode wall time times the rate of the run."""
    now: int | None
    """Newest bus time [ns]; None before the first stamped message."""

    @property
    def progress(self) -> float | None:
        """Bus time per wall time; None if unknown."""
        return self.passed / 1e9 / self.seconds if self.now is not None else None


def bus_time(streams: Iterable[Stream], rate: float | None) -> BusTime:
    """Return the median over the streams of the periodic topics; `rate` as for `Monitor`."""
    moved, newest = [], []
    for stream in streams:
        passed = stream.passed()
        if passed.stamps is not None and passed.seconds >= TUNING.grace_s:
            moved.append((passed.stamps, passed.seconds))
            newest.append(stream.stamp or 0)
    if not moved:
        return BusTime(0.0, 0, None)
    seconds = median(s for _, s in moved)
    progress = seconds * 1e9 * rate if rate else median(p for p, _ in moved)
    return BusTime(seconds, int(progress), int(median(newest)))


def timing_violations(topic: Topic, stream: Stream, time: BusTime, rate: float | None, now: float) -> Iterator[MessageViolation]:
    """Yield violations of rate and age of a periodic topic's stream; `now` [s] is the clock of its marks."""
    own = stream.passed()
    if now - stream.began < TUNING.grace_s or own.seconds < TUNING.grace_s:
        return
    wanted = f"{1000 / topic.period_ms:g} {'Hz' if rate == 1.0 else 'Hz of simulated time'}"
    if not own.messages:
        if is_due(topic, time) and time.passed > TUNING.silence_ns:
            yield MessageViolation(Kind.SILENT, "", wanted, f"nothing for {own.seconds:.1f} s")
        return
    spent = own.sent * rate if rate else own.stamps
    if spent:
        off = abs(own.messages - spent / topic.period)
        if off > TUNING.min_off and off > TUNING.rate_tolerance * spent / topic.period:
            unit = wanted.partition(" ")[2]
            yield MessageViolation(Kind.RATE, "", wanted, f"{own.messages * 1e9 / spent:.4g} {unit}")
    yield from _age(topic, stream, time, rate)


def is_due(topic: Topic, time: BusTime) -> bool:
    """Return True if enough bus time passed for several messages of a periodic topic."""
    return time.passed / topic.period > TUNING.min_off


def _age(topic: Topic, stream: Stream, time: BusTime, rate: float | None) -> Iterator[MessageViolation]:
    if topic.max_age_ms is None or len(stream.ages) < TUNING.ages:
        return
    if rate:
        age = median(stream.ages) * rate
        if age > topic.max_age_ms + topic.period_ms:
            yield MessageViolation(Kind.AGE, "", f"at most {topic.max_age_ms} ms", f"{age:.0f} ms")
    elif stream.stamp is not None and time.now is not None:
        behind = (time.now - stream.stamp) / MS - topic.period_ms
        if behind > topic.max_age_ms + TUNING.slack_ms * max(time.progress or 0.0, 1.0):
            yield MessageViolation(Kind.AGE, "", f"at most {topic.max_age_ms} ms", f"{behind:.0f} ms behind the others")
