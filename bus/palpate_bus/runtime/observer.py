"""The process of an observer: it is outside the barrier, reads what arrives and never slows a producer.

It sees the latest of the periodic topics, and every message of the others. A recorder is driven by `recording`.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from contextlib import suppress
from time import monotonic, sleep
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
LEAVE_S = 2.0
"""For how long an observer waits for those to leave whom it observes, once the run has ended; they do at once."""
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

    def drain_and_step(self, last: bool = False) -> bool:
        """Takes in what has come and steps the service if its period has passed; whether anything came.

        The `last` time it steps for whatever has come: by the wall clock events come after the last periodic message.
        """
        busy = self._drain()
        period = self.stepper.role.period
        due = self.now - self.now % period
        if busy and due >= 0 and (due > self._stepped or last or not self.stepper.ports):
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


class ObservingNode(ABC):
    """A process outside the barrier: it takes in what comes until the conductor ends the run."""

    def __init__(self, service: Service, member: Member) -> None:
        self._service = service
        self._member = member
        self._link = ConductorLink(member, OBSERVERS_STAY_S)
        self._reports = Reports(member)
        self._observed = frozenset(role.name for role in member.rules.roles.values() if not role.observer)

    @abstractmethod
    def _drain(self) -> bool:
        """Takes in what has come; whether anything has."""

    @abstractmethod
    def _reached(self) -> int:
        """The tick [ns] up to which everything was taken in."""

    @abstractmethod
    def _missing(self) -> list[str]:
        """What has not been heard of before the run begins."""

    @abstractmethod
    def _details(self) -> dict[str, Any]:
        """Counts for the last report."""

    def _report(self) -> None:
        self._reports.progress(self._reached())

    @abstractmethod
    def _obey(self, message: Any) -> None:
        """Does what the conductor says, other than to begin and to end."""

    def run(self) -> None:
        """Observes until the conductor ends the run, and has its service finish in any case.

        Raises RunAborted when the conductor is lost and all who are observed have left, KeyboardInterrupt when asked to leave.
        """
        try:
            while True:
                busy = self._drain()
                message = self._link.poll()
                if message is None:
                    if not busy:
                        if self._link.lost and not self._member.alive(self._observed):
                            raise RunAborted(self._link.lost)
                        sleep(IDLE_S)
                    self._report()
                elif message.command == RunControl.HELLO:
                    self._hello()
                elif message.command == RunControl.END:
                    break
                else:
                    if message.command == RunControl.LOST:
                        self._observed -= {message.role}
                    self._obey(message)
            self._take_the_rest()
        except RunAborted as ended:
            log.warning("run aborted: %s", ended)
            self._take_the_rest()
            self._service.finish()
            raise
        except KeyboardInterrupt:
            log.warning("run aborted: the process was asked to leave")
            self._drain()
            self._service.finish()
            raise
        except Exception:
            with suppress(Exception):
                self._service.finish()  # what was taken in is kept
            raise
        facts = dict(self._service.finish())
        self._reports.say(ServiceReport.FINISHED, self._reached(), detail={"facts": facts, **self._details()})

    def _take_the_rest(self) -> None:
        """Takes in what still comes: the conductor's word may overtake what others sent before it, by ways of their own."""
        end = monotonic() + LEAVE_S
        while self._member.alive(self._observed) and monotonic() < end:
            if not self._drain():
                sleep(IDLE_S)
        sleep(IDLE_S)  # nor are a token's end and the data before it in order
        while self._drain():
            pass

    def _hello(self) -> None:
        self._drain()
        self._reports.say(ServiceReport.READY, NEVER, detail={"missing": self._missing(), **whereabouts()})


class ObserverNode(ObservingNode):
    """One observing service in a process of its own."""

    def __init__(self, service: Service, member: Member) -> None:
        super().__init__(service, member)
        self._feeds = ObservedService(service, member)

    def _drain(self) -> bool:
        return self._feeds.drain_and_step()

    def _reached(self) -> int:
        return self._feeds.now

    def _missing(self) -> list[str]:
        return []

    def _details(self) -> dict[str, Any]:
        return {"blame": self._feeds.stepper.blame.per_step_us(), **self._feeds.counters()}

    def _obey(self, message: Any) -> None:
        if message.command == RunControl.LOST:
            self._feeds.stepper.inbox.lost_roles.add(message.role)

    def _hello(self) -> None:
        for publisher in self._feeds.publishers.values():
            publisher.hello()
        super()._hello()
