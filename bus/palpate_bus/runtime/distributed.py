"""Distributed lockstep: processes over zenoh, conservative synchronisation without a master in the data path.

A node hosts one service, or a group whose members exchange messages without the bus. It waits until each blocking input from
another process has advanced far enough, steps the service, and sends. A periodic topic shows by its messages that the producer
has advanced; the event topics of a producer are advanced by the Advance message that closes each of its ticks. The conductor only
grants simulated time, announces lost roles, and stops the run. A node never hangs: it leaves when the conductor is lost.
"""

import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from time import monotonic, perf_counter_ns
from typing import Any

import numpy as np

from palpate_bus.contract import Contract, Edge
from palpate_bus.messages import Advance, RunControl, ServiceReport, codec
from palpate_bus.runtime.composed import Group
from palpate_bus.runtime.conductor_link import TIMES
from palpate_bus.runtime.lockstep import NEVER, ForgedSenderError, InputBuffer, LockstepError, Outgoing, Packet, Stepper
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.node import Node, Seat
from palpate_bus.runtime.process import process_identity
from palpate_bus.service import Service
from palpate_bus.wire.transport import ReceivedSample, Sender, Subscription, dropped_by

log = logging.getLogger(__name__)


class LockstepNode(Node):
    """A group of services in distributed lockstep."""

    def __init__(self, services: Sequence[Service], members: Mapping[str, Member]) -> None:
        """`members` gives the bus member of each role."""
        contract = next(iter(members.values())).contract
        self._group = Group(services, contract)
        roles = self._group.steppers.keys()
        seats = [Seat(stepper, members[role]) for role, stepper in self._group.steppers.items()]
        super().__init__(seats, members[seats[0].role])
        self._seat = {seat.stepper: seat for seat in seats}
        self._inputs = {seat: RemoteInputs(seat.stepper, members[seat.role], roles) for seat in seats}
        self._advance_senders = {
            seat: Advances(seat.stepper, members[seat.role]) for seat in seats if awaited_elsewhere(contract, seat.role, roles)
        }
        self._horizon = NEVER
        self._last = False

    def _join(self) -> None:
        """Answer the conductor's hellos until it grants the first tick."""
        while self._horizon < 0:
            message = self._link.poll(TIMES.poll_s)
            if message is not None and message.command == RunControl.HELLO:
                for seat in self._seats:
                    seat.output.hello()
                    if seat in self._advance_senders:
                        self._advance_senders[seat].hello()
                    detail = {"missing": self._inputs[seat].missing_inputs(), "process": [one.role for one in self._seats]}
                    seat.reports.send(ServiceReport.READY, NEVER, detail={**detail, **process_identity()})
            elif message is not None:
                self._obey(message)

    def _obey(self, message: Any) -> None:
        if message.command == RunControl.GRANT:
            self._horizon = max(self._horizon, message.tick) if not message.last else message.tick
            self._last = self._last or message.last
        elif message.command == RunControl.LOST:
            log.warning("%s lost at %.3f s: %s", message.role, message.tick / 1e9, message.reason)
            for inputs in self._inputs.values():
                inputs.lose(message.role)

    def _loop(self) -> None:
        t = 0
        while self._await_horizon(t):
            for stepper in self._group.due(t):
                self._step(self._seat[stepper], t)
            self._attend()
            t += self._group.period

    def _step(self, seat: Seat, t: int) -> None:
        self._acting = seat
        self._inputs[seat].await_tick(t, self._attend)
        sent = self._step_and_send(seat, t)
        start = perf_counter_ns()
        if seat in self._advance_senders:
            self._advance_senders[seat].close(t)
        seat.output.record(sent, t)
        seat.stepper.blame.send += perf_counter_ns() - start
        seat.tick = t

    def _send(self, seat: Seat, sent: Sequence[Outgoing]) -> None:
        self._group.deliver(sent)
        seat.output.send(sent)

    def _attend(self, waiting_for: str = "") -> None:
        """Report the topic that the process waits for, and process control messages."""
        for seat in self._seats:
            seat.progress(waiting_for)
        while (message := self._link.poll()) is not None:
            self._obey(message)

    def _await_horizon(self, t: int) -> bool:
        """Wait until tick `t` is granted; return False if the run ends before it."""
        while t > self._horizon:
            if self._last:
                return False
            message = self._link.poll(TIMES.poll_s)
            if message is not None:
                self._obey(message)
            for seat in self._seats:
                seat.progress("grant")
        return True

    def _counts(self, seat: Seat) -> dict[str, Any]:
        counts = dropped_by(self._inputs[seat].subscriptions)
        if seat is self._seats[0]:
            counts["garbage"] += self._link.garbage
        return {"digests": seat.stepper.digests(), **counts}


ADVANCE_TYPE = "palpation_msgs/msg/Advance"
ANOTHER_S = 0.05
"""After a wrong sequence number: time to wait for a message that shows that two senders have one identity."""
_decode = codec.decoder(ADVANCE_TYPE)
_encode = codec.encoder(ADVANCE_TYPE)


class RemoteInputs:
    """The inputs of one service from other processes."""

    def __init__(self, stepper: Stepper, member: Member, local: Collection[str]) -> None:
        """`local` are the roles in this process, whose messages are delivered without the bus."""
        self._stepper = stepper
        self._now = member.transport.now
        self._data: dict[str, Subscription] = {}
        for name, buffer in stepper.buffers.items():
            if buffer.topic.producer in local and not buffer.topic.open:
                member.declare_observed(buffer.topic)
            else:
                self._data[name] = member.subscription(buffer.topic)
        remote = [stepper.buffers[name] for name in self._data]
        self._awaited = tuple(buffer for buffer in remote if buffer.edge is not Edge.OBSERVE)
        self._observed = tuple(buffer for buffer in remote if buffer.edge is Edge.OBSERVE)
        producers = sorted({b.topic.producer for b in self._awaited if b.edge.blocking and not b.topic.periodic})
        self._advance_inputs = {role: member.internal_subscription(f"palpate/advance/{role}", ADVANCE_TYPE) for role in producers}
        self.subscriptions = (*self._data.values(), *self._advance_inputs.values())
        self._last: dict[str, tuple[int, int]] = {}
        """Sequence number and sending time of the newest message by topic."""
        self._event_topics = {role: event_topics(member.contract, role) for role in producers}
        self._closed = dict.fromkeys(producers, 0)
        """Sequence number of the newest Advance by role."""

    def missing_inputs(self) -> list[str]:
        """Return the keys, without their hash, of the awaited inputs on which no hello was received."""
        inputs = [self._data[buffer.topic.name] for buffer in self._awaited] + list(self._advance_inputs.values())
        for subscription in inputs:
            while not subscription.hello_received and subscription.get(0) is not None:
                pass
        return [one.key.split("/RIHS01")[0] for one in inputs if not one.hello_received]

    def lose(self, role: str) -> None:
        """Stop waiting for messages of `role`."""
        self._stepper.inbox.lost_roles.add(role)
        for buffer in self._awaited:
            if buffer.topic.producer == role:
                buffer.lost = True

    def await_tick(self, t: int, idle: Callable[[str], None]) -> None:
        """Wait until the service may step at `t` [ns]; `idle` is called with the awaited topic at every timeout."""
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
        advance = self._advance_inputs.get(buffer.topic.producer) if buffer.topic.event else None
        waited = False
        sample: ReceivedSample | None = None
        while not buffer.ready(t):
            source = data if advance is None or buffer.waits_for_data else advance
            sample = source.get(0)
            if sample is None:
                waited = True
                sample = source.get(TIMES.poll_s)
            if sample is None:
                idle(buffer.topic.name)
            elif source is data:
                self._accept_or_blame_sender(buffer, sample)
            else:
                self._receive_advance(buffer.topic.producer, sample)
        if waited and sample is not None:
            duration = perf_counter_ns() - begin
            self._stepper.blame.count_wait(buffer.topic.producer, duration, self._now() - sample.sent)

    def _accept_or_blame_sender(self, buffer: InputBuffer, sample: ReceivedSample) -> None:
        """Give the buffer a message. If its number is wrong, check if two senders share an identity."""
        try:
            buffer.accept(sample.sequence, sample.payload)
        except LockstepError as error:
            last = self._last.get(buffer.topic.name)
            end = monotonic() + ANOTHER_S
            doubled = last is not None and sample.sequence <= last[0] and sample.sent != last[1]
            while not doubled and (later := self._data[buffer.topic.name].get(max(end - monotonic(), 0.0))) is not None:
                doubled = later.sequence <= sample.sequence and later.sent != sample.sent
            if doubled:
                name, reason = buffer.topic.name, f"{error}; two senders share an identity"
                text = f"{reason}: a forged or doubled sender of {name}, not a loss of {buffer.topic.producer}"
                raise ForgedSenderError(text, name) from None
            raise
        self._last[buffer.topic.name] = (sample.sequence, sample.sent)

    def _receive_advance(self, producer: str, sample: ReceivedSample) -> None:
        last = self._closed[producer]
        if sample.sequence != last + 1:
            raise LockstepError(f"palpate/advance/{producer}: expected message {last + 1}, received {sample.sequence}")
        self._closed[producer] = sample.sequence
        advance = _decode(sample.payload)
        for name, sequence in zip(self._event_topics[producer], advance.sequences, strict=True):
            buffer = self._stepper.buffers.get(name)
            if buffer is not None:
                buffer.advance(advance.tick, int(sequence))


class Advances:
    """Sends the Advance messages of one service."""

    def __init__(self, stepper: Stepper, member: Member) -> None:
        self._ports = [stepper.ports[name] for name in event_topics(member.contract, member.role)]
        self._publisher: Sender = member.internal_publisher(f"palpate/advance/{member.role}", ADVANCE_TYPE, "control")
        self._sequence = 0

    def hello(self) -> None:
        """Send the empty message that tests the edge."""
        self._publisher.hello()

    def close(self, t: int) -> None:
        """Close the tick `t` [ns]."""
        self._sequence += 1
        message: Any = Advance(t, np.array([port.sequence for port in self._ports], np.uint32))
        self._publisher.put(_encode(message), self._sequence)


def event_topics(contract: Contract, role: str) -> tuple[str, ...]:
    """Return the event topics of a role in contract order, the order of Advance.sequences."""
    return tuple(topic.name for topic in contract.outputs(role) if topic.event)


def awaited_elsewhere(contract: Contract, role: str, local: Collection[str]) -> bool:
    """Return True if a role in another process waits for an event topic of the role."""
    readers = [reader for name in event_topics(contract, role) for reader in contract.topics[name].readers.items()]
    return any(edge.blocking and reader not in local for reader, edge in readers)
