"""Distributed lockstep: one service a process, over zenoh, conservative synchronisation with no master in the data path.

A node waits until each blocking input has advanced far enough, steps, and sends. The conductor only says how far simulated time
may go (grants), which roles were lost, and when to stop. A node never hangs: it leaves when the conductor falls silent.
"""

from __future__ import annotations

import logging
from time import perf_counter_ns
from typing import Any

import numpy as np

from palpate_bus.contract import Contract, Edge
from palpate_bus.messages import Advance, RunControl, ServiceReport, codec
from palpate_bus.runtime.lockstep import NEVER, InputBuffer, Received, Sent
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.node import POLL_S, Node
from palpate_bus.service import Service
from palpate_bus.wire.transport import ReceivedSample

log = logging.getLogger(__name__)


class LockstepNode(Node):
    """One service in distributed lockstep."""

    def __init__(self, service: Service, member: Member) -> None:
        super().__init__(service, member, strict=True)
        rules = member.rules
        self._role = self._stepper.role
        self._data = {name: member.subscription(buffer.topic) for name, buffer in self._stepper.buffers.items()}
        advance_type = "palpation_msgs/msg/Advance"
        producers = sorted({b.topic.producer for b in self._stepper.buffers.values() if b.edge.blocking and not b.topic.periodic})
        self._advances = {
            producer: member.internal_subscription(f"palpate/advance/{producer}", advance_type) for producer in producers
        }
        self._event_topics = {producer: _event_topics(rules, producer) for producer in producers}
        self._own_events = _event_topics(rules, service.role)
        self._advance_publisher = (
            member.internal_publisher(f"palpate/advance/{service.role}", advance_type, "control") if self._own_events else None
        )
        self._decode_advance = codec.decoder(advance_type)
        self._encode_advance = codec.encoder(advance_type)
        self._advance_sequence = 0
        self._blocking = tuple(b for b in self._stepper.buffers.values() if b.edge is not Edge.OBSERVE)
        self._observed = tuple(b for b in self._stepper.buffers.values() if b.edge is Edge.OBSERVE)
        self._horizon = NEVER
        self._last = False

    def _join(self) -> None:
        """Answers the conductor's hellos until it grants the first tick."""
        inputs = [self._data[b.topic.name] for b in self._blocking] + list(self._advances.values())
        while self._horizon < 0:
            message = self._link.poll(POLL_S)
            for subscription in inputs:
                while not subscription.heard and subscription.get(0) is not None:
                    pass
            if message is None:
                continue
            if message.command == RunControl.HELLO:
                self._output.hello()
                if self._advance_publisher is not None:
                    self._advance_publisher.hello()
                missing = [s.key.split("/RIHS01")[0] for s in inputs if not s.heard]
                self._link.report(ServiceReport.READY, NEVER, detail={"missing": missing})
            else:
                self._obey(message)

    def _obey(self, message: Any) -> None:
        if message.command == RunControl.GRANT:
            self._horizon = max(self._horizon, message.tick) if not message.last else message.tick
            self._last = self._last or message.last
        elif message.command == RunControl.LOST:
            log.warning("%s lost at %.3f s: %s", message.role, message.tick / 1e9, message.reason)
            self._stepper.inbox.lost_roles.add(message.role)
            for buffer in self._stepper.buffers.values():
                if buffer.topic.producer == message.role:
                    buffer.lost = True

    def _loop(self) -> None:
        t = 0
        period = self._role.period
        stepper, output, blocking = self._stepper, self._output, self._blocking
        while True:
            if t > self._horizon and not self._await_horizon(t):
                return
            for buffer in blocking:
                if not buffer.ready(t):
                    self._await(buffer, t)
            for buffer in self._observed:
                self._collect(buffer, t)
            everything: list[Sent] = []
            for sent in stepper.parts(t):
                start = perf_counter_ns()
                output.send(sent)
                stepper.blame.send += perf_counter_ns() - start
                everything += sent
            start = perf_counter_ns()
            output.record(everything, t)
            if self._advance_publisher is not None:
                self._advance_sequence += 1
                sequences = [stepper.ports[name].sequence for name in self._own_events]
                self._advance_publisher.put(self._encode_advance(_advance(t, sequences)), self._advance_sequence)
            stepper.blame.send += perf_counter_ns() - start
            self._tick = t
            self._link.progress(t)
            while (message := self._link.poll()) is not None:
                self._obey(message)
            t += period

    def _await_horizon(self, t: int) -> bool:
        """Waits until tick `t` is granted; False when the run ends before it."""
        while t > self._horizon:
            if self._last:
                return False
            message = self._link.poll(POLL_S)
            if message is not None:
                self._obey(message)
            self._link.progress(self._tick, "grant")
        return True

    def _await(self, buffer: InputBuffer, t: int) -> None:
        """Waits until `buffer` allows the step at `t`."""
        begin = perf_counter_ns()
        data = self._data[buffer.topic.name]
        advance = self._advances.get(buffer.topic.producer) if buffer.topic.event else None
        waited = False
        sample: ReceivedSample | None = None
        while not buffer.ready(t):
            source = data if advance is None or buffer.waits_for_data else advance
            sample = source.get(0)
            if sample is None:
                waited = True
                sample = source.get(POLL_S)
            if sample is None:
                message = self._link.poll()
                if message is not None:
                    self._obey(message)
                self._link.progress(self._tick, buffer.topic.name)
            elif source is data:
                buffer.accept(sample.sequence, sample.payload)
            else:
                self._settle(buffer.topic.producer, sample)
        if waited and sample is not None:
            duration = perf_counter_ns() - begin
            self._stepper.blame.waited(buffer.topic.producer, duration, self._now() - sample.sent)

    def _settle(self, producer: str, sample: ReceivedSample) -> None:
        advance = self._decode_advance(sample.payload)
        for name, sequence in zip(self._event_topics[producer], advance.sequences, strict=True):
            buffer = self._stepper.buffers.get(name)
            if buffer is not None:
                buffer.advance(advance.tick, int(sequence))

    def _collect(self, buffer: InputBuffer, t: int) -> None:
        """Takes what has come in on an observed topic, without waiting."""
        data = self._data[buffer.topic.name]
        while (sample := data.get(0)) is not None:
            buffer.deliver(Received(sample.payload, t, sample.sequence))

    def _counts(self) -> dict[str, Any]:
        subscriptions = (*self._data.values(), *self._advances.values())
        return {
            "digests": self._stepper.digests(),
            "garbage": sum(s.garbage for s in subscriptions) + self._link.garbage,
            "foreign": sum(s.foreign for s in subscriptions),
        }


def _event_topics(rules: Contract, role: str) -> tuple[str, ...]:
    """The event topics of a role, in contract order: the order of Advance.sequences."""
    return tuple(topic.name for topic in rules.outputs(role) if topic.event)


def _advance(tick: int, sequences: list[int]) -> Any:
    return Advance(tick, np.array(sequences, np.uint32))
