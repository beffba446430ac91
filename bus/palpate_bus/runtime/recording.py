"""The process of the recorder: it takes the chunks that every service sends, and reports up to which tick it has written.

The conductor grants at most a second of simulated time beyond that, so nothing is lost: at worst the run is slower.
"""

from __future__ import annotations

import logging
from time import sleep
from typing import Any, Protocol, runtime_checkable

from palpate_bus.contract import Topic
from palpate_bus.messages import RunControl, ServiceReport, codec
from palpate_bus.messages.stamps import nanoseconds
from palpate_bus.runtime.conductor_link import ConductorLink, Reports, RunAborted
from palpate_bus.runtime.lockstep import NEVER
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.observer import OBSERVERS_STAY_S, Producers
from palpate_bus.runtime.process_state import whereabouts
from palpate_bus.runtime.record_chunks import CHUNK_TYPE, unpack_chunk
from palpate_bus.service import Service

log = logging.getLogger(__name__)

IDLE_S = 0.01
CLOCK = "clock"

_decode_clock = codec.decoder("rosgraph_msgs/msg/Clock")


@runtime_checkable
class RawRecorder(Protocol):
    """A service that wants every message as bytes."""

    trouble: str
    """Why it records no more; empty while it does."""

    def record(self, topic: Topic, payload: bytes, stamp: int, sequence: int) -> None:
        """Takes one message: its row, CDR bytes, simulated stamp [ns] and sequence number."""


class RecorderNode:
    """A recorder in a process of its own."""

    def __init__(self, service: Service, member: Member) -> None:
        if not isinstance(service, RawRecorder):
            raise TypeError(f"the {service.role} service has no record(topic, payload, stamp, sequence)")
        self._service: Service = service
        self._recorder: RawRecorder = service
        self._topics = member.rules.topics
        self._link = ConductorLink(member, OBSERVERS_STAY_S)
        self._producers = Producers(member)
        self._reports = Reports(member)
        producers = [role.name for role in member.rules.roles.values() if not role.observer]
        self._chunks = {role: member.internal_subscription(f"palpate/record/{role}", CHUNK_TYPE) for role in producers}
        self._covered = dict.fromkeys(producers, NEVER)
        # Messages of observers (clock, diagnostics, operator's requests) are rare and come directly; the clock dates the others.
        observed = [topic for topic, _ in member.rules.inputs(service.role) if member.rules.roles[topic.producer].observer]
        observed.sort(key=lambda topic: topic.name != CLOCK)
        self._observed = [(topic, member.subscription(topic)) for topic in observed]
        self._clock = 0
        self._lost: set[str] = set()
        self._messages = 0
        self._garbage = 0
        self._told = ""

    @property
    def covered(self) -> int:
        """The tick [ns] up to which every living producer's messages are written."""
        return min((tick for role, tick in self._covered.items() if role not in self._lost), default=NEVER)

    def run(self) -> None:
        """Records until the conductor ends the run."""
        try:
            while True:
                busy = self._drain()
                message = self._link.poll()
                if message is None:
                    if not busy:
                        self._producers.leave_with_them(self._link.lost)
                        sleep(IDLE_S)
                    self._report()
                elif message.command == RunControl.HELLO:
                    self._drain()
                    missing = [f"palpate/record/{role}" for role, chunk in self._chunks.items() if not chunk.heard]
                    self._reports.say(ServiceReport.READY, NEVER, detail={"missing": missing, **whereabouts()})
                elif message.command == RunControl.LOST:
                    self._lost.add(message.role)
                elif message.command == RunControl.HANDOVER and message.role in self._chunks:
                    self._chunks[message.role].hand_over()
                elif message.command == RunControl.END:
                    break
            while self._drain():
                pass
        except RunAborted as aborted:
            log.warning("run aborted: %s", aborted)
            self._drain()
            self._service.finish()
            raise
        detail: dict[str, Any] = {
            "facts": dict(self._service.finish()),
            "messages": self._messages,
            "garbage": self._garbage + sum(chunk.garbage for chunk in self._chunks.values()),
        }
        self._reports.say(ServiceReport.FINISHED, max(self._covered.values()), detail=detail)

    def _report(self) -> None:
        """Reports progress, and at once, and once, that nothing is recorded any more."""
        if self._recorder.trouble != self._told:
            self._told = self._recorder.trouble
            self._reports.say(ServiceReport.PROGRESS, self.covered, detail={"suspicions": [self._told]})
        self._reports.progress(self.covered)

    def _drain(self) -> bool:
        busy = False
        for role, chunks in self._chunks.items():
            while (sample := chunks.get(0)) is not None:
                busy = True
                try:
                    tick, messages = unpack_chunk(sample.payload)
                except codec.CodecError as error:
                    log.warning("chunk of %s: %s", role, error)
                    self._garbage += 1
                    continue
                for name, payload, stamp, sequence in messages:
                    if name in self._topics:
                        self._record(self._topics[name], payload, stamp, sequence)
                    else:
                        self._garbage += 1
                self._covered[role] = tick
        return self._drain_observed() or busy

    def _drain_observed(self) -> bool:
        """Takes what observers said. It carries no simulated stamp, so it is dated by the clock that came before it."""
        busy = False
        for topic, subscription in self._observed:
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
