"""The conductor's heartbeat, by which the services detect that it is lost.

A thread sends it, so that drawing a figure or decoding a message does not delay it. It stops while the conductor's loop hangs,
since a conductor that hangs does not pass on an operator's stop.
"""

import os
from threading import Event, Thread
from time import monotonic
from typing import Final

from palpate_bus.contract import Contract
from palpate_bus.messages import RunControl, codec
from palpate_bus.messages.stamps import NS
from palpate_bus.runtime.conductor_link import CONTROL_TYPE, HEARTBEAT, longest_silence_s
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.process import pid_space

HUNG_S: Final = 2.0
"""Time after which a loop that has not turned counts as hanging."""
RECENT_S: Final = 2.0
"""Time after a standstill within which a loss may be its consequence."""
QOS: Final = "control"
"""A late beat is worse than a lost one, and a frozen reader must not delay the others' beats."""


class Heartbeat:
    """Sends beats from `start` to `stop`."""

    def __init__(self, member: Member, rules: Contract, wallclock: bool) -> None:
        self._period_s = rules.internal[HEARTBEAT].period / NS
        self._deadline_s = longest_silence_s(rules, wallclock)
        self._publisher = member.internal_publisher(HEARTBEAT, CONTROL_TYPE, QOS)
        self._message = codec.encoder(CONTROL_TYPE)(RunControl(RunControl.HEARTBEAT, os.getpid(), False, "", pid_space()))
        self._turned_at = self._sent_at = monotonic()
        self._late_at = 0.0
        """When a beat was sent that came later than the services' deadline."""
        self._stop = Event()
        self._thread = Thread(target=self._run, name="heartbeat", daemon=True)
        self._stood_still_s = 0.0
        self._resumed_at = 0.0

    def start(self) -> None:
        """Start the thread."""
        self._turned_at = self._sent_at = monotonic()
        self._thread.start()

    def loop_turned(self) -> None:
        """Record that the conductor's loop makes progress."""
        now = monotonic()
        stood_still_s = now - self._turned_at
        late = now - self._sent_at > self._deadline_s or now - self._late_at < stood_still_s
        if stood_still_s > self._deadline_s and late:
            self._stood_still_s, self._resumed_at = stood_still_s, now
        self._turned_at = now

    @property
    def stood_still_s(self) -> float:
        """Duration [s] of a recent standstill of loop and heartbeat beyond the services' deadline; 0 without one."""
        return self._stood_still_s if monotonic() - self._resumed_at < RECENT_S else 0.0

    def stop(self) -> None:
        """Stop the thread, if it was started."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        sequence = 0
        while not self._stop.wait(self._period_s):
            now = monotonic()
            if now - self._turned_at <= HUNG_S:
                self._late_at = now if now - self._sent_at > self._deadline_s else self._late_at
                self._sent_at = now
                sequence += 1
                self._publisher.put(self._message, sequence)
