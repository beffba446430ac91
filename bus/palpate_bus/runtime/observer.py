"""The process of an observer: outside the barrier, it receives messages and never slows a producer.

It receives the newest messages of periodic topics and every message of the others. A recorder receives the chunks of every
service and reports up to which tick it has written; the conductor grants at most a second of simulated time beyond that, so
nothing is lost, but the run may be slower.
"""

import logging
from collections import Counter
from contextlib import suppress
from time import monotonic, sleep
from typing import Any, NamedTuple, Protocol, runtime_checkable

import zenoh

from palpate_bus.contract import Topic
from palpate_bus.contract.port_check import PortCheck, RefusedMessage
from palpate_bus.messages import RunControl, ServiceReport, codec, nanoseconds
from palpate_bus.runtime.conductor_link import ConductorLink, Reports, RunAborted
from palpate_bus.runtime.lockstep import NEVER, Packet, Stepper
from palpate_bus.runtime.member import CHUNK_TYPE, Member, unpack_chunk
from palpate_bus.runtime.process import process_identity
from palpate_bus.service import Service
from palpate_bus.wire.rmw import WireError, unpack
from palpate_bus.wire.transport import subscribe

log = logging.getLogger(__name__)


class ObserverLimits(NamedTuple):
    """Times and queue lengths of an observer."""

    idle_s: float = 0.005
    ring: int = 64
    """Messages kept of a periodic topic: enough for one period of an observer at 1 kHz."""
    fifo: int = 1 << 17
    leave_s: float = 2.0
    """Limit for observed services to leave after the end of the run; they leave at once."""
    stay_s: float = 8.0
    """Limit without a conductor: longer than that of the observed services, see `wallclock`."""


LIMITS = ObserverLimits()


class _Feed:
    """One observed topic."""

    def __init__(self, member: Member, topic: Topic, lossless: bool) -> None:
        self.topic = topic
        key = member.declare_observed(topic)
        channel: Any = zenoh.handlers.FifoChannel(LIMITS.fifo) if lossless else zenoh.handlers.RingChannel(LIMITS.ring)
        self._subscriber = subscribe(member.session, key, channel, history=topic.latched)
        self._try = self._subscriber.handler.try_recv
        self._decode = codec.decoder(topic.type)
        self._check = PortCheck(topic)
        self._refuse = member.note_refused
        self.sequence = 0
        self.missed = 0
        self.dropped = Counter(garbage=0, forged=0, refused=0)
        self._tags = member.transport.tag_check(key)

    def drain(self) -> list[tuple[int, bytes, codec.Message]]:
        """Return the messages since the last call: (sequence, payload, message)."""
        received = []
        while (sample := self._try()) is not None:
            try:
                attachment, payload = sample.attachment.to_bytes(), sample.payload.to_bytes()
                sequence, sent, _ = unpack(attachment)
                if self._tags is not None and not self._tags.is_valid(attachment, sent, payload):
                    self.dropped["forged"] += 1
                    continue
                message = self._decode(payload)
                self._check(message, (sequence - 1) * self.topic.period)
            except (WireError, AttributeError, codec.CodecError):  # of any sender: invalid bytes must not end an observer
                self.dropped["garbage"] += 1
                continue
            except RefusedMessage as refused:
                self.dropped["refused"] += 1
                self._refuse(refused)
                continue
            if sequence > self.sequence + 1 and not self.topic.open:
                self.missed += sequence - self.sequence - 1
            self.sequence = max(self.sequence, sequence)
            received.append((sequence, payload, message))
        return received


class ObservedService:
    """A service outside the barrier, with its feeds. The owner of the thread calls `drain_and_step`."""

    def __init__(self, service: Service, member: Member, lossless: bool = False) -> None:
        """`lossless` keeps every message of every topic, not only the newest of the periodic ones."""
        self.stepper = Stepper(service, member.contract, refuse=member.note_refused)
        self.feeds = [_Feed(member, one.topic, lossless or not one.topic.periodic) for one in self.stepper.buffers.values()]
        self.publishers = {name: member.publisher(port.topic) for name, port in self.stepper.ports.items()}
        self.now = NEVER
        """Newest simulated time [ns] received."""
        self._stepped = NEVER

    def drain_and_step(self, last: bool = False) -> bool:
        """Process received messages and step the service if its period has passed; return True if there were any.

        The `last` call steps for any message, since in wall-clock mode events may follow the last periodic message.
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
        """Return the numbers of dropped and missed messages, for the report."""
        counters = {kind: sum(feed.dropped[kind] for feed in self.feeds) for kind in ("garbage", "forged", "refused")}
        return {**counters, "missed": {feed.topic.name: feed.missed for feed in self.feeds if feed.missed}}


class ObserverNode:
    """One observing service in a process of its own: it receives messages until the conductor ends the run."""

    def __init__(self, service: Service, member: Member) -> None:
        self._service = service
        self._member = member
        self._link = ConductorLink(member, LIMITS.stay_s)
        self._reports = Reports(member)
        self._observed = frozenset(role.name for role in member.contract.roles.values() if not role.observer)
        self._open()

    def _open(self) -> None:
        """Open the inputs and outputs."""
        self._feeds = ObservedService(self._service, self._member)

    def _drain(self) -> bool:
        """Process received messages; return True if there were any."""
        return self._feeds.drain_and_step()

    def _reached_tick(self) -> int:
        """Return the tick [ns] up to which everything was received."""
        return self._feeds.now

    def _hello(self) -> list[str]:
        """Answer a hello on all edges; return the inputs without a sender before the run begins."""
        for publisher in self._feeds.publishers.values():
            publisher.hello()
        return []

    def _details(self) -> dict[str, Any]:
        """Return counts for the last report."""
        return {"blame": self._feeds.stepper.blame.per_step_us(), **self._feeds.counters()}

    def _report(self) -> None:
        """Report progress."""
        self._reports.progress(self._reached_tick())

    def _obey(self, message: Any) -> None:
        """Process a control message other than HELLO and END."""
        if message.command == RunControl.LOST:
            self._feeds.stepper.inbox.lost_roles.add(message.role)

    def run(self) -> None:
        """Observe until the conductor ends the run, and finish the service in any case.

        Raises RunAborted if the conductor is lost and all observed services have left, KeyboardInterrupt on SIGTERM.
        """
        try:
            while True:
                busy = self._drain()
                message = self._link.poll()
                if message is None:
                    if not busy:
                        if self._link.lost and not self._member.alive(self._observed):
                            raise RunAborted(self._link.lost)
                        sleep(LIMITS.idle_s)
                    self._report()
                elif message.command == RunControl.HELLO and message.role in ("", self._service.role):
                    self._drain()
                    self._reports.send(ServiceReport.READY, NEVER, detail={"missing": self._hello(), **process_identity()})
                elif message.command == RunControl.END:
                    break
                else:
                    if message.command == RunControl.LOST:
                        self._observed -= {message.role}
                    self._obey(message)
            self._drain_rest()
        except (RunAborted, KeyboardInterrupt) as ended:
            aborted = isinstance(ended, RunAborted)
            log.warning("run aborted: %s", ended if aborted else "by a signal")
            (self._drain_rest if aborted else self._drain)()
            self._service.finish()
            raise
        except Exception:
            with suppress(Exception):
                self._service.finish()  # received data is kept
            raise
        facts = dict(self._service.finish())
        self._reports.send(ServiceReport.FINISHED, self._reached_tick(), detail={"facts": facts, **self._details()})

    def _drain_rest(self) -> None:
        """Receive what is in transit: the conductor's message may overtake messages that others sent before it."""
        end = monotonic() + LIMITS.leave_s
        while self._member.alive(self._observed) and monotonic() < end:
            if not self._drain():
                sleep(LIMITS.idle_s)
        sleep(LIMITS.idle_s)  # a token's end and the data before it are not ordered either
        while self._drain():
            pass


CLOCK = "clock"

_decode_clock = codec.decoder("rosgraph_msgs/msg/Clock")


@runtime_checkable
class RawRecorder(Protocol):
    """A service that takes every message as bytes."""

    trouble: str
    """Text on why recording stopped; empty while it continues."""

    def record(self, topic: Topic, payload: bytes, stamp: int, sequence: int) -> None:
        """Take a message: its row, CDR bytes, simulated stamp [ns] and sequence number."""


class RecorderNode(ObserverNode):
    """A recorder in a process of its own."""

    def _open(self) -> None:
        service, member = self._service, self._member
        if not isinstance(service, RawRecorder):
            raise TypeError(f"the {service.role} service has no record(topic, payload, stamp, sequence)")
        self._recorder: RawRecorder = service
        self._topics = member.contract.topics
        producers = [role.name for role in member.contract.roles.values() if not role.observer]
        self._chunks = {role: member.internal_subscription(f"palpate/record/{role}", CHUNK_TYPE) for role in producers}
        self._covered = dict.fromkeys(producers, NEVER)
        self._numbers = dict.fromkeys(producers, 0)
        """Sequence number of the newest chunk by role."""
        # messages of observers (clock, diagnostics, operator's requests) are rare and come directly; the clock dates the others
        inputs = member.contract.inputs(self._service.role)
        direct = [topic for topic, _ in inputs if member.contract.roles[topic.producer].observer]
        direct.sort(key=lambda topic: topic.name != CLOCK)
        self._direct = [(topic, member.subscription(topic)) for topic in direct]
        self._clock = self._messages = self._garbage = 0
        self._lost: set[str] = set()
        self._reported_trouble = ""

    def _reached_tick(self) -> int:
        """Return the tick [ns] up to which the messages of every producer that is not lost are written."""
        return min((tick for role, tick in self._covered.items() if role not in self._lost), default=NEVER)

    def _hello(self) -> list[str]:
        return [f"palpate/record/{role}" for role, chunk in self._chunks.items() if not chunk.hello_received]

    def _details(self) -> dict[str, Any]:
        return {"messages": self._messages, "garbage": self._garbage + sum(chunk.garbage for chunk in self._chunks.values())}

    def _obey(self, message: Any) -> None:
        if message.command == RunControl.LOST:
            self._lost.add(message.role)
        elif message.command == RunControl.HANDOVER and message.role in self._chunks:
            self._chunks[message.role].hand_over()
            self._numbers[message.role] = 0

    def _report(self) -> None:
        """Report progress, and once, without delay, that recording stopped."""
        if self._recorder.trouble != self._reported_trouble:
            self._reported_trouble = self._recorder.trouble
            self._reports.send(ServiceReport.PROGRESS, self._reached_tick(), detail={"suspicions": [self._reported_trouble]})
        super()._report()

    def _drain(self) -> bool:
        busy = False
        for role, chunks in self._chunks.items():
            while (sample := chunks.get(0)) is not None:
                busy = True
                if sample.sequence <= self._numbers[role]:  # a duplicate
                    self._garbage += 1
                    continue
                self._numbers[role] = sample.sequence
                try:
                    tick, messages = unpack_chunk(sample.payload)
                except codec.CodecError as error:
                    log.warning("chunk of %s: %s", role, error)
                    self._garbage += 1
                    continue
                for name, payload, stamp, sequence in messages:
                    topic = self._topics.get(name)
                    if topic is not None and topic.producer == role:
                        self._record(topic, payload, stamp, sequence)
                    else:
                        self._garbage += 1
                self._covered[role] = tick
        return self._drain_direct() or busy

    def _drain_direct(self) -> bool:
        """Receive messages of observers. They have no simulated stamp and get that of the clock before them."""
        busy = False
        for topic, subscription in self._direct:
            while (sample := subscription.get(0)) is not None:
                busy = True
                if topic.name == CLOCK:
                    try:
                        self._clock = nanoseconds(_decode_clock(sample.payload).clock)
                    except codec.CodecError:
                        self._garbage += 1
                        continue
                self._record(topic, sample.payload, self._clock, sample.sequence)
        return busy

    def _record(self, topic: Topic, payload: bytes, stamp: int, sequence: int) -> None:
        self._recorder.record(topic, payload, stamp, sequence)
        self._messages += 1
