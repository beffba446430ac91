"""The contract's monitor in a run: what each topic does against its row, for `diagnostics` and so for the dashboard.

Outside the data path. Slow topics are listened to all the time. Each subscriber of a 1 kHz topic costs its producer a message a
tick, so these are listened to one at a time, for `LOOK_S` every `ROUND_S`; types, hashes and senders of all topics are known
from their liveliness tokens anyway. `palpate doctor` hears everything at once.
"""

from __future__ import annotations

from itertools import cycle
from time import monotonic
from typing import Any

import zenoh

from palpate_bus.contract import Contract
from palpate_bus.monitor.diagnostics import topic_statuses
from palpate_bus.monitor.health import SeenViolation
from palpate_bus.monitor.live import LiveMonitor
from palpate_bus.security.access import WATCHER, watched

POLL_S = 0.2
FAST_MS = 10
"""Topics of a shorter period are listened to in turn."""
LOOK_S = 1.5
"""As long as a rate needs to be judged, and the start of listening."""
ROUND_S = 12.0


class ContractWatch:
    """Watches the bus of a run, whose wall-clock `rate` is None in lockstep. `attend` it often."""

    def __init__(self, session: zenoh.Session, rules: Contract, domain: int, rate: float | None = None) -> None:
        watching = [rules.topics[name] for name in watched(rules)]
        heard = [topic for topic in watching if topic.producer != WATCHER or topic.open]  # it need not listen to itself
        fast = [topic.name for topic in heard if topic.periodic and topic.period_ms < FAST_MS]
        self._slow = [topic.name for topic in heard if topic.name not in fast]
        self._turns = cycle(fast)
        self._live = LiveMonitor(session, rules, domain, self._slow, rate)
        self._polled = self._round = monotonic()
        self._looking = False

    def attend(self) -> None:
        """Takes in what came, and listens to the next fast topic when it is its turn."""
        now = monotonic()
        if now - self._polled < POLL_S:
            return
        self.take_in()
        if not self._looking and now - self._round >= ROUND_S - LOOK_S:
            self._looking, self._round = True, now
            self._live.listen([*self._slow, next(self._turns)])
        elif self._looking and now - self._round >= LOOK_S:
            self._looking, self._round = False, now
            self._live.listen(self._slow)

    def take_in(self) -> None:
        """Takes in what came by now."""
        self._polled = monotonic()
        self._live.poll()

    def statuses(self) -> list[Any]:
        """`diagnostic_msgs/DiagnosticStatus` of every topic."""
        monitor = self._live.monitor
        return topic_statuses(monitor.health(), monitor.active.values(), monotonic())

    def of(self, sender: str) -> list[SeenViolation]:
        """What a sender violated so far, the latest last."""
        found = (seen for seen in self._live.monitor.active.values() if seen.violation.sender == sender)
        return sorted(found, key=lambda seen: seen.last)

    def close(self) -> None:
        """Stops listening."""
        self._live.close()
