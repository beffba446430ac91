"""A service's conversation with the conductor: control messages in, reports out. A conductor that falls silent ends the run."""

from __future__ import annotations

import json
import logging
from time import monotonic
from typing import Any

from palpate_bus.messages import RunControl, ServiceReport, codec
from palpate_bus.runtime.member import Member

log = logging.getLogger(__name__)

PROGRESS_S = 0.2
"""How often a node reports its progress, by wall clock."""
CONDUCTOR_SILENT_S = 10.0
"""A node leaves after this time without a message from the conductor."""
CONDUCTOR_AWAITED_S = 120.0
"""The same before its first message: containers on a busy machine start tens of seconds apart."""


class RunAborted(RuntimeError):
    """The conductor ended the run, or fell silent."""


class ConductorLink:
    """The service's side: control messages in, reports out."""

    def __init__(self, member: Member) -> None:
        self.role = member.role
        self._member = member
        self._control = member.internal_subscription("palpate/control", "palpation_msgs/msg/RunControl")
        self._report = member.internal_publisher(f"palpate/report/{member.role}", "palpation_msgs/msg/ServiceReport", "event")
        self._sequence = 0
        self._decode = codec.decoder("palpation_msgs/msg/RunControl")
        self._encode = codec.encoder("palpation_msgs/msg/ServiceReport")
        self._last_heard = monotonic()
        self._patience = CONDUCTOR_AWAITED_S
        self._last_report = 0.0

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

    def report(self, state: int, tick: int, waiting_for: str = "", detail: object = None) -> None:
        """Sends a report now."""
        self._sequence += 1
        self._last_report = monotonic()
        text = "" if detail is None else json.dumps(detail)
        message = ServiceReport(state, self.role, tick, waiting_for, text)
        self._report.put(self._encode(message), self._sequence)

    def progress(self, tick: int, waiting_for: str = "") -> None:
        """Reports progress if the last report is old enough."""
        if monotonic() - self._last_report > PROGRESS_S:
            for complaint in self._member.complaints():
                log.error("%s", complaint)
            self.report(ServiceReport.PROGRESS, tick, waiting_for)

    @property
    def garbage(self) -> int:
        """Undecodable control messages."""
        return self._control.garbage
