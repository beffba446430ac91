"""The sending side of a service: a publisher for each of its topics, and chunks for the recorder if the run has one."""

from __future__ import annotations

from collections.abc import Sequence

from palpate_bus.runtime.lockstep import Sent
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.record_chunks import CHUNK_TYPE, ChunkWriter
from palpate_bus.settings import Settings


class ServiceOutput:
    """Sends what a service produces."""

    def __init__(self, member: Member) -> None:
        role = member.role
        self._publishers = {topic.name: member.publisher(topic) for topic in member.rules.outputs(role)}
        self._chunks = member.internal_publisher(f"palpate/record/{role}", CHUNK_TYPE, "event")
        self._chunk_sequence = 0
        self._writer = ChunkWriter(role, tuple(self._publishers)) if Settings.read().record != "none" else None

    def hello(self) -> None:
        """Sends the empty message that tests the edge on every topic."""
        for publisher in self._publishers.values():
            publisher.hello()
        self._chunks.hello()

    def send(self, sent: Sequence[Sent]) -> None:
        """Sends what a part of a step produced."""
        publishers = self._publishers
        for port, packet in sent:
            publishers[port.topic.name].put(packet.payload, packet.sequence)

    def record(self, sent: Sequence[Sent], t: int) -> None:
        """Passes what a step at `t` [ns] sent on to the recorder, if the run has one."""
        writer = self._writer
        if writer is not None:
            for port, packet in sent:
                writer.add(port.topic.name, packet.payload, packet.stamp, packet.sequence)
            if writer.due(t):
                self.flush(t)

    def flush(self, t: int) -> None:
        """Passes on what the recorder has not got yet."""
        if self._writer is not None:
            self._chunk_sequence += 1
            self._chunks.put(self._writer.chunk(t), self._chunk_sequence)
