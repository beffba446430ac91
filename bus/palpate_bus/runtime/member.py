"""A role on the bus: its session, its liveliness tokens, its publishers and subscriptions by the contract, and its output.

Its declarations show in the ROS graph (`ros2 node list`, `ros2 topic info`). A peer with another type or hash of a topic never
connects. ROS 2 does not report that, so `complaints` does.

A service collects its messages and sends them to the recorder together: at 1 kHz a subscriber of every topic would cost each
producer another send per message and the recorder a wake-up each. A chunk every 50 simulated milliseconds has the same bytes.
"""

from collections.abc import Collection, Iterator, Sequence
from itertools import accumulate, pairwise
from time import monotonic

import numpy as np
import zenoh

from palpate_bus.contract import Contract, Topic
from palpate_bus.contract.port_check import RefusedMessage
from palpate_bus.messages import MS, RecordChunk, codec
from palpate_bus.runtime.lockstep import Outgoing
from palpate_bus.settings import Settings
from palpate_bus.wire.liveliness import GraphWatch, NodeTokens, mismatches
from palpate_bus.wire.rmw import message_key, topic_key
from palpate_bus.wire.transport import Sender, Subscription, Transport

CHECK_S = 0.5
"""Period at which the graph is checked for mismatches."""


class Member:
    """One role on the bus."""

    def __init__(
        self, session: zenoh.Session, role: str, contract: Contract, domain: int, transport: Transport | None = None
    ) -> None:
        """`transport` carries its messages; by default zenoh does, as the contract says."""
        self.session = session
        self.transport = transport or Transport(session)
        self.role = role
        self.contract = contract
        self.domain = domain
        self.graph = GraphWatch(session, domain)
        self._tokens = NodeTokens(session, role, domain, self.transport.ids)
        self._subscriptions: list[tuple[str, Subscription]] = []
        self._noted: list[str] = []
        self.refused_topics: set[str] = set()
        """Topics of which a message was refused."""
        self._reported: set[str] = set()
        self._routed = bool(list(session.info.routers_zid()))
        self._checked_at = 0.0
        self._changed = False

    def publisher(self, topic: Topic) -> Sender:
        """Return a publisher of a topic of the contract."""
        qos = self.contract.qos[topic.qos]
        return self.transport.publisher(topic.name, topic_key(topic, self.domain), qos, self._tokens.publisher(topic, qos))

    def subscription(self, topic: Topic, history: bool = False) -> Subscription:
        """Return a subscription to a topic of the contract; with `history`, including earlier messages of a latched topic."""
        self._tokens.subscription(topic, self.contract.qos[topic.qos])
        decode = codec.decoder(topic.type) if topic.open else None
        return self._keep(topic.name, self.transport.subscription(topic_key(topic, self.domain), history, decode))

    def declare_observed(self, topic: Topic) -> str:
        """Declare a subscription that the caller makes; return its key."""
        self._tokens.subscription(topic, self.contract.qos[topic.qos])
        return topic_key(topic, self.domain)

    def internal_publisher(self, name: str, type_name: str, qos: str) -> Sender:
        """Return a publisher of the runtime's own messages."""
        key = message_key(name, type_name, self.domain)
        return self.transport.publisher(name, key, self.contract.qos[qos], self._tokens.node.gid)

    def internal_subscription(self, name: str, type_name: str) -> Subscription:
        """Return a subscription to the runtime's own messages."""
        return self._keep(name, self.transport.subscription(message_key(name, type_name, self.domain)))

    def _keep(self, name: str, subscription: Subscription) -> Subscription:
        self._subscriptions.append((name, subscription))
        return subscription

    def note_refused(self, refused: RefusedMessage) -> None:
        """Note a message that was refused, the first of its topic."""
        if refused.topic not in self.refused_topics:
            self.refused_topics.add(refused.topic)
            self._noted.append(f"{refused}; such messages are dropped")

    def suspicions(self) -> list[str]:
        """Return new suspicions about the senders of this role's inputs, and its new notes, each once."""
        found = [f"{name}: {suspicion}" for name, subscription in self._subscriptions if (suspicion := subscription.suspicion)]
        new = [text for text in (*found, *self._noted) if text not in self._reported]
        self._noted.clear()
        self._reported.update(new)
        return new

    def transport_lost(self) -> bool:
        """Return True if all traffic went through a router that has closed, so that no silent role is at fault."""
        info = self.session.info
        return self._routed and not list(info.routers_zid()) and not list(info.peers_zid())

    def complaints(self) -> list[str]:
        """Return new mismatches of message types on the bus, each once; checks at most every `CHECK_S`."""
        now = monotonic()
        if now - self._checked_at < CHECK_S:
            return []
        self._checked_at = now
        self._update()
        if not self._changed:
            return []
        self._changed = False
        new = [text for text in mismatches(self.graph.alive.values()) if text not in self._reported]
        self._reported.update(new)
        return new

    def gone(self) -> frozenset[str]:
        """Return the roles that were on the bus and have left."""
        self._update()
        return self.graph.gone()

    def alive(self, roles: Collection[str]) -> frozenset[str]:
        """Return those of `roles` that are on the bus now."""
        self._update()
        return self.graph.roles() & frozenset(roles)

    def _update(self) -> None:
        self._changed = bool(self.graph.changes()) or self._changed

    def close(self) -> None:
        """Leave the bus: withdraw the tokens."""
        self._tokens.undeclare()
        self.graph.close()


CHUNK_TYPE = "palpation_msgs/msg/RecordChunk"
CHUNK_PERIOD = 50 * MS
CHUNK_BYTES = 1 << 22

_encode = codec.encoder(CHUNK_TYPE)
_decode = codec.decoder(CHUNK_TYPE)


class ChunkWriter:
    """Collects the messages of one role and packs them into chunks."""

    def __init__(self, role: str, topics: tuple[str, ...]) -> None:
        self._role = role
        self._topics = topics
        self._index = {name: index for index, name in enumerate(topics)}
        self._sent: list[tuple[str, bytes, int, int]] = []
        self._bytes = 0
        self._next = CHUNK_PERIOD

    def add(self, topic: str, payload: bytes, stamp: int, sequence: int) -> None:
        """Add a message."""
        self._sent.append((topic, payload, stamp, sequence))
        self._bytes += len(payload)

    def due(self, t: int) -> bool:
        """Return True if a chunk is due at tick `t` [ns]."""
        return t >= self._next or self._bytes > CHUNK_BYTES

    def chunk(self, t: int) -> bytes:
        """Return a chunk of the messages since the last one, up to tick `t` [ns], in CDR."""
        self._next = t + CHUNK_PERIOD
        topics, payloads, stamps, sequences = zip(*self._sent, strict=True) if self._sent else ((), (), (), ())
        index, length = np.fromiter(map(self._index.__getitem__, topics), np.uint16), np.fromiter(map(len, payloads), np.uint32)
        rows = index, np.array(stamps, np.int64), np.array(sequences, np.uint32), length
        self._sent.clear()
        self._bytes = 0
        return _encode(RecordChunk(self._role, t, list(self._topics), *rows, np.frombuffer(b"".join(payloads), np.uint8)))


def unpack_chunk(payload: bytes) -> tuple[int, Iterator[tuple[str, bytes, int, int]]]:
    """Return the tick [ns] that a chunk covers, and topic, payload, stamp and sequence of its messages. Raises CodecError."""
    chunk = _decode(payload)
    data = chunk.data.tobytes()
    columns = [column.tolist() for column in (chunk.topic, chunk.stamp, chunk.sequence, chunk.length)]
    topics, stamps, sequences, lengths = columns
    if len(set(map(len, columns))) != 1:
        raise codec.CodecError(f"{CHUNK_TYPE}: columns differ in length: {', '.join(str(len(column)) for column in columns)}")
    if sum(lengths) != len(data):
        raise codec.CodecError(f"{CHUNK_TYPE}: lengths sum to {sum(lengths)} bytes, the data have {len(data)}")
    if min(stamps, default=0) < 0 or max(topics, default=-1) >= len(chunk.topics):
        raise codec.CodecError(f"{CHUNK_TYPE}: stamp {min(stamps)} ns below 0, or topic {max(topics)} of {len(chunk.topics)}")
    ends = list(accumulate(lengths, initial=0))
    payloads = (data[begin:end] for begin, end in pairwise(ends))
    names = (chunk.topics[topic] for topic in topics)
    return int(chunk.tick), zip(names, payloads, stamps, sequences, strict=True)


class ServiceOutput:
    """Sends the messages of a service."""

    def __init__(self, member: Member) -> None:
        role = member.role
        self._publishers = {topic.name: member.publisher(topic) for topic in member.contract.outputs(role)}
        self._chunks = member.internal_publisher(f"palpate/record/{role}", CHUNK_TYPE, "event")
        self._chunk_sequence = 0
        self._writer = ChunkWriter(role, tuple(self._publishers)) if Settings.read().record != "none" else None

    def hello(self) -> None:
        """Send the empty message that tests the edge on every topic."""
        for publisher in self._publishers.values():
            publisher.hello()
        self._chunks.hello()

    def send(self, sent: Sequence[Outgoing]) -> None:
        """Send messages."""
        publishers = self._publishers
        for port, packet in sent:
            publishers[port.topic.name].put(packet.payload, packet.sequence)

    def record(self, sent: Sequence[Outgoing], t: int) -> None:
        """Add the messages of a step at `t` [ns] to the recorder's chunk, if the run is recorded, and send it when due."""
        writer = self._writer
        if writer is not None:
            for port, packet in sent:
                writer.add(port.topic.name, packet.payload, packet.stamp, packet.sequence)
            if writer.due(t):
                self.flush(t)

    def flush(self, t: int) -> None:
        """Send the current chunk to the recorder."""
        if self._writer is not None:
            self._chunk_sequence += 1
            self._chunks.put(self._writer.chunk(t), self._chunk_sequence)
