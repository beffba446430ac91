"""Conservative synchronisation of one service, without any transport (Chandy and Misra 1979; Bryant 1977).

A `Stepper` holds a service's input buffers and output ports. A message of a periodic topic carries its simulated time in its
sequence number, (sequence - 1) * period; those of an event topic get theirs from the Advance message that closes a tick. So the
wire format stays plain ROS 2, and inputs are consumed in (stamp, topic, sequence) order in whatever order they are received.
"""

import hashlib
import struct
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from time import perf_counter_ns

from palpate_bus.contract import Contract, Edge, Topic
from palpate_bus.contract.port_check import PortCheck, RefusedMessage
from palpate_bus.messages import Message, codec
from palpate_bus.service import Outbox, Service
from palpate_errors import RunError


@dataclass(slots=True)
class Blame:
    """Wall time [ns] of one service by activity, and waiting time by role."""

    compute: int = 0
    """Time in `step`, without decoding."""
    encode: int = 0
    decode: int = 0
    send: int = 0
    transport: int = 0
    """Transit time of the messages that ended a wait."""
    wait: int = 0
    """Waiting for other services to step, without transport."""
    steps: int = 0
    waited_for: dict[str, int] = field(default_factory=dict)
    """Waiting time [ns] by the role whose message ended the wait."""

    def count_wait(self, role: str, duration: int, transport: int) -> None:
        """Count one wait [ns] that ended with a message of `role`, whose transit took `transport` [ns]."""
        transport = min(max(transport, 0), duration)
        self.transport += transport
        self.wait += duration - transport
        self.waited_for[role] = self.waited_for.get(role, 0) + duration - transport

    def per_step_us(self) -> dict[str, object]:
        """Return means in microseconds per step, for the report."""
        steps = max(self.steps, 1)
        spent = {name: getattr(self, name) for name in ("compute", "decode", "encode", "send", "transport", "wait")}
        waits = sorted(self.waited_for.items(), key=lambda item: -item[1])
        means, waited = ({name: round(ns / steps / 1e3, 2) for name, ns in rows} for rows in (spent.items(), waits))
        return {**means, "steps": self.steps, "waited_for": waited}


_CHAIN = struct.Struct("<qqq")
_CHAIN_NS = 64_000_000
"""Simulated time [ns] over which messages are gathered before they are hashed."""
NEVER = -1
"""Tick before the first."""


class LockstepError(RunError):
    """A sequence has a gap, or a service breaks its contract."""

    def __init__(self, text: str, topic: str = "") -> None:
        super().__init__(text)
        self.topic = topic


class ForgedSenderError(LockstepError):
    """Two senders use one identity."""


class Packet:
    """A message as bytes with its stamp [ns] and sequence number; decoded at first access unless the message is known.

    `payload` is empty if only readers in this process need the message. `checked` is True if it was checked against the contract.
    """

    __slots__ = ("checked", "message", "payload", "sequence", "stamp")

    def __init__(self, payload: bytes, stamp: int, sequence: int, message: Message | None = None, checked: bool = False) -> None:
        self.payload = payload
        self.stamp = stamp
        self.sequence = sequence
        self.message = message
        self.checked = checked


class InputBuffer:
    """Received messages of one topic, and the progress of its producer.

    `advanced` is the producer's tick [ns] up to which all messages of the topic are here; `new` are the messages of the current
    step, `pending` those of later ones.
    """

    __slots__ = (
        "_blocks", "_last_sequence", "_latched", "_pending_advances", "_periodic", "_unstamped",
        "advanced", "check", "decode", "delay", "edge", "grid", "latest", "lost", "new", "pending", "period", "topic",
    )  # fmt: skip

    def __init__(self, topic: Topic, edge: Edge, producer_period: int) -> None:
        self.topic = topic
        self.edge = edge
        self.period = topic.period
        self.delay = topic.period if edge is Edge.PREVIOUS else 0
        self.grid = topic.period if topic.periodic else producer_period
        self.decode = codec.decoder(topic.type)
        self.check = PortCheck(topic)
        self.advanced = NEVER
        self.latest: Packet | None = None
        self.new: list[Packet] = []
        self.lost = False
        self._blocks, self._latched, self._periodic = edge.blocking, edge is Edge.LATCHED, topic.periodic
        self.pending: deque[Packet] = deque()
        self._unstamped: deque[Packet] = deque()
        self._pending_advances: deque[tuple[int, int]] = deque()
        self._last_sequence = 0

    def ready(self, t: int) -> bool:
        """True if this topic allows the reader to step at `t`: its producer has reached the newest tick that is read then."""
        if self.lost:
            return True
        if not self._blocks:
            return not self._latched or self.holds_any
        limit = t - self.delay
        return limit < 0 or self.advanced >= limit - limit % self.grid

    def accept(self, sequence: int, payload: bytes) -> None:
        """Take a received message. Raises LockstepError if one before it is missing."""
        if sequence != self._last_sequence + 1:
            name, last = self.topic.name, self._last_sequence
            missing = f"messages {last + 1}..{sequence - 1} of {self.topic.producer} are missing"
            cause = missing if sequence > last else f"sequence {sequence} is a duplicate after {last}"
            raise LockstepError(f"{name}: {cause}", name)
        self._last_sequence = sequence
        if self._periodic:
            stamp = (sequence - 1) * self.period
            self.pending.append(Packet(payload, stamp, sequence))
            self.advanced = stamp
        elif self.topic.latched:
            self.pending.append(Packet(payload, 0, sequence))
        else:
            self._unstamped.append(Packet(payload, NEVER, sequence))
            self._stamp_pending()

    def advance(self, tick: int, sequence: int) -> None:
        """Record that the producer has finished `tick` and has sent `sequence` messages of this event topic so far."""
        self._pending_advances.append((tick, sequence))
        self._stamp_pending()

    def _stamp_pending(self) -> None:
        while self._pending_advances and self._pending_advances[0][1] <= self._last_sequence:
            tick, sequence = self._pending_advances.popleft()
            while self._unstamped and self._unstamped[0].sequence <= sequence:
                packet = self._unstamped.popleft()
                packet.stamp = tick
                self.pending.append(packet)
            self.advanced = tick

    @property
    def waits_for_data(self) -> bool:
        """True if an advance is known whose messages are not all here."""
        return bool(self._pending_advances)

    @property
    def holds_any(self) -> bool:
        """True if any message was received."""
        return bool(self.pending) or self.latest is not None

    def deliver(self, packet: Packet) -> None:
        """Take a message whose stamp is known (composed run, observers)."""
        self.pending.append(packet)
        self.advanced = packet.stamp

    def take(self, t: int) -> None:
        """Move the messages that the reader may read at `t` to `new` and `latest`."""
        limit = t - self.delay
        pending = self.pending
        if not pending or pending[0].stamp > limit:
            if self.new:
                self.new = []
            return
        new = self.new = [pending.popleft()]
        while pending and pending[0].stamp <= limit:
            new.append(pending.popleft())
        self.latest = new[-1]


class TickInbox:
    """The inbox of one service in lockstep, over its input buffers. Raises RefusedMessage for one that breaks the contract."""

    __slots__ = ("_blame", "_buffers", "lost_roles")

    def __init__(self, buffers: Mapping[str, InputBuffer], blame: Blame) -> None:
        self._buffers = buffers
        self._blame = blame
        self.lost_roles: set[str] = set()

    def _decode(self, buffer: InputBuffer, packet: Packet) -> Message:
        start = perf_counter_ns()
        message = packet.message = buffer.decode(packet.payload)
        if not packet.checked:
            buffer.check(message, packet.stamp)
        self._blame.decode += perf_counter_ns() - start
        return message

    def latest(self, topic: str) -> Message | None:
        """Return the newest message, or None before the first."""
        buffer = self._buffers[topic]
        packet = buffer.latest
        if packet is None:
            return None
        message = packet.message
        return self._decode(buffer, packet) if message is None else message

    def new(self, topic: str) -> list[Message]:
        """Return the messages since the step before, oldest first."""
        buffer = self._buffers[topic]
        if not buffer.new:
            return []
        return [self._decode(buffer, one) if one.message is None else one.message for one in buffer.new]

    def stamp(self, topic: str) -> int | None:
        """Return the simulated time [ns] of the newest message."""
        latest = self._buffers[topic].latest
        return None if latest is None else latest.stamp

    def lost(self, role: str) -> bool:
        """Return True if the service of `role` is lost."""
        return role in self.lost_roles


class OutputPort:
    """One topic that a service writes: its sequence number and the digest over all messages sent."""

    __slots__ = ("_digest", "_unchained", "check", "encode", "event", "here", "latched", "passed", "period", "sequence", "topic")

    def __init__(self, topic: Topic) -> None:
        self.topic = topic
        self.period = topic.period
        self.event = topic.event
        self.latched = topic.latched
        self.encode = codec.encoder(topic.type)
        self.check = PortCheck(topic, sends=True)
        self.passed: Callable[[Message], Message | None] | None = None
        """Makes the message for readers in this process."""
        self.here = False
        """True if all readers are in this process: messages are encoded for the digest only, many at once, which is faster."""
        self.sequence = 0
        self._digest = hashlib.sha256() if topic.hashed else None
        self._unchained: list[Packet] = []
        """Messages that are not in the digest yet; hashing each by itself costs more."""

    def pack(self, message: Message, t: int) -> "Outgoing":
        """Check, encode and number a message that is sent at `t` [ns]. Raises RefusedMessage."""
        self.check(message, t)
        sequence = self.sequence = self.sequence + 1
        passed = self.passed(message) if self.passed else None
        deferred = self.here and passed is not None and self._digest is not None
        packet = Packet(b"" if deferred else self.encode(message), t, sequence, passed, True)
        if self._digest is not None:
            self._unchained.append(packet)
        return self, packet

    def chain(self) -> None:
        """Add the messages packed since the last call to the digest."""
        if self._digest is not None:
            chained: list[bytes] = []
            for packet in self._unchained:
                payload = packet.payload or self.encode(packet.message)
                chained += (_CHAIN.pack(packet.stamp, packet.sequence, len(payload)), payload)
            self._digest.update(b"".join(chained))
            self._unchained.clear()

    def digest(self) -> str | None:
        """Return the hexadecimal digest, None for a topic that is not hashed."""
        self.chain()
        return None if self._digest is None else self._digest.hexdigest()


Outgoing = tuple[OutputPort, Packet]
"""A message to be sent."""


class Stepper:
    """Drives one service: buffers in, step, ports out."""

    def __init__(
        self, service: Service, contract: Contract, strict: bool = True, refuse: Callable[[RefusedMessage], None] | None = None
    ) -> None:
        """`strict` requires a message on every tick of the periodic topics, except from observers.

        `refuse` is called with each message of the service that breaks the contract and is therefore not sent; without it the
        step raises RefusedMessage.
        """
        self.service = service
        self._refuse = refuse
        self.role = contract.roles[service.role]
        inputs = contract.inputs(service.role)
        self.buffers = {row.name: InputBuffer(row, edge, contract.roles[row.producer].period) for row, edge in inputs}
        self.ports = {topic.name: OutputPort(topic) for topic in contract.outputs(service.role)}
        self.blame = Blame()
        self.inbox = TickInbox(self.buffers, self.blame)
        self._all = tuple(self.buffers.values())
        self._whole = type(service).parts is Service.parts
        periodic = tuple(port for port in self.ports.values() if not (port.event or port.latched))
        if not strict or self.role.observer:
            periodic = ()
        self._steady = tuple(port for port in periodic if port.period == self.role.period)
        self._rarer = tuple(port for port in periodic if port.period != self.role.period)
        self._period = self.role.period
        self._chain_every = max(_CHAIN_NS // self._period, 1)

    def start(self) -> list[Outgoing]:
        """Return the latched messages, packed, with stamp zero."""
        sent, outbox = [], self.service.start()
        self._check_outbox(outbox)
        for name, message in outbox.items():
            port = self._port(name)
            if not port.latched:
                raise LockstepError(f"{self.role.name} sent {name} before the first tick, which is not a latched topic")
            sent += self._pack_messages(port, (message,), 0)
        missing = [port.topic.name for port in self.ports.values() if port.latched and not port.sequence]
        if missing:
            raise LockstepError(f"{self.role.name} did not send its latched {', '.join(missing)} at start")
        return sent

    def step(self, t: int) -> list[Outgoing]:
        """Step the service at `t` [ns] and return the messages it sends, packed, in outbox order.

        Raises LockstepError if a periodic message is missing or is sent off its tick.
        """
        return [one for part in self.parts(t) for one in part]

    def parts(self, t: int) -> Iterator[list[Outgoing]]:
        """Do what `step` does, but yield the messages of each part of the step before the next is computed."""
        blame = self.blame
        begin, decoded = perf_counter_ns(), blame.decode
        for outbox in self._outboxes(t):
            stepped = perf_counter_ns()
            blame.compute += stepped - begin - (blame.decode - decoded)
            sent = self._pack_outbox(outbox, t)
            blame.encode += perf_counter_ns() - stepped
            yield sent
            begin, decoded = perf_counter_ns(), blame.decode
        self._close(t)

    def _outboxes(self, t: int) -> Iterable[Outbox]:
        """Return the outboxes of the service's step at `t` [ns], one for each part."""
        for buffer in self._all:
            if buffer.pending or buffer.new:
                buffer.take(t)
        return (self.service.step(t, self.inbox),) if self._whole else self.service.parts(t, self.inbox)

    def _close(self, t: int) -> None:
        """Check that all messages due at `t` [ns] were sent; hash if enough have gathered, now that they are on their way."""
        number = t // self._period + 1
        for port in self._steady:
            if port.sequence != number:
                raise self._missing(port, t)
        for port in self._rarer:
            if not t % port.period and port.sequence != t // port.period + 1:
                raise self._missing(port, t)
        self.blame.steps += 1
        if not self.blame.steps % self._chain_every:
            begin = perf_counter_ns()
            for port in self.ports.values():
                port.chain()
            self.blame.encode += perf_counter_ns() - begin

    def _missing(self, port: OutputPort, t: int) -> LockstepError:
        due = f"it is due every {port.period} ns; a topic that not every implementation sends is an `event` in contract.yaml"
        return LockstepError(f"{self.role.name} sent no {port.topic.name} at {t} ns: {due}")

    def _check_outbox(self, outbox: Outbox) -> None:
        """Raise LockstepError if what the service returned is not an outbox."""
        if not hasattr(outbox, "items"):
            kind = type(outbox).__name__
            raise LockstepError(f"{self.role.name} returned {kind}; expected an outbox: a dict of topics and messages")

    def _pack_outbox(self, outbox: Outbox, t: int) -> list[Outgoing]:
        if outbox.__class__ is not dict:
            self._check_outbox(outbox)
        sent: list[Outgoing] = []
        ports = self.ports
        for name, message in outbox.items():
            port = ports.get(name) or self._port(name)
            if port.event:
                sent += self._pack_messages(port, message if isinstance(message, list) else (message,), t)
            elif t % port.period:
                raise LockstepError(f"{self.role.name} sent {name} at {t} ns: not a multiple of its period ({port.period} ns)")
            elif self._refuse is None:
                sent.append(port.pack(message, t))
            else:
                sent += self._pack_messages(port, (message,), t)
        return sent

    def _pack_messages(self, port: OutputPort, messages: Iterable[Message], t: int) -> list[Outgoing]:
        """Return the messages packed, without those that are refused."""
        if self._refuse is None:
            return [port.pack(message, t) for message in messages]
        sent = []
        for message in messages:
            try:
                sent.append(port.pack(message, t))
            except RefusedMessage as refused:
                self._refuse(refused)
        return sent

    def _port(self, name: str) -> OutputPort:
        if name not in self.ports:
            allowed = f"by the contract it sends {', '.join(self.ports)}"
            raise LockstepError(f"{self.role.name} sent {name}, which is not its topic; {allowed}")
        return self.ports[name]

    def digests(self) -> dict[str, str]:
        """Return the digest of each hashed topic."""
        return {name: digest for name, port in self.ports.items() if (digest := port.digest()) is not None}


def run_hash(digests: Mapping[str, str]) -> str:
    """Return the run hash: SHA-256 over the sorted (topic, digest) pairs of all services."""
    pairs = hashlib.sha256()
    for topic, digest in sorted(digests.items()):
        pairs.update(f"{topic} {digest}\n".encode())
    return pairs.hexdigest()
