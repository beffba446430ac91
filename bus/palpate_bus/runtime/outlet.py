"""What a service sends: one publisher a topic, and the chunks for the recorder when the run has one."""

from __future__ import annotations

from collections.abc import Sequence

from palpate_bus.runtime.lockstep import Sent
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.spool import CHUNK_TYPE, Spool, recording


class Outlet:
    """The sending side of a node."""

    def __init__(self, member: Member) -> None:
        role = member.role
        self._publishers = {topic.name: member.publisher(topic) for topic in member.rules.outputs(role)}
        self._chunks = member.internal_publisher(f"palpate/record/{role}", CHUNK_TYPE, "event")
        self._chunk_sequence = 0
        self._spool = Spool(role, tuple(self._publishers)) if recording() else None

    def hello(self) -> None:
        """Tests every edge."""
        for publisher in self._publishers.values():
            publisher.hello()
        self._chunks.hello()

    def send(self, sent: Sequence[Sent]) -> None:
        """Sends what a part of a step produced."""
        publishers = self._publishers
        for port, payload, sequence in sent:
            publishers[port.topic.name].put(payload, sequence)

    def record(self, sent: Sequence[Sent], t: int) -> None:
        """Passes what a step at `t` [ns] sent on to the recorder, if the run has one."""
        spool = self._spool
        if spool is not None:
            for port, payload, sequence in sent:
                spool.add(port.topic.name, payload, t, sequence)
            if spool.due(t):
                self.flush(t)

    def flush(self, t: int) -> None:
        """Passes on what the recorder has not got yet."""
        if self._spool is not None:
            self._chunk_sequence += 1
            self._chunks.put(self._spool.chunk(t), self._chunk_sequence)
