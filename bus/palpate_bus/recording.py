"""The recorder's process: it takes the chunks that every service passes on, and says how far it has written.

The conductor grants at most a second of simulated time beyond that, so nothing is lost: at worst the run is slower.
"""

from __future__ import annotations

import logging
from time import sleep
from typing import Any, Protocol, runtime_checkable

from palpate_bus import codec
from palpate_bus.contract import Topic
from palpate_bus.distributed import Link, RunAborted
from palpate_bus.lockstep import NEVER
from palpate_bus.member import Member
from palpate_bus.messages import RunControl, ServiceReport
from palpate_bus.service import Service
from palpate_bus.spool import CHUNK_TYPE, unpack_chunk

log = logging.getLogger(__name__)

IDLE_S = 0.01


@runtime_checkable
class RawRecorder(Protocol):
    """A service that wants every message as bytes."""

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
        self._link = Link(member)
        producers = [role.name for role in member.rules.roles.values() if not role.observer]
        self._chunks = {role: member.internal_subscription(f"palpate/record/{role}", CHUNK_TYPE) for role in producers}
        self._covered = dict.fromkeys(producers, NEVER)
        self._lost: set[str] = set()
        self._messages = 0

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
                        sleep(IDLE_S)
                    self._link.progress(self.covered)
                elif message.command == RunControl.HELLO:
                    self._drain()
                    missing = [f"palpate/record/{role}" for role, chunk in self._chunks.items() if not chunk.heard]
                    self._link.report(ServiceReport.READY, NEVER, detail={"missing": missing})
                elif message.command == RunControl.LOST:
                    self._lost.add(message.role)
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
            "garbage": sum(chunk.garbage for chunk in self._chunks.values()),
        }
        self._link.report(ServiceReport.FINISHED, max(self._covered.values()), detail=detail)

    def _drain(self) -> bool:
        busy = False
        for role, chunks in self._chunks.items():
            while (sample := chunks.get(0)) is not None:
                busy = True
                try:
                    tick, messages = unpack_chunk(sample.payload)
                except codec.CodecError as error:
                    log.warning("chunk of %s: %s", role, error)
                    continue
                for name, payload, stamp, sequence in messages:
                    self._recorder.record(self._topics[name], payload, stamp, sequence)
                    self._messages += 1
                self._covered[role] = tick
        return busy
