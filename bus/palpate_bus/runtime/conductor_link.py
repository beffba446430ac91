"""The conversation with the conductor: control messages in, reports out. A conductor that falls silent ends the run."""

from __future__ import annotations

import json
import logging
from time import monotonic
from typing import Any

from palpate_bus.messages import RunControl, ServiceReport, codec
from palpate_bus.runtime.member import Member

log = logging.getLogger(__name__)

POLL_S = 0.05
"""How often a waiting node looks for messages of the conductor."""
PROGRESS_S = 0.2
"""How often a node reports its progress, by wall clock."""
CONDUCTOR_SILENT_S = 10.0
"""A node leaves after this time without a message from the conductor."""
CONDUCTOR_AWAITED_S = 120.0
"""The same before its first message: containers on a busy machine start tens of seconds apart."""


class RunAborted(RuntimeError):
    """The conductor ended the run, or fell silent."""


class ConductorLink:
    """The way in: control messages, heard once a process."""

    def __init__(self, member: Member) -> None:
        self._control = member.internal_subscription("palpate/control", "palpation_msgs/msg/RunControl")
        self._decode = codec.decoder("palpation_msgs/msg/RunControl")
        self._last_heard = monotonic()
        self._patience = CONDUCTOR_AWAITED_S

    def poll(self, timeout: float | None = None) -> Any | None:
        """The next control message, or None. Raises RunAborted when told so or when the conductor is silent."""
        while (sample := self._control.get(timeout)) is not None:
            self._last_heard = monotonic()
            self._patience = CONDUCTOR_SILENT_S
            try:
                message = self._decode(sample.payload)
            except codec.CodecError:
                self._control.garbage += 1
                continue
            if message.command == RunControl.ABORT:
                raise RunAborted(message.reason)
            return message
        if monotonic() - self._last_heard > self._patience:
            raise RunAborted(f"no message from the conductor for {self._patience:.0f} s")
        return None

    @property
    def garbage(self) -> int:
        """Undecodable control messages."""
        return self._control.garbage


class Reports:
    """The way out: the reports of one role."""

    def __init__(self, member: Member) -> None:
        self._member = member
        self._publisher = member.internal_publisher(f"palpate/report/{member.role}", "palpation_msgs/msg/ServiceReport", "event")
        self._encode = codec.encoder("palpation_msgs/msg/ServiceReport")
        self._sequence = 0
        self._last = 0.0

    def say(self, state: int, tick: int, waiting_for: str = "", detail: object = None) -> None:
        """Sends a report now."""
        self._sequence += 1
        self._last = monotonic()
        text = "" if detail is None else json.dumps(detail)
        message = ServiceReport(state, self._member.role, tick, waiting_for, text)
        self._publisher.put(self._encode(message), self._sequence)

    def progress(self, tick: int, waiting_for: str = "") -> None:
        """Reports progress if the last report is old enough."""
        if monotonic() - self._last > PROGRESS_S:
            for complaint in self._member.complaints():
                log.error("%s", complaint)
            self.say(ServiceReport.PROGRESS, tick, waiting_for)
