"""The conductor's heartbeat: it tells the services that somebody still watches over the run and would pass on an operator's stop.

A thread of its own sends it, so that no figure that is drawn and no message that is decoded keeps it back. It beats only as long
as the conductor's own loop turns: a conductor that hangs is no better than none.
"""

from __future__ import annotations

import os
from threading import Event, Thread
from time import monotonic
from typing import Final

from palpate_bus.contract import Contract
from palpate_bus.messages import RunControl, codec
from palpate_bus.messages.stamps import NS
from palpate_bus.runtime.conductor_link import CONTROL_TYPE, HEARTBEAT, longest_silence_s
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.process_state import home

HUNG_S: Final = 2.0
"""A loop that has not turned for so long hangs."""
RECENT_S: Final = 2.0
"""What happens within so long after a standstill may have come of it."""
QOS: Final = "control"
"""A late beat is worse than a lost one, and a frozen reader must not keep beats from the others."""


class Heartbeat:
    """Beats from `start` to `stop`."""

    def __init__(self, member: Member, rules: Contract, wallclock: bool) -> None:
        self._period_s = rules.internal[HEARTBEAT].period / NS
        self._deadline_s = longest_silence_s(rules, wallclock)
        self._publisher = member.internal_publisher(HEARTBEAT, CONTROL_TYPE, QOS)
        self._beat = codec.encoder(CONTROL_TYPE)(RunControl(RunControl.HEARTBEAT, os.getpid(), False, "", home()))
        self._turned = self._beaten = monotonic()
        self._missed_at = 0.0
        """When the heart beat again after it had missed beats for longer than services wait."""
        self._over = Event()
        self._thread = Thread(target=self._run, name="heartbeat", daemon=True)
        self._stood_still_s = 0.0
        self._moved_on = 0.0

    def start(self) -> None:
        """Begins to beat."""
        self._turned = self._beaten = monotonic()
        self._thread.start()

    def turn(self) -> None:
        """Says that the conductor's loop turns."""
        now = monotonic()
        stood_still_s = now - self._turned
        missed = now - self._beaten > self._deadline_s or now - self._missed_at < stood_still_s
        if stood_still_s > self._deadline_s and missed:
            self._stood_still_s, self._moved_on = stood_still_s, now
        self._turned = now

    @property
    def stood_still_s(self) -> float:
        """How long [s] the conductor has just stood still, its heart for longer than its services wait; 0 when it has not."""
        return self._stood_still_s if monotonic() - self._moved_on < RECENT_S else 0.0

    def stop(self) -> None:
        """Ends; a heart that never began has nothing to end."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        sequence = 0
        while not self._over.wait(self._period_s):
            now = monotonic()
            if now - self._turned <= HUNG_S:
                self._missed_at = now if now - self._beaten > self._deadline_s else self._missed_at
                self._beaten = now
                sequence += 1
                self._publisher.put(self._beat, sequence)
