"""A monitor on a bus: it subscribes to every topic of the contract under any type, to liveliness tokens and to service reports.

    with session(run.options()) as bus:
        monitor = LiveMonitor(bus, contract(), run.domain, rate=run.rate)
        while True:
            for violation in monitor.poll():
                print(violation)
            sleep(0.05)

Samples wait in channels until `poll`, which the owner calls often. It costs each producer of a 1 kHz topic one more subscriber.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from time import monotonic, time_ns
from typing import Any

import zenoh

from palpate_bus.contract import Contract, Topic
from palpate_bus.messages import RunControl, ServiceReport, codec
from palpate_bus.monitor.health import Violation
from palpate_bus.monitor.monitor import Monitor
from palpate_bus.wire.liveliness import GraphWatch
from palpate_bus.wire.rmw import WireError, any_type_key, message_key, parse_key, unpack

ROOM = 1 << 15
"""Messages per topic that wait for a poll."""
WALL_CLOCK_TICK = 10**17
"""A grant beyond this [ns] is a wall time: the common start of a wall-clock run."""


@dataclass(frozen=True)
class RoleReport:
    """The last report of a service."""

    state: int
    tick: int
    """Last finished tick [ns]."""
    waiting_for: str
    received: float
    """By the monotonic clock [s]."""


class LiveMonitor:
    """A `Monitor` on a bus, for all topics or for `topics` only; see `listen`."""

    def __init__(
        self, session: zenoh.Session, rules: Contract, domain: int, topics: Iterable[str] | None = None, rate: float | None = None
    ) -> None:
        self.monitor = Monitor(rules, rate)
        self.graph = GraphWatch(session, domain)
        self.reports: dict[str, RoleReport] = {}
        self.offsets: dict[str, float] = {}
        """Smallest age [ms] of a message by topic; negative if the sender's clock is ahead of ours."""
        self._session, self._domain = session, domain
        self._listeners: dict[str, _Listener] = {}
        self.listen(rules.topics if topics is None else topics)
        report, control = "palpation_msgs/msg/ServiceReport", "palpation_msgs/msg/RunControl"
        self._reports: Any = session.declare_subscriber(
            message_key("palpate/report/*", report, domain), zenoh.handlers.FifoChannel(ROOM)
        )
        self._control: Any = session.declare_subscriber(
            message_key("palpate/control", control, domain), zenoh.handlers.FifoChannel(ROOM)
        )
        self._decode_report, self._decode_control = codec.decoder(report), codec.decoder(control)

    def listen(self, topics: Iterable[str]) -> None:
        """Subscribe to `topics` and no others from now on."""
        chosen = set(topics)
        for name in self._listeners.keys() - chosen:
            self._listeners.pop(name).close()
        for name in chosen - self._listeners.keys():
            self._listeners[name] = _Listener(self._session, self.monitor.rules.topics[name], self._domain)
        self.monitor.listen(chosen, monotonic())

    def poll(self) -> list[Violation]:
        """Process received messages and return new violations."""
        now = monotonic()
        self.graph.changes()
        self.monitor.set_entities(self.graph.alive.values(), now)
        self._receive_control()
        self._receive_reports(now)
        for listener in self._listeners.values():
            for sent, sequence, gid, payload in listener.drain(self.monitor, now):
                self.monitor.receive(listener.topic.name, sent, sequence, gid, payload, now)
                age = (time_ns() - sent) / 1e6
                self.offsets[listener.topic.name] = min(age, self.offsets.get(listener.topic.name, age))
        return self.monitor.check(monotonic(), time_ns())

    def close(self) -> None:
        """Close the subscriptions."""
        self.graph.close()
        for listener in self._listeners.values():
            listener.close()
        self._reports.undeclare()
        self._control.undeclare()

    def _receive_control(self) -> None:
        while (sample := self._control.handler.try_recv()) is not None:
            try:
                message = self._decode_control(sample.payload.to_bytes())
            except codec.CodecError:
                continue
            if message.command == RunControl.GRANT and message.tick > WALL_CLOCK_TICK:
                self.monitor.rate = self.monitor.rate or 1.0

    def _receive_reports(self, now: float) -> None:
        while (sample := self._reports.handler.try_recv()) is not None:
            try:
                message = self._decode_report(sample.payload.to_bytes())
            except codec.CodecError:
                continue
            if message.state in (ServiceReport.READY, ServiceReport.PROGRESS, ServiceReport.FINISHED, ServiceReport.FAILED):
                self.reports[message.role] = RoleReport(message.state, int(message.tick), message.waiting_for, now)


class _Listener:
    """A subscription to one topic under any type and hash."""

    def __init__(self, session: zenoh.Session, topic: Topic, domain: int) -> None:
        self.topic = topic
        key = any_type_key(topic.name, domain)
        channel: Any = zenoh.handlers.FifoChannel(ROOM)
        if topic.latched:
            self._subscriber: Any = zenoh.ext.declare_advanced_subscriber(
                session, key, channel, history=zenoh.ext.HistoryConfig(detect_late_publishers=True)
            )
        else:
            self._subscriber = session.declare_subscriber(key, channel)
        self._receive = self._subscriber.handler.try_recv
        self._wanted = (topic.type, topic.type_hash)

    def drain(self, monitor: Monitor, now: float) -> list[tuple[int, int, bytes, bytes]]:
        """Return new messages of the contract's type: (source time [ns], sequence, GID, payload)."""
        received = []
        while (sample := self._receive()) is not None:
            attachment = sample.attachment
            try:
                sequence, sent, gid = unpack(attachment.to_bytes())
            except (WireError, AttributeError) as error:
                why = "no attachment" if attachment is None else str(error)
                monitor.garbage(self.topic.name, why, now)
                continue
            try:
                key = parse_key(str(sample.key_expr))
            except WireError as error:
                monitor.garbage(self.topic.name, str(error), now)
                continue
            if (key.type, key.type_hash) != self._wanted:
                monitor.foreign(self.topic.name, key.type, key.type_hash, gid, now)
                continue
            received.append((sent, sequence, gid, sample.payload.to_bytes()))
        return received

    def close(self) -> None:
        """Close the subscriptions."""
        self._subscriber.undeclare()
