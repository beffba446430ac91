"""Checks every topic of a bus against its row of the contract.

`Monitor` has no transport: its caller passes messages (`receive`) and entities on the bus (`set_entities`), and calls `check`.
A violation names topic, sender, the expected and the received value. `LiveMonitor` is a monitor on a bus; it subscribes to every
topic of the contract under any type, to liveliness tokens and to service reports:

    with session(run.options()) as bus:
        monitor = LiveMonitor(bus, contract(), run.domain, rate=run.rate)
        while True:
            for violation in monitor.poll():
                print(violation)
            sleep(0.05)

Samples wait in channels until `poll`, which the owner calls often. Each producer of a 1 kHz topic gets one more subscriber.
"""

from collections.abc import Callable, Iterable, Iterator
from time import monotonic, time_ns
from typing import Any

import zenoh

from palpate_bus.contract import Contract, Topic
from palpate_bus.contract.port_check import Checker, ViolationKind as Kind
from palpate_bus.messages import MS, UNIX_NS, RunControl, ServiceReport, codec
from palpate_bus.monitor import health
from palpate_bus.monitor.health import BusTime, SeenViolation, Stream, TopicHealth, Violation
from palpate_bus.settings import Settings
from palpate_bus.wire.liveliness import Entity, EntityKind, GraphWatch
from palpate_bus.wire.rmw import WireError, any_type_key, message_key, parse_key, unpack
from palpate_bus.wire.transport import subscribe, try_decode


class Monitor:
    """Checks a bus against the contract. `rate`: simulated per wall time in wall-clock mode; None in lockstep."""

    def __init__(self, contract: Contract, rate: float | None = None) -> None:
        self.contract = contract
        self.rate = rate
        self.active: dict[tuple[str, str, Kind, str], SeenViolation] = {}
        """Every violation, by (topic, sender, kind, field)."""
        self.time = BusTime(0.0, 0, None)
        """Progress of the bus time as of the last check."""
        self.listening: frozenset[str] = frozenset(contract.topics)
        """Subscribed topics; silence of the others is not a violation."""
        self._kept: dict[str, TopicHealth] = {}
        self._streams: dict[str, dict[bytes, Stream]] = {name: {} for name in contract.topics}
        self._checkers = {name: Checker(topic) for name, topic in contract.topics.items()}
        self._decoders = {name: codec.decoder(topic.type) for name, topic in contract.topics.items()}
        self._nodes: dict[bytes, str] = {}
        self._left: set[bytes] = set()
        """Senders that have left the bus."""
        self._publishers: dict[str, set[str]] = {}
        self._since: dict[tuple[str, str], float] = {}
        self._news: list[Violation] = []

    def listen(self, names: Iterable[str], now: float) -> None:
        """Set the subscribed topics. The last findings on the others are kept."""
        chosen = frozenset(names)
        for name in self.listening - chosen:
            if self._streams[name]:
                self._kept[name] = self._health(self.contract.topics[name])
                self._streams[name] = {}
        for name, node in self._since:
            if name in chosen - self.listening:
                self._since[name, node] = now
        self.listening = chosen

    def set_entities(self, entities: Iterable[Entity], now: float) -> None:
        """Set the entities on the bus (`GraphWatch.alive.values()`), which give the names, types and hashes of senders."""
        present = list(entities)
        before = self._nodes.keys()
        self._nodes = {entity.gid: entity.node for entity in present}
        self._left = (self._left | before) - self._nodes.keys()
        for streams in self._streams.values():
            if not streams.keys().isdisjoint(self._nodes):  # another run's; messages of an earlier one are past
                for gid in self._left & streams.keys():
                    del streams[gid]
        self._publishers = {}
        for entity in present:
            if entity.endpoint is None or entity.endpoint.topic not in self.contract.topics:
                continue
            topic, described = self.contract.topics[entity.endpoint.topic], entity.endpoint
            publishes = entity.kind is EntityKind.PUBLISHER
            if publishes:
                self._publishers.setdefault(topic.name, set()).add(entity.node)
                self._since.setdefault((topic.name, entity.node), now)
                if entity.node != topic.producer and not topic.open:
                    self._note(topic, entity.node, Kind.SENDER, f"{topic.producer} only", f"a publisher of {entity.node}", now)
            if (described.type, described.type_hash) != (topic.type, topic.type_hash):
                self._note(topic, entity.node, Kind.TYPE, _type(topic.type, topic.type_hash),
                           f"{_type(described.type, described.type_hash)}{'' if publishes else ' wanted'}", now)  # fmt: skip

    def receive(self, name: str, sent: int, sequence: int, gid: bytes, payload: bytes, now: float) -> None:
        """Take a message of a topic: source time [ns, wall], sequence number, GID and CDR. `now` [s] is a steady clock."""
        topic = self.contract.topics[name]
        stream = self._streams[name].get(gid)
        if stream is None:
            stream = self._streams[name][gid] = Stream(self._sender(gid), now, sequence=sequence - 1)
        if gid in self._nodes:
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

    def garbage(self, name: str, got: str, now: float) -> None:
        """Note bytes on a topic that are not a message."""
        self._note(self.contract.topics[name], "unknown", Kind.GARBAGE, "rmw_zenoh's attachment of 33 bytes", got, now)

    def foreign(self, name: str, type_name: str, type_hash: str, gid: bytes, now: float) -> None:
        """Note a message on a topic's key with another type or hash."""
        topic = self.contract.topics[name]
        self._note(topic, self._sender(gid), Kind.TYPE, _type(topic.type, topic.type_hash), _type(type_name, type_hash), now)

    def check(self, now: float, wall: int) -> list[Violation]:
        """Check rates and ages; return the violations that are new. `wall` is the wall time [ns]. Call it often."""
        for streams in self._streams.values():
            for stream in streams.values():
                stream.mark(now)
                stream.ages.append((wall - stream.sent) / MS)
        rows = self.contract.topics
        periodic = [(rows[name], streams) for name, streams in self._streams.items() if rows[name].periodic]
        present = (stream for _, streams in periodic for gid, stream in streams.items() if gid not in self._left)
        self.time = health.bus_time(present, self.rate)
        for topic, streams in periodic:
            for gid, stream in streams.items():
                if not self._nodes or gid in self._nodes:
                    for problem in health.timing_violations(topic, stream, self.time, self.rate, now):
                        self._note(topic, stream.sender, problem.kind, problem.expected, problem.got, now)
        self._check_silent(now)
        news, self._news = self._news, []
        return news

    def health(self) -> list[TopicHealth]:
        """Return the health of every topic, in the contract's order."""
        return [self._health(topic) for topic in self.contract.topics.values()]

    def _health(self, topic: Topic) -> TopicHealth:
        streams = [stream for stream in self._streams[topic.name].values() if stream.window]
        passed = [stream.passed() for stream in streams]
        seconds = max((p.seconds for p in passed), default=0.0)
        kept = self._kept.get(topic.name)
        if kept is not None and seconds < health.TUNING.grace_s:  # as of its last subscription, with its present senders
            senders = sorted(self._publishers.get(topic.name, set()))
            return kept._replace(senders=tuple(senders), violations=self._violations(topic))
        messages, size = sum(p.messages for p in passed), sum(p.bytes for p in passed)
        own = [p.messages * 1e9 / p.stamps for p in passed if p.stamps]
        senders = sorted({stream.sender for stream in streams} | self._publishers.get(topic.name, set()))
        alive: bool | None = None
        if topic.latched and senders:
            alive = bool(streams)
        elif topic.periodic and senders and self.time.progress and seconds >= health.TUNING.grace_s:
            alive = messages > 0
        rate = messages / seconds if seconds else 0.0
        return TopicHealth(
            topic, tuple(senders), alive, sum(stream.count for stream in streams), rate,
            max(own, default=None),
            min((stream.ages[-1] for stream in streams if stream.ages), default=None),
            size / seconds if seconds else 0.0, sum(stream.missing for stream in streams), self._violations(topic),
            topic.name in self.listening,
        )  # fmt: skip

    def _violations(self, topic: Topic) -> int:
        return sum(seen.count for key, seen in self.active.items() if key[0] == topic.name)

    # -- checks

    def _sender(self, gid: bytes) -> str:
        return self._nodes.get(gid, f"unknown sender {gid.hex()[:8]}")

    def _note(self, topic: Topic, sender: str, kind: Kind, expected: str, got: str, now: float, path: str = "") -> None:
        key, violation = (topic.name, sender, kind, path), Violation(topic.name, sender, kind, expected, got, path)
        if key in self.active:
            seen = self.active[key]
            seen.violation, seen.last, seen.count = violation, now, seen.count + 1
        else:
            self.active[key] = SeenViolation(violation, now)
            self._news.append(violation)

    def _check_sequence(self, topic: Topic, stream: Stream, sequence: int, now: float) -> None:
        missing = sequence - stream.sequence - 1
        if missing > 0:
            stream.missing += missing
            self._note(topic, stream.sender, Kind.GAP, f"sequence {stream.sequence + 1}",
                       f"{sequence}: {missing} missing, or lost in transit to this monitor", now)  # fmt: skip
        elif missing < 0:
            self._note(topic, stream.sender, Kind.GAP, f"sequence {stream.sequence + 1}", f"{sequence} again", now)
        stream.sequence = max(stream.sequence, sequence)

    def _check_stamp(self, topic: Topic, stream: Stream, sequence: int, stamp: int, now: float) -> None:
        if stream.stamp is not None and stamp < stream.stamp:
            self._note(topic, stream.sender, Kind.STAMP, f"at least {stream.stamp} ns", f"{stamp} ns: backwards", now)
        elif topic.periodic and self.rate is None and stamp != (sequence - 1) * topic.period:
            expected = f"{(sequence - 1) * topic.period} ns, by its sequence number {sequence}"
            self._note(topic, stream.sender, Kind.STAMP, expected, f"{stamp} ns", now)

    def _check_silent(self, now: float) -> None:
        """Note topics whose producer is on the bus but has sent nothing."""
        for name, nodes in self._publishers.items():
            topic = self.contract.topics[name]
            if name not in self.listening:
                continue
            active = {stream.sender for stream in self._streams[name].values()}
            due = (topic.periodic and health.is_due(topic, self.time)) or (topic.latched and self.time.passed > 0)
            for node in nodes - active:
                waited = now - self._since[name, node]
                if waited > health.TUNING.window_s and due:
                    expected = "its latched message" if topic.latched else f"{1000 / topic.period_ms:g} Hz"
                    self._note(topic, node, Kind.SILENT, expected, f"nothing for {waited:.1f} s", now)


def _type(name: str, digest: str) -> str:
    return f"{name} {digest[:15]}"


ROOM = 1 << 15
"""Messages per topic that wait for a poll."""


class LiveMonitor:
    """A `Monitor` on a bus, for all topics or for `topics` only; see `listen`."""

    def __init__(
        self,
        session: zenoh.Session,
        contract: Contract,
        domain: int,
        topics: Iterable[str] | None = None,
        rate: float | None = None,
    ) -> None:
        self.monitor = Monitor(contract, rate)
        self.graph = GraphWatch(session, domain)
        self.reports: dict[str, tuple[ServiceReport, float]] = {}
        """Last report by role, and the monotonic time of its receipt [s]."""
        self.offsets: dict[str, float] = {}
        """Minimum age [ms] of a message by topic; negative if the sender's clock is ahead of ours."""
        self._session, self._domain = session, domain
        self._subscribers: dict[str, Any] = {}
        self.listen(contract.topics if topics is None else topics)
        report, control = "palpation_msgs/msg/ServiceReport", "palpation_msgs/msg/RunControl"
        keys = message_key("palpate/report/*", report, domain), message_key("palpate/control", control, domain)
        both: list[Any] = [session.declare_subscriber(key, zenoh.handlers.FifoChannel(ROOM)) for key in keys]
        self._reports, self._control = both
        self._decode_report, self._decode_control = codec.decoder(report), codec.decoder(control)

    def listen(self, topics: Iterable[str]) -> None:
        """Subscribe to `topics` and no others from now on."""
        chosen = set(topics)
        for name in self._subscribers.keys() - chosen:
            self._subscribers.pop(name).undeclare()
        for name in chosen - self._subscribers.keys():
            key, latched = any_type_key(name, self._domain), self.monitor.contract.topics[name].latched
            self._subscribers[name] = subscribe(self._session, key, zenoh.handlers.FifoChannel(ROOM), history=latched)
        self.monitor.listen(chosen, monotonic())

    def poll(self) -> list[Violation]:
        """Process received messages and return new violations."""
        now = monotonic()
        self.graph.changes()
        self.monitor.set_entities(self.graph.alive.values(), now)
        for message in _decode(self._control, self._decode_control):
            if message.command == RunControl.GRANT and message.tick >= UNIX_NS:  # the common start of a wall-clock run
                self.monitor.rate = self.monitor.rate or Settings.read().rate or 1.0
        for message in _decode(self._reports, self._decode_report):
            if message.state in (ServiceReport.READY, ServiceReport.PROGRESS, ServiceReport.FINISHED, ServiceReport.FAILED):
                self.reports[message.role] = message, now
        for name, subscriber in self._subscribers.items():
            for sample in list(_waiting(subscriber)):
                self._receive(name, sample, now)
        return self.monitor.check(monotonic(), time_ns())

    def close(self) -> None:
        """Close the subscriptions."""
        self.graph.close()
        for subscriber in (*self._subscribers.values(), self._reports, self._control):
            subscriber.undeclare()

    def _receive(self, name: str, sample: Any, now: float) -> None:
        try:
            sequence, sent, gid = unpack(sample.attachment.to_bytes())
            key = parse_key(str(sample.key_expr))
        except (WireError, AttributeError) as error:
            self.monitor.garbage(name, "no attachment" if sample.attachment is None else str(error), now)
            return
        topic = self.monitor.contract.topics[name]
        if (key.type, key.type_hash) != (topic.type, topic.type_hash):
            self.monitor.foreign(name, key.type, key.type_hash, gid, now)
            return
        self.monitor.receive(name, sent, sequence, gid, sample.payload.to_bytes(), now)
        age = (time_ns() - sent) / 1e6
        self.offsets[name] = min(age, self.offsets.get(name, age))


def _waiting(subscriber: Any) -> Iterator[Any]:
    """Yield the samples that a subscriber has received."""
    while (sample := subscriber.handler.try_recv()) is not None:
        yield sample


def _decode(subscriber: Any, decode: Callable[[bytes], Any]) -> Iterator[Any]:
    """Yield the messages that a subscriber has received, without those that cannot be decoded."""
    messages = (try_decode(decode, sample.payload.to_bytes()) for sample in _waiting(subscriber))
    return (message for message in messages if message is not None)
