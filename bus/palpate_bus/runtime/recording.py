"""The process of the recorder: it receives the chunks of every service and reports up to which tick it has written.

The conductor grants at most a second of simulated time beyond that, so nothing is lost, but the run may be slower.
"""

import logging
from typing import Any, Protocol, runtime_checkable

from palpate_bus.contract import Topic
from palpate_bus.messages import RunControl, ServiceReport, codec
from palpate_bus.messages.stamps import nanoseconds
from palpate_bus.runtime.lockstep import NEVER
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.observer import ObservingNode
from palpate_bus.runtime.output import CHUNK_TYPE, unpack_chunk
from palpate_bus.service import Service

log = logging.getLogger(__name__)

CLOCK = "clock"

_decode_clock = codec.decoder("rosgraph_msgs/msg/Clock")


@runtime_checkable
class RawRecorder(Protocol):
    """A service that takes every message as bytes."""

    trouble: str
    """Text on why recording stopped; empty while it continues."""

    def record(self, topic: Topic, payload: bytes, stamp: int, sequence: int) -> None:
        """Take a message: its row, CDR bytes, simulated stamp [ns] and sequence number."""


class RecorderNode(ObservingNode):
    """A recorder in a process of its own."""

    def __init__(self, service: Service, member: Member) -> None:
        if not isinstance(service, RawRecorder):
            raise TypeError(f"the {service.role} service has no record(topic, payload, stamp, sequence)")
        super().__init__(service, member)
        self._recorder: RawRecorder = service
        self._topics = member.rules.topics
        producers = [role.name for role in member.rules.roles.values() if not role.observer]
        self._chunks = {role: member.internal_subscription(f"palpate/record/{role}", CHUNK_TYPE) for role in producers}
        self._covered = dict.fromkeys(producers, NEVER)
        self._numbers = dict.fromkeys(producers, 0)
        """By role, the sequence number of the newest chunk."""
        # messages of observers (clock, diagnostics, operator's requests) are rare and come directly; the clock dates the others
        direct = [topic for topic, _ in member.rules.inputs(service.role) if member.rules.roles[topic.producer].observer]
        direct.sort(key=lambda topic: topic.name != CLOCK)
        self._direct = [(topic, member.subscription(topic)) for topic in direct]
        self._clock = 0
        self._lost: set[str] = set()
        self._messages = 0
        self._garbage = 0
        self._reported_trouble = ""

    def _reached(self) -> int:
        """Return the tick [ns] up to which the messages of every producer that is not lost are written."""
        return min((tick for role, tick in self._covered.items() if role not in self._lost), default=NEVER)

    def _missing(self) -> list[str]:
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
            self._reports.send(ServiceReport.PROGRESS, self._reached(), detail={"suspicions": [self._reported_trouble]})
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
