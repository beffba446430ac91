"""The process of an observer: it is outside the barrier, reads what arrives and never slows a producer.

It sees the latest of the periodic topics, and every message of the others. A recorder is driven by `recording`.
"""

from __future__ import annotations

import logging
from time import sleep
from typing import Any

import zenoh

from palpate_bus.contract import Topic
from palpate_bus.messages import RunControl, ServiceReport, codec
from palpate_bus.runtime.conductor_link import ConductorLink, Reports, RunAborted
from palpate_bus.runtime.lockstep import NEVER, Packet, Stepper
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.process_state import whereabouts
from palpate_bus.service import Service
from palpate_bus.wire.rmw import WireError, unpack
from palpate_bus.wire.transport import decoded

log = logging.getLogger(__name__)

IDLE_S = 0.005
RING = 64
"""Messages of a periodic topic kept for an observer that sees the latest: enough for one of its periods at 1 kHz."""
FIFO = 1 << 17
OBSERVERS_STAY_S = 8.0
"""For how long an observer stays at most without a conductor: longer than all whom it observes, see `wallclock`."""


class _Feed:
    """One observed topic."""

    def __init__(self, member: Member, topic: Topic, lossless: bool) -> None:
        self.topic = topic
        key = member.observed(topic)
        channel: Any = zenoh.handlers.FifoChannel(FIFO) if lossless else zenoh.handlers.RingChannel(RING)
        if topic.latched:
            self._subscriber: Any = zenoh.ext.declare_advanced_subscriber(
                member.session, key, channel, history=zenoh.ext.HistoryConfig(detect_late_publishers=True)
            )
        else:
            self._subscriber = member.session.declare_subscriber(key, channel)
        self._try = self._subscriber.handler.try_recv
        self._decode = codec.decoder(topic.type)
        self.sequence = 0
        self.missed = 0
        self.garbage = 0
        self.forged = 0
        self._tagger = member.transport.tagger(key)

    def drain(self) -> list[tuple[int, bytes, codec.Message]]:
        """Everything that came in since last time: (sequence, payload, message)."""
        received = []
        while (sample := self._try()) is not None:
            try:
                attachment = sample.attachment.to_bytes()
                sequence, _, _ = unpack(attachment)
            except (WireError, AttributeError):
                self.garbage += 1
                continue
            payload = sample.payload.to_bytes()
            if self._tagger is not None and not self._tagger.holds(attachment, payload):
                self.forged += 1
                continue
            message = decoded(self._decode, payload)
            if message is None:  # an observer knows no rightful sender, and must not end with what it gets
                self.garbage += 1
                continue
            if sequence > self.sequence + 1 and not self.topic.open:
                self.missed += sequence - self.sequence - 1
            self.sequence = max(self.sequence, sequence)
            received.append((sequence, payload, message))
        return received


class ObservedService:
    """A service outside the barrier with its feeds: the owner of the thread drains the feeds and steps the service."""

    def __init__(self, service: Service, member: Member, lossless: bool = False) -> None:
        """`lossless` keeps every message of every topic, not just the latest of the periodic ones."""
        self.stepper = Stepper(service, member.rules)
        self.feeds = [
            _Feed(member, buffer.topic, lossless or not buffer.topic.periodic) for buffer in self.stepper.buffers.values()
        ]
        self.publishers = {name: member.publisher(port.topic) for name, port in self.stepper.ports.items()}
        self.now = NEVER
        """Newest simulated time [ns] seen."""
        self._stepped = NEVER

    def drain_and_step(self) -> bool:
        """Takes in what has come and steps the service if its period has passed; whether anything came."""
        busy = self._drain()
        period = self.stepper.role.period
        due = self.now - self.now % period
        if busy and due >= 0 and (due > self._stepped or not self.stepper.ports):
            for port, packet in self.stepper.step(due):
                self.publishers[port.topic.name].put(packet.payload, packet.sequence)
            self._stepped = due
        return busy

    def _drain(self) -> bool:
        busy = False
        for feed in self.feeds:
            received = feed.drain()
            if not received:
                continue
            busy = True
            topic = feed.topic
            if topic.periodic:
                self.now = max(self.now, (received[-1][0] - 1) * topic.period)
            buffer = self.stepper.buffers[topic.name]
            for sequence, payload, message in received:
                stamp = (sequence - 1) * topic.period if topic.periodic else max(self.now, 0)
                buffer.deliver(Packet(payload, stamp, sequence, message))
        return busy

    def counters(self) -> dict[str, object]:
        """Garbage and missed messages, for the report."""
        return {
            "garbage": sum(feed.garbage for feed in self.feeds),
            "forged": sum(feed.forged for feed in self.feeds),
            "missed": {feed.topic.name: feed.missed for feed in self.feeds if feed.missed},
        }


class Producers:
    """The services that an observer observes: without a conductor it stays as long as one of them, and no longer."""

    def __init__(self, member: Member) -> None:
        self._member = member
        self._roles = frozenset(role.name for role in member.rules.roles.values() if not role.observer)

    def leave_with_them(self, lost: str) -> None:
        """Raises RunAborted when the conductor is lost, as `lost` says, and all of them have left."""
        if lost and not self._member.alive(self._roles):
            raise RunAborted(lost)


class ObserverNode:
    """One observing service in a process of its own."""

    def __init__(self, service: Service, member: Member) -> None:
        self._service = service
        self._link = ConductorLink(member, OBSERVERS_STAY_S)
        self._producers = Producers(member)
        self._reports = Reports(member)
        self._observed = ObservedService(service, member)

    def run(self) -> None:
        """Observes until the conductor ends the run."""
        observed = self._observed
        try:
            while True:
                busy = observed.drain_and_step()
                message = self._link.poll()
                if message is None:
                    self._producers.leave_with_them(self._link.lost)
                    if not busy:
                        sleep(IDLE_S)
                    self._reports.progress(observed.now)
                elif message.command == RunControl.HELLO:
                    self._hello()
                elif message.command == RunControl.LOST:
                    observed.stepper.inbox.lost_roles.add(message.role)
                elif message.command == RunControl.END:
                    break
            while observed.drain_and_step():
                pass
        except RunAborted as aborted:
            log.warning("run aborted: %s", aborted)
            observed.drain_and_step()
            self._service.finish()
            raise
        facts = dict(self._service.finish())
        detail = {"blame": observed.stepper.blame.per_step_us(), "facts": facts, **observed.counters()}
        self._reports.say(ServiceReport.FINISHED, observed.now, detail=detail)

    def _hello(self) -> None:
        for publisher in self._observed.publishers.values():
            publisher.hello()
        self._observed.drain_and_step()
        self._reports.say(ServiceReport.READY, NEVER, detail={"missing": [], **whereabouts()})
