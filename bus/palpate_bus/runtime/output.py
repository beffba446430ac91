"""The sending side of a service: a publisher for each of its topics, and chunks for the recorder if the run has one.

A service collects its messages and sends them to the recorder together: at 1 kHz a subscriber of every topic would cost each
producer another send per message and the recorder a wake-up each. A chunk every 50 simulated milliseconds has the same bytes.
"""

from collections.abc import Iterator, Sequence
from itertools import accumulate, pairwise

import numpy as np

from palpate_bus.messages import MS, RecordChunk, codec
from palpate_bus.runtime.lockstep import Outgoing
from palpate_bus.runtime.member import Member
from palpate_bus.settings import Settings

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
