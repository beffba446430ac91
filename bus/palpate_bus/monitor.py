"""The contract, enforced live: what every topic of a bus does against its row, from the contract alone.

`Monitor` is the judgement, without any transport: give it what was heard (`hear`) and who is there (`see`), and ask it (`look`).
`LiveMonitor` in `live` listens on a bus for it. A violation names topic, sender, what is expected and what came.

A rate is messages by what their own stamps say has passed, so that a run at a third of real time has right rates, and a busy
monitor judges no worse; in wall-clock mode by their source times. A topic is silent when nothing came while the bus's time, the
median of all periodic topics' stamps, went on.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from statistics import median
from typing import NamedTuple

from palpate_bus import codec
from palpate_bus.checker import Checker, Kind
from palpate_bus.contract import MS, Contract, Topic
from palpate_bus.liveliness import Entity
from palpate_bus.liveliness import Kind as EntityKind
from palpate_bus.messages import DiagnosticArray, DiagnosticStatus, KeyValue
from palpate_bus.stamps import header

WINDOW_S = 0.7
"""Rates are over this much wall time, so that a wrong one is named within a second."""
RATE_TOLERANCE = 0.2
LEAST_OFF = 3
"""A rate is wrong when more than this many messages, and more than `RATE_TOLERANCE` of them, are missing or too many."""
SILENCE_NS = 100 * MS
"""Bus time that has to pass without a message before a topic counts as silent."""
GRACE_S = 0.5
"""After a first message, until its topic is judged by rate."""


@dataclass(frozen=True)
class Violation:
    """One thing that is not as the contract says."""

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
class Seen:
    """A violation with how often and when it was seen, by the caller's clock [s]."""

    violation: Violation
    first: float
    last: float
    count: int = 1


@dataclass(frozen=True)
class TopicHealth:
    """One topic, as of the last `look`."""

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


class _Passed(NamedTuple):
    """What one sender's stream did over the window."""

    seconds: float
    messages: int
    bytes: int
    stamps: int | None
    """Progress of the stamps [ns]."""
    sent: int
    """Progress of the source times [ns]."""


@dataclass
class _Stream:
    """What one sender sent on one topic."""

    sender: str
    began: float
    count: int = 0
    size: int = 0
    missing: int = 0
    sequence: int = 0
    stamp: int | None = None
    sent: int = 0
    window: deque[tuple[float, int, int, int | None, int]] = field(default_factory=deque)
    """(now, messages, bytes, stamp, source time) at each look of the last `WINDOW_S`."""
    ages: deque[float] = field(default_factory=lambda: deque(maxlen=16))

    def mark(self, now: float) -> None:
        """Remembers where it stands."""
        self.window.append((now, self.count, self.size, self.stamp, self.sent))
        while len(self.window) > 2 and now - self.window[1][0] >= WINDOW_S:
            self.window.popleft()

    def passed(self) -> _Passed:
        """What happened over the window."""
        first, last = self.window[0], self.window[-1]
        progress = None if first[3] is None or last[3] is None else last[3] - first[3]
        return _Passed(last[0] - first[0], last[1] - first[1], last[2] - first[2], progress, last[4] - first[4])


class Monitor:
    """Judges a bus by the contract. `wallclock` says whether time on it is the wall's (else simulated)."""

    def __init__(self, rules: Contract, wallclock: bool = False) -> None:
        self.rules = rules
        self.wallclock = wallclock
        self.active: dict[tuple[str, str, Kind, str], Seen] = {}
        """Every violation so far, by (topic, sender, kind, field)."""
        self.bus_time: int | None = None
        """Newest time [ns] on the bus."""
        self.progress: float | None = None
        """Bus time per wall time, over the window."""
        self._streams: dict[str, dict[bytes, _Stream]] = {name: {} for name in rules.topics}
        self._checkers = {name: Checker(topic) for name, topic in rules.topics.items()}
        self._decoders = {name: codec.decoder(topic.type) for name, topic in rules.topics.items()}
        self._nodes: dict[bytes, str] = {}
        self._publishers: dict[str, set[str]] = {}
        self._since: dict[tuple[str, str], float] = {}
        self._marks: deque[tuple[float, int]] = deque()
        self._news: list[Violation] = []

    def see(self, entities: Iterable[Entity], now: float) -> None:
        """Takes who is on the bus (`GraphWatch.alive.values()`): names for senders, types and hashes, who may send what."""
        present = list(entities)
        self._nodes = {entity.gid: entity.node for entity in present}
        self._publishers = {}
        for entity in present:
            if entity.endpoint is None or entity.endpoint.topic not in self.rules.topics:
                continue
            topic, described = self.rules.topics[entity.endpoint.topic], entity.endpoint
            publishes = entity.kind is EntityKind.PUBLISHER
            if publishes:
                self._publishers.setdefault(topic.name, set()).add(entity.node)
                self._since.setdefault((topic.name, entity.node), now)
                self._check_sender(topic, entity.node, now)
            if (described.type, described.type_hash) != (topic.type, topic.type_hash):
                self._note(topic, entity.node, Kind.TYPE, _type(topic.type, topic.type_hash),
                           f"{_type(described.type, described.type_hash)}{'' if publishes else ' wanted'}", now)  # fmt: skip

    def hear(self, name: str, sent: int, sequence: int, gid: bytes, payload: bytes, now: float) -> None:
        """Takes a message of a topic: source time [ns, wall], sequence number, GID and CDR. `now` [s] is any steady clock."""
        topic = self.rules.topics[name]
        stream = self._streams[name].get(gid)
        if stream is None:
            stream = self._streams[name][gid] = _Stream(self._sender(gid), now, sequence=sequence - 1)
        if stream.sender.startswith("unknown") and gid in self._nodes:
            stream.sender = self._nodes[gid]
        stream.count += 1
        stream.size += len(payload)
        stream.sent = sent
        self._check_sequence(topic, stream, sequence, now)
        try:
            message = self._decoders[name](payload)
        except codec.CodecError as error:
            self._note(topic, stream.sender, Kind.GARBAGE, topic.type, str(error), now)
            return
        checker = self._checkers[name]
        for fault in checker(message):
            self._note(topic, stream.sender, fault.kind, fault.expected, fault.got, now, fault.field)
        stamp = checker.stamp(message) if not topic.latched else None
        if stamp is not None:
            self._check_stamp(topic, stream, sequence, stamp, now)
            stream.stamp = stamp

    def garbage(self, name: str, why: str, now: float) -> None:
        """Takes note of bytes on a topic that are no message."""
        self._note(self.rules.topics[name], "unknown", Kind.GARBAGE, "rmw_zenoh's attachment of 33 bytes", why, now)

    def foreign(self, name: str, type_name: str, type_hash: str, gid: bytes | None, now: float) -> None:
        """Takes note of a message that came on a topic's key with another type or hash."""
        topic = self.rules.topics[name]
        sender = "unknown" if gid is None else self._sender(gid)
        self._note(topic, sender, Kind.TYPE, _type(topic.type, topic.type_hash), _type(type_name, type_hash), now)

    def look(self, now: float, wall: int) -> list[Violation]:
        """Judges rates and ages; returns what is new since the last look. `wall` is the wall time [ns]. Call it often."""
        for streams in self._streams.values():
            for stream in streams.values():
                stream.mark(now)
                stream.ages.append((wall - stream.sent) / MS)
        passed = self._bus_progress(now)
        for name, streams in self._streams.items():
            topic = self.rules.topics[name]
            if not topic.periodic:
                continue
            for gid, stream in streams.items():
                if not self._nodes or gid in self._nodes:
                    self._judge(topic, stream, passed, now)
        self._judge_unheard(passed, now)
        news, self._news = self._news, []
        return news

    def health(self) -> list[TopicHealth]:
        """Every topic of the contract, in its order."""
        return [self._health(topic) for topic in self.rules.topics.values()]

    def _health(self, topic: Topic) -> TopicHealth:
        streams = [stream for stream in self._streams[topic.name].values() if stream.window]
        passed = [stream.passed() for stream in streams]
        seconds = max((p.seconds for p in passed), default=0.0)
        messages, size = sum(p.messages for p in passed), sum(p.bytes for p in passed)
        own = [p.messages * 1e9 / p.stamps for p in passed if p.stamps]
        senders = sorted({stream.sender for stream in streams} | self._publishers.get(topic.name, set()))
        alive: bool | None = None
        if topic.latched and senders:
            alive = bool(streams)
        elif topic.periodic and senders and self.progress:
            alive = messages > 0
        violations = sum(seen.count for key, seen in self.active.items() if key[0] == topic.name)
        rate = messages / seconds if seconds else 0.0
        return TopicHealth(
            topic, tuple(senders), alive, sum(stream.count for stream in streams), rate,
            max(own, default=None),
            min((stream.ages[-1] for stream in streams if stream.ages), default=None),
            size / seconds if seconds else 0.0, sum(stream.missing for stream in streams), violations,
        )  # fmt: skip

    # -- judgements

    def _sender(self, gid: bytes) -> str:
        return self._nodes.get(gid, f"unknown sender {gid.hex()[:8]}")

    def _note(self, topic: Topic, sender: str, kind: Kind, expected: str, got: str, now: float, path: str = "") -> None:
        key = (topic.name, sender, kind, path)
        seen = self.active.get(key)
        if seen is not None:
            seen.last = now
            seen.count += 1
            seen.violation = Violation(topic.name, sender, kind, expected, got, path)
            return
        violation = Violation(topic.name, sender, kind, expected, got, path)
        self.active[key] = Seen(violation, now, now)
        self._news.append(violation)

    def _check_sender(self, topic: Topic, sender: str, now: float) -> None:
        if sender != topic.producer and not topic.open:
            self._note(topic, sender, Kind.SENDER, f"{topic.producer} only", f"a publisher of {sender}", now)

    def _check_sequence(self, topic: Topic, stream: _Stream, sequence: int, now: float) -> None:
        missing = sequence - stream.sequence - 1
        if missing > 0:
            stream.missing += missing
            self._note(topic, stream.sender, Kind.GAP, f"sequence {stream.sequence + 1}",
                       f"{sequence}: {missing} missing, or lost on the way to this monitor", now)  # fmt: skip
        elif missing < 0:
            self._note(topic, stream.sender, Kind.GAP, f"sequence {stream.sequence + 1}", f"{sequence} again", now)
        stream.sequence = max(stream.sequence, sequence)

    def _check_stamp(self, topic: Topic, stream: _Stream, sequence: int, stamp: int, now: float) -> None:
        if stream.stamp is not None and stamp < stream.stamp:
            self._note(topic, stream.sender, Kind.STAMP, f"at least {stream.stamp} ns", f"{stamp} ns: it goes backwards", now)
        elif topic.periodic and not self.wallclock and stamp != (sequence - 1) * topic.period:
            expected = f"{(sequence - 1) * topic.period} ns, by its sequence number {sequence}"
            self._note(topic, stream.sender, Kind.STAMP, expected, f"{stamp} ns", now)

    def _bus_progress(self, now: float) -> tuple[float, int]:
        """(wall [s], bus time [ns]) over the window: the median over the periodic topics, or wall time in wall-clock mode."""
        moved = []
        newest = []
        for name, streams in self._streams.items():
            if not self.rules.topics[name].periodic:
                continue
            for stream in streams.values():
                passed = stream.passed()
                if passed.stamps is not None and passed.seconds >= GRACE_S:
                    moved.append((passed.stamps, passed.seconds))
                    newest.append(stream.stamp or 0)
        if not moved:
            self.progress = None
            return 0.0, 0
        self.bus_time = int(median(newest))
        seconds = median(s for _, s in moved)
        progress = seconds * 1e9 if self.wallclock else median(p for p, _ in moved)
        self.progress = progress / 1e9 / seconds
        return seconds, int(progress)

    def _judge(self, topic: Topic, stream: _Stream, passed: tuple[float, int], now: float) -> None:
        """Rate and age of a periodic topic."""
        own = stream.passed()
        if now - stream.began < GRACE_S or own.seconds < GRACE_S:
            return
        unit = "Hz" if self.wallclock else "Hz of simulated time"
        if not own.messages:
            if passed[1] / topic.period > LEAST_OFF and passed[1] > SILENCE_NS:
                got = f"nothing for {own.seconds:.1f} s"
                self._note(topic, stream.sender, Kind.SILENT, f"{1000 / topic.period_ms:g} {unit}", got, now)
            return
        spent = own.sent if self.wallclock else own.stamps
        if spent:
            off = abs(own.messages - spent / topic.period)
            if off > LEAST_OFF and off > RATE_TOLERANCE * spent / topic.period:
                got = f"{own.messages * 1e9 / spent:.4g} {unit}"
                self._note(topic, stream.sender, Kind.RATE, f"{1000 / topic.period_ms:g} {unit}", got, now)
        self._judge_age(topic, stream, now)

    def _judge_age(self, topic: Topic, stream: _Stream, now: float) -> None:
        if topic.max_age_ms is None or len(stream.ages) < 5:
            return
        age = median(stream.ages)
        if self.wallclock and age > topic.max_age_ms + topic.period_ms:
            self._note(topic, stream.sender, Kind.AGE, f"at most {topic.max_age_ms} ms", f"{age:.0f} ms", now)
        elif not self.wallclock and stream.stamp is not None and self.bus_time is not None:
            behind = (self.bus_time - stream.stamp) / MS - topic.period_ms
            if behind > topic.max_age_ms + self._slack_ms:
                got = f"{behind:.0f} ms behind the others"
                self._note(topic, stream.sender, Kind.AGE, f"at most {topic.max_age_ms} ms", got, now)

    @property
    def _slack_ms(self) -> float:
        """Simulated time that passes while a look takes its turn through the topics."""
        return 100.0 * max(self.progress or 0.0, 1.0)

    def _judge_unheard(self, passed: tuple[float, int], now: float) -> None:
        """Topics whose producer is there but from whom nothing came."""
        for name, nodes in self._publishers.items():
            topic = self.rules.topics[name]
            heard = {stream.sender for stream in self._streams[name].values()}
            for node in nodes - heard:
                waited = now - self._since[(name, node)]
                due = passed[1] / topic.period
                if waited > WINDOW_S and ((topic.periodic and due > LEAST_OFF) or (topic.latched and passed[1] > 0)):
                    expected = "its latched message" if topic.latched else f"{1000 / topic.period_ms:g} Hz"
                    self._note(topic, node, Kind.SILENT, expected, f"nothing for {waited:.1f} s", now)


def diagnostics(health: Iterable[TopicHealth], active: Iterable[Seen], t: int) -> codec.Message:
    """What a monitor saw as `diagnostic_msgs/DiagnosticArray` stamped `t` [ns], one status a topic, as ROS tools show it."""
    by_topic: dict[str, list[Seen]] = {}
    for seen in active:
        by_topic.setdefault(seen.violation.topic, []).append(seen)
    statuses = []
    for row in health:
        found = by_topic.get(row.topic.name, [])
        level = DiagnosticStatus.ERROR if found else DiagnosticStatus.STALE if row.alive is None else DiagnosticStatus.OK
        message = str(found[-1].violation) if found else "rests" if row.alive is None else "as the contract says"
        values = [KeyValue("rate_hz", f"{row.rate_hz:.4g}"), KeyValue("missing", str(row.missing))]
        values += [KeyValue("age_ms", f"{row.age_ms:.1f}")] if row.age_ms is not None else []
        values += [KeyValue(f"{s.violation.kind}", f"{s.violation} ({s.count} times)") for s in found]
        name = f"palpate/topic/{row.topic.name}"
        statuses.append(DiagnosticStatus(level, name, message, ",".join(row.senders), values))
    return DiagnosticArray(header(t), statuses)


def _type(name: str, digest: str) -> str:
    return f"{name} {digest[:15]}"
