"""Communication of a service with the conductor: control messages and heartbeats in, reports out.

The conductor counts as lost when its token is gone or its heartbeat is late: by the contract's deadline in wall-clock mode, by
`LinkTimes.lockstep_heartbeat_s` in lockstep. In wall-clock mode the services then continue for a grace period in which planning
lifts the arm; in lockstep they leave at once, since no time passes without grants.
"""

import json
import logging
from time import monotonic
from typing import Any, Final, NamedTuple

from palpate_bus.contract import CONDUCTOR, Contract
from palpate_bus.messages import NS, RunControl, ServiceReport, codec
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.process import is_running, pid_space
from palpate_bus.settings import Settings
from palpate_errors import RunError

log = logging.getLogger(__name__)

HEARTBEAT: Final = "palpate/heartbeat"
CONTROL_TYPE: Final = "palpation_msgs/msg/RunControl"
REPORT_TYPE: Final = "palpation_msgs/msg/ServiceReport"


class LinkTimes(NamedTuple):
    """Times of the link to the conductor."""

    poll_s: float = 0.05
    """Period at which a waiting node polls for control messages."""
    progress_s: float = 0.2
    """Period of progress reports, wall clock."""
    silent_s: float = 10.0
    """Timeout for any message before the first grant and heartbeat."""
    first_message_s: float = 120.0
    """Timeout for the first message: containers on a busy machine start tens of seconds apart."""
    wait_warning_s: float = 5.0
    """Time after which a warning reports that wait."""
    lockstep_heartbeat_s: float = 3.0
    """Timeout for the heartbeat in lockstep, where time does not advance without grants."""
    longest_poll_s: float = 0.1
    """Longest silence counted between two polls: a node that polls later was itself starved of CPU, and perhaps others too."""
    token_gone_s: float = 0.01
    """Period of checks of the conductor's token, and time for which it must be missing: a message may be in transit."""
    busy_s: float = 2.0
    """Limit for a silent conductor whose process runs, so that it is starved of CPU."""
    lockstep_busy_s: float = 30.0
    """Limit in lockstep, where waiting is safe: an overloaded machine starves a conductor for seconds."""


TIMES: Final = LinkTimes()


CONDUCTOR_LOST_LOG: Final = "conductor_lost: %s"
"""Log format of every service; `palpate faults` finds it in the logs of runs that lost their conductor."""
TRANSPORT_LOST: Final = "the router of the bus does not answer"


def longest_silence_s(contract: Contract, wallclock: bool) -> float:
    """Return the silence [s] after which a conductor that has sent a heartbeat counts as lost."""
    return contract.internal[HEARTBEAT].deadline / NS if wallclock else TIMES.lockstep_heartbeat_s


class RunAborted(RunError):
    """The conductor ended the run, or is lost."""


class ConductorLink:
    """Receives control messages and heartbeats, once per process."""

    def __init__(self, member: Member, grace_s: float = 0.0) -> None:
        """`grace_s` is the simulated time [s] for which the node continues without the conductor."""
        self._member = member
        self._control = member.internal_subscription("palpate/control", CONTROL_TYPE)
        self._beats = member.internal_subscription(HEARTBEAT, CONTROL_TYPE)
        self._decode = codec.decoder(CONTROL_TYPE)
        wallclock = Settings.read().runtime == "wallclock"
        self._deadline_s = longest_silence_s(member.contract, wallclock)
        self._busy_s = TIMES.busy_s if wallclock else TIMES.lockstep_busy_s
        self._grace_s = grace_s / (Settings.read().rate or 1.0)
        self._patience_s = TIMES.first_message_s
        self._granted = self._beating = False
        self._control_sequence = self._beat_sequence = 0
        """Last sequence numbers of control and heartbeat; duplicates are ignored."""
        self._silent_s = 0.0
        self._polled = self._checked = self._lost_at = monotonic()
        self._token_missing = False
        """True if the conductor's token was missing at the last check."""
        self._wait_reported = False
        """True if it has been said that the conductor is awaited."""
        self._pid = 0
        """The conductor's process id if we can inspect that process; else 0."""
        self.lost = ""
        """Text on why the conductor is lost; empty while it is not."""
        self.ended_by = ""
        """Reason in the control message that ended the run; empty if none did."""

    def poll(self, timeout: float | None = None) -> Any | None:
        """Return the next control message, or None.

        Raises RunAborted on an ABORT message, or if the conductor has been lost for the grace period.
        """
        while (sample := self._control.get(timeout)) is not None:
            if sample.sequence <= self._control_sequence:
                self._control.garbage += 1
                continue
            self._control_sequence = sample.sequence
            try:
                message = self._decode(sample.payload)
            except codec.CodecError:
                self._control.garbage += 1
                continue
            self._granted = self._granted or message.command == RunControl.GRANT
            self._on_message()
            if message.command == RunControl.ABORT:
                self.ended_by = message.reason or "no reason given"
                raise RunAborted(message.reason)
            return message
        self._poll_heartbeat()
        if self.lost and monotonic() - self._lost_at >= self._grace_s:
            raise RunAborted(self.lost)
        return None

    def _on_message(self) -> None:
        self._silent_s = 0.0
        self._patience_s = self._deadline_s if self._granted and self._beating else TIMES.silent_s
        if self.lost:
            log.warning("the conductor is back")
            self.lost = ""

    def _poll_heartbeat(self) -> None:
        """Process received heartbeats and count the silence."""
        now = monotonic()
        since, self._polled = min(now - self._polled, TIMES.longest_poll_s), now
        beat = None
        while (sample := self._beats.get(0)) is not None:
            if sample.sequence > self._beat_sequence:
                self._beat_sequence, beat = sample.sequence, sample
        if beat is not None:
            self._on_heartbeat(beat.payload)
            return
        self._silent_s += since
        if self._silent_s > TIMES.wait_warning_s and self._patience_s == TIMES.first_message_s and not self._wait_reported:
            self._wait_reported = True
            log.warning("waiting for the conductor, %g s at most", TIMES.first_message_s)
        if self.lost or now - self._checked < TIMES.token_gone_s:
            return
        self._checked = now
        before, self._token_missing = self._token_missing, CONDUCTOR in self._member.gone()
        if before and self._token_missing:
            self._lose(TRANSPORT_LOST if self._member.transport_lost() else "the conductor's token is gone")
        elif self._silent_s > self._patience_s and (self._silent_s > self._busy_s or not (self._pid and is_running(self._pid))):
            self._lose(f"no heartbeat for {self._silent_s:.2f} s")

    def _on_heartbeat(self, beat: bytes) -> None:
        try:
            message = self._decode(beat)
        except codec.CodecError:
            self._beats.garbage += 1
            return
        if not self._beating:
            self._beating = True
            self._pid = int(message.tick) if message.reason == pid_space() else 0
        self._on_message()

    def _lose(self, reason: str) -> None:
        self.lost, self._lost_at = reason, monotonic()
        log.warning(CONDUCTOR_LOST_LOG, reason)

    @property
    def garbage(self) -> int:
        """Control messages and heartbeats that cannot be decoded or are duplicates."""
        return self._control.garbage + self._beats.garbage


class Reports:
    """Sends the reports of one role."""

    def __init__(self, member: Member) -> None:
        self._member = member
        self._publisher = member.internal_publisher(f"palpate/report/{member.role}", REPORT_TYPE, "event")
        self._encode = codec.encoder(REPORT_TYPE)
        self._sequence = 0
        self._last = 0.0

    def send(self, state: int, tick: int, waiting_for: str = "", detail: object = None) -> None:
        """Send a report now."""
        self._sequence += 1
        self._last = monotonic()
        text = "" if detail is None else json.dumps(detail)
        message = ServiceReport(state, self._member.role, tick, waiting_for, text)
        self._publisher.put(self._encode(message), self._sequence)

    def report_conductor_lost(self, tick: int, reason: str) -> None:
        """Report that the conductor is lost, for the case that it returns."""
        self.send(ServiceReport.PROGRESS, tick, CONDUCTOR, {"conductor_lost": reason})

    def report_abort(self, tick: int, reason: str) -> None:
        """Report that the service leaves on an ABORT message, so that the conductor detects a forged one."""
        self.send(ServiceReport.PROGRESS, tick, "", {"ended_by": reason})

    def progress(self, tick: int, waiting_for: str = "") -> None:
        """Report progress if the last report is old enough, with new suspicions about senders."""
        if monotonic() - self._last > TIMES.progress_s:
            suspicions = self._member.suspicions()
            for complaint in (*self._member.complaints(), *suspicions):
                log.error("%s", complaint)
            self.send(ServiceReport.PROGRESS, tick, waiting_for, {"suspicions": suspicions} if suspicions else None)
