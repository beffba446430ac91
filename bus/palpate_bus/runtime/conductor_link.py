"""The conversation with the conductor: control messages and its heartbeat in, reports out.

A conductor that is gone, or whose heart has not been heard for the deadline of the contract, is lost. By the wall clock the
services then go on for a grace, in which planning lifts the arm; in lockstep no time passes without grants: they leave at once.
"""

from __future__ import annotations

import json
import logging
from time import monotonic
from typing import Any, Final

from palpate_bus.contract import Contract
from palpate_bus.messages import RunControl, ServiceReport, codec
from palpate_bus.messages.stamps import NS
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.process_state import home, runs
from palpate_bus.settings import Settings

log = logging.getLogger(__name__)

CONDUCTOR: Final = "conductor"
HEARTBEAT: Final = "palpate/heartbeat"
CONTROL_TYPE: Final = "palpation_msgs/msg/RunControl"
POLL_S = 0.05
"""How often a waiting node looks for messages of the conductor."""
PROGRESS_S = 0.2
"""How often a node reports its progress, by wall clock."""
CONDUCTOR_SILENT_S = 10.0
"""A conductor is lost after this time without a message while it has not started the run, or when it has no heartbeat."""
CONDUCTOR_AWAITED_S = 120.0
"""The same before its first message: containers on a busy machine start tens of seconds apart."""
LOCKSTEP_SILENT_S = 3.0
"""The same in lockstep, where nothing moves while nobody grants time."""
LONGEST_LOOK_S = 0.1
"""A node that has not looked for longer counts this much silence: it was itself kept from a core, and perhaps all were."""
GONE_S = 0.01
"""How often it is looked whether the conductor's token is still there, and for how long it must be missing: what the conductor
said last is under way meanwhile."""
BUSY_S = 2.0
"""A silent conductor whose process runs all the same has no core: it is lost only after this time."""
LOCKSTEP_BUSY_S = 30.0
"""The same in lockstep, where waiting costs nothing: an overloaded machine keeps a conductor from its core for seconds."""


TRANSPORT_LOST: Final = "the bus is gone: its router does not answer any more"


def longest_silence_s(rules: Contract, wallclock: bool) -> float:
    """How long [s] a conductor whose heart has begun to beat may be silent before its services take it for lost."""
    return rules.internal[HEARTBEAT].deadline / NS if wallclock else LOCKSTEP_SILENT_S


class RunAborted(RuntimeError):
    """The conductor ended the run, or is lost."""


class ConductorLink:
    """The way in: control messages and heartbeats, heard once a process."""

    def __init__(self, member: Member, grace_s: float = 0.0) -> None:
        """`grace_s` [s], in the time of the run, is how long the node goes on without a conductor that is lost."""
        self._member = member
        self._control = member.internal_subscription("palpate/control", CONTROL_TYPE)
        self._beats = member.internal_subscription(HEARTBEAT, CONTROL_TYPE)
        self._decode = codec.decoder(CONTROL_TYPE)
        wallclock = Settings.read().runtime == "wallclock"
        self._deadline_s = longest_silence_s(member.rules, wallclock)
        self._busy_s = BUSY_S if wallclock else LOCKSTEP_BUSY_S
        self._grace_s = grace_s / (Settings.read().rate or 1.0)
        self._patience_s = CONDUCTOR_AWAITED_S
        self._granted = self._beating = False
        self._said = self._beaten = 0
        """Numbers of the newest control message and heartbeat: one that comes again is no word of the conductor."""
        self._silent_s = 0.0
        self._looked = self._sought = self._lost_at = monotonic()
        self._missed = False
        """Whether the conductor's token was missing when it was looked for last."""
        self._pid = 0
        """The conductor's process, if it is one of this machine that we can look at; else 0."""
        self.lost = ""
        """Why the conductor counts as lost; empty while it lives."""
        self.told = ""
        """With which reason a message of the conductor ended the run; empty when none did."""

    def poll(self, timeout: float | None = None) -> Any | None:
        """The next control message, or None. Raises RunAborted when told so, or when the conductor was lost for the grace."""
        while (sample := self._control.get(timeout)) is not None:
            if sample.sequence <= self._said:
                self._control.garbage += 1
                continue
            self._said = sample.sequence
            try:
                message = self._decode(sample.payload)
            except codec.CodecError:
                self._control.garbage += 1
                continue
            self._granted = self._granted or message.command == RunControl.GRANT
            self._heard()
            if message.command == RunControl.ABORT:
                self.told = message.reason or "no reason given"
                raise RunAborted(message.reason)
            return message
        self._listen()
        if self.lost and monotonic() - self._lost_at >= self._grace_s:
            raise RunAborted(self.lost)
        return None

    def _heard(self) -> None:
        self._silent_s = 0.0
        self._patience_s = self._deadline_s if self._granted and self._beating else CONDUCTOR_SILENT_S
        if self.lost:
            log.warning("the conductor is back")
            self.lost = ""

    def _listen(self) -> None:
        """Takes the heartbeats that have come, and counts the silence."""
        now = monotonic()
        since, self._looked = min(now - self._looked, LONGEST_LOOK_S), now
        beat = None
        while (sample := self._beats.get(0)) is not None:
            if sample.sequence > self._beaten:
                self._beaten, beat = sample.sequence, sample
        if beat is not None:
            self._take(beat.payload)
            return
        self._silent_s += since
        if self.lost or now - self._sought < GONE_S:
            return
        self._sought = now
        before, self._missed = self._missed, CONDUCTOR in self._member.gone()
        if before and self._missed:
            self._lose(TRANSPORT_LOST if self._member.transport_lost() else "the conductor is gone")
        elif self._silent_s > self._patience_s and (self._silent_s > self._busy_s or not (self._pid and runs(self._pid))):
            self._lose(f"nothing heard of the conductor for {self._silent_s:.2f} s")

    def _take(self, beat: bytes) -> None:
        try:
            message = self._decode(beat)
        except codec.CodecError:
            self._beats.garbage += 1
            return
        if not self._beating:
            self._beating = True
            self._pid = int(message.tick) if message.reason == home() else 0
        self._heard()

    def _lose(self, why: str) -> None:
        self.lost, self._lost_at = why, monotonic()
        log.warning("%s", why)

    @property
    def garbage(self) -> int:
        """Control messages that cannot be decoded, or came again."""
        return self._control.garbage + self._beats.garbage


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

    def miss_conductor(self, tick: int, why: str) -> None:
        """Says that the conductor is lost, for one that comes back."""
        self.say(ServiceReport.PROGRESS, tick, CONDUCTOR, {"lost": why})

    def obey(self, tick: int, why: str) -> None:
        """Says that the service leaves, because a message in the conductor's name told it to."""
        self.say(ServiceReport.PROGRESS, tick, "", {"told": why})

    def progress(self, tick: int, waiting_for: str = "") -> None:
        """Reports progress if the last report is old enough, with what is suspicious about who sends to the service."""
        if monotonic() - self._last > PROGRESS_S:
            suspicions = self._member.suspicions()
            for complaint in (*self._member.complaints(), *suspicions):
                log.error("%s", complaint)
            self.say(ServiceReport.PROGRESS, tick, waiting_for, {"suspicions": suspicions} if suspicions else None)
