"""What a service in lockstep hears from other processes, and how it waits for it.

A periodic topic is its own announcement that the producer has advanced. The event topics of a producer are advanced by the
Advance message that closes each of its ticks.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from time import monotonic, perf_counter_ns
from typing import Any

import numpy as np

from palpate_bus.contract import Contract, Edge
from palpate_bus.messages import Advance, codec
from palpate_bus.runtime.conductor_link import POLL_S
from palpate_bus.runtime.lockstep import InputBuffer, LockstepError, Packet, Stepper
from palpate_bus.runtime.member import Member
from palpate_bus.wire.transport import ReceivedSample, Sender, Subscription

ADVANCE_TYPE = "palpation_msgs/msg/Advance"
ANOTHER_S = 0.05
"""How long it is waited, once a number is wrong, for a message that shows that two senders have one identity."""
_decode = codec.decoder(ADVANCE_TYPE)
_encode = codec.encoder(ADVANCE_TYPE)


class RemoteInputs:
    """The inputs of one service that other processes send."""

    def __init__(self, stepper: Stepper, member: Member, beside: Collection[str]) -> None:
        """`beside` are the roles in this process: what they send is handed over without the bus."""
        self._stepper = stepper
        self._now = member.transport.now
        self._rules = member.rules
        self._data: dict[str, Subscription] = {}
        for name, buffer in stepper.buffers.items():
            if buffer.topic.producer in beside and not buffer.topic.open:
                member.observed(buffer.topic)
            else:
                self._data[name] = member.subscription(buffer.topic)
        remote = [stepper.buffers[name] for name in self._data]
        self._awaited = tuple(buffer for buffer in remote if buffer.edge is not Edge.OBSERVE)
        self._observed = tuple(buffer for buffer in remote if buffer.edge is Edge.OBSERVE)
        producers = sorted({b.topic.producer for b in self._awaited if b.edge.blocking and not b.topic.periodic})
        self._advances = {role: member.internal_subscription(f"palpate/advance/{role}", ADVANCE_TYPE) for role in producers}
        self._last: dict[str, tuple[int, int]] = {}
        """By topic, number and sending time of its newest message."""
        self._event_topics = {role: event_topics(self._rules, role) for role in producers}
        self._closed = dict.fromkeys(producers, 0)
        """By role, the number of its newest Advance."""

    def unheard(self) -> list[str]:
        """The keys, without their hash, of the awaited inputs on which no hello has come."""
        inputs = [self._data[buffer.topic.name] for buffer in self._awaited] + list(self._advances.values())
        for subscription in inputs:
            while not subscription.heard and subscription.get(0) is not None:
                pass
        return [one.key.split("/RIHS01")[0] for one in inputs if not one.heard]

    def lose(self, role: str) -> None:
        """Nothing more comes from `role`."""
        self._stepper.inbox.lost_roles.add(role)
        for buffer in self._awaited:
            if buffer.topic.producer == role:
                buffer.lost = True

    def await_tick(self, t: int, idle: Callable[[str], None]) -> None:
        """Waits until the service may step at `t` [ns]; `idle` is told the awaited topic now and then."""
        for buffer in self._awaited:
            if not buffer.ready(t):
                self._await(buffer, t, idle)
        for buffer in self._observed:
            data = self._data[buffer.topic.name]
            while (sample := data.get(0)) is not None:
                buffer.deliver(Packet(sample.payload, t, sample.sequence))

    def _await(self, buffer: InputBuffer, t: int, idle: Callable[[str], None]) -> None:
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
                idle(buffer.topic.name)
            elif source is data:
                self._accept(buffer, sample)
            else:
                self._settle(buffer.topic.producer, sample)
        if waited and sample is not None:
            duration = perf_counter_ns() - begin
            self._stepper.blame.waited(buffer.topic.producer, duration, self._now() - sample.sent)

    def _accept(self, buffer: InputBuffer, sample: ReceivedSample) -> None:
        """Gives the buffer a message. Where its number is wrong, looks whether two number their messages under one identity."""
        try:
            buffer.accept(sample.sequence, sample.payload)
        except LockstepError as error:
            last = self._last.get(buffer.topic.name)
            end = monotonic() + ANOTHER_S
            doubled = last is not None and sample.sequence <= last[0] and sample.sent != last[1]
            while not doubled and (later := self._data[buffer.topic.name].get(max(end - monotonic(), 0.0))) is not None:
                doubled = later.sequence <= sample.sequence and later.sent != sample.sent
            if doubled:
                raise LockstepError(
                    f"{error}; two senders number their messages under one identity: a forged or doubled sender of "
                    f"{buffer.topic.name}, not a loss of {buffer.topic.producer}"
                ) from None
            raise
        self._last[buffer.topic.name] = (sample.sequence, sample.sent)

    def _settle(self, producer: str, sample: ReceivedSample) -> None:
        last = self._closed[producer]
        if sample.sequence != last + 1:
            raise LockstepError(f"palpate/advance/{producer}: message {sample.sequence} came after {last}")
        self._closed[producer] = sample.sequence
        advance = _decode(sample.payload)
        for name, sequence in zip(self._event_topics[producer], advance.sequences, strict=True):
            buffer = self._stepper.buffers.get(name)
            if buffer is not None:
                buffer.advance(advance.tick, int(sequence))

    def counts(self) -> dict[str, int]:
        """Messages that were set aside: `garbage`, `foreign` ones of another sender, and `forged` ones with a wrong tag."""
        subscriptions = (*self._data.values(), *self._advances.values())
        return {kind: sum(getattr(s, kind) for s in subscriptions) for kind in ("garbage", "foreign", "forged")}


class Advances:
    """The Advance messages of one service."""

    def __init__(self, stepper: Stepper, member: Member) -> None:
        self._ports = [stepper.ports[name] for name in event_topics(member.rules, member.role)]
        self._publisher: Sender = member.internal_publisher(f"palpate/advance/{member.role}", ADVANCE_TYPE, "control")
        self._sequence = 0

    def hello(self) -> None:
        """Sends the empty message that tests the edge."""
        self._publisher.hello()

    def close(self, t: int) -> None:
        """Closes the tick `t` [ns]."""
        self._sequence += 1
        message: Any = Advance(t, np.array([port.sequence for port in self._ports], np.uint32))
        self._publisher.put(_encode(message), self._sequence)


def event_topics(rules: Contract, role: str) -> tuple[str, ...]:
    """The event topics of a role, in contract order: the order of Advance.sequences."""
    return tuple(topic.name for topic in rules.outputs(role) if topic.event)


def awaited_elsewhere(rules: Contract, role: str, beside: Collection[str]) -> Iterator[str]:
    """The event topics of a role for which a role that is not `beside` it waits."""
    for name in event_topics(rules, role):
        readers = rules.topics[name].readers
        if any(edge.blocking and reader not in beside for reader, edge in readers.items()):
            yield name
