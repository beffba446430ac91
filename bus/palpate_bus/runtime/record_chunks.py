"""Chunks for the recorder: a service collects the messages that it sent and passes them on together.

At 1 kHz a subscriber of every topic would cost each producer another send a message and the recorder a wake-up each. A chunk
every 50 simulated milliseconds carries the same bytes.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from palpate_bus.contract import MS
from palpate_bus.messages import RecordChunk, codec

CHUNK_TYPE = "palpation_msgs/msg/RecordChunk"
CHUNK_PERIOD = 50 * MS
CHUNK_BYTES = 1 << 22

_encode = codec.encoder(CHUNK_TYPE)
_decode = codec.decoder(CHUNK_TYPE)


class ChunkMessage(NamedTuple):
    """One message out of a chunk."""

    topic: str
    payload: bytes
    stamp: int
    sequence: int


class ChunkWriter:
    """Collects what one role sends and makes chunks of it."""

    def __init__(self, role: str, topics: tuple[str, ...]) -> None:
        self._role = role
        self._topics = topics
        self._index = {name: index for index, name in enumerate(topics)}
        self._sent: list[tuple[str, bytes, int, int]] = []
        self._bytes = 0
        self._next = CHUNK_PERIOD

    def add(self, topic: str, payload: bytes, stamp: int, sequence: int) -> None:
        """Takes a message that was sent."""
        self._sent.append((topic, payload, stamp, sequence))
        self._bytes += len(payload)

    def due(self, t: int) -> bool:
        """Whether a chunk is due at tick `t` [ns]."""
        return t >= self._next or self._bytes > CHUNK_BYTES

    def chunk(self, t: int) -> bytes:
        """What was sent since the last chunk, up to tick `t` [ns], in CDR."""
        self._next = t + CHUNK_PERIOD
        topics, payloads, stamps, sequences = zip(*self._sent, strict=True) if self._sent else ((), (), (), ())
        message = RecordChunk(
            self._role,
            t,
            list(self._topics),
            np.fromiter(map(self._index.__getitem__, topics), np.uint16),
            np.array(stamps, np.int64),
            np.array(sequences, np.uint32),
            np.fromiter(map(len, payloads), np.uint32),
            np.frombuffer(b"".join(payloads), np.uint8),
        )
        self._sent.clear()
        self._bytes = 0
        return _encode(message)


def unpack_chunk(payload: bytes) -> tuple[int, Iterator[ChunkMessage]]:
    """The tick [ns] that a chunk covers, and its messages. Raises CodecError when it is none, or not one piece."""
    chunk = _decode(payload)
    data = chunk.data.tobytes()
    columns = (chunk.topic.tolist(), chunk.stamp.tolist(), chunk.sequence.tolist(), chunk.length.tolist())
    if len({len(column) for column in columns}) != 1:
        raise codec.CodecError(f"{CHUNK_TYPE}: columns of {', '.join(str(len(column)) for column in columns)} messages")
    if sum(columns[3]) != len(data):
        raise codec.CodecError(f"{CHUNK_TYPE}: messages of {sum(columns[3])} bytes in {len(data)} bytes")
    if columns[1] and min(columns[1]) < 0:
        raise codec.CodecError(f"{CHUNK_TYPE}: a message of {min(columns[1])} ns, before the start")
    if columns[0] and max(columns[0]) >= len(chunk.topics):
        raise codec.CodecError(f"{CHUNK_TYPE}: a message of topic {max(columns[0])} of {len(chunk.topics)}")

    def messages() -> Iterator[ChunkMessage]:
        begin = 0
        for topic, stamp, sequence, length in zip(*columns, strict=True):
            yield ChunkMessage(chunk.topics[topic], data[begin : begin + length], stamp, sequence)
            begin += length

    return int(chunk.tick), messages()
