"""Diagnostics of a run: the state of each service, and each topic against its row of the contract.

Outside the data path. Slow topics are received all the time. Each subscriber of a 1 kHz topic costs its producer one message per
tick, so fast topics are received one at a time, for `sample_s` every `round_s`; types, hashes and senders of all topics follow
from their liveliness tokens. `palpate doctor` receives everything at once.
"""

from collections.abc import Callable, Container, Mapping, Sequence
from itertools import cycle
from time import monotonic
from typing import Any, NamedTuple

import zenoh

from palpate_bus.contract import CONDUCTOR, Contract
from palpate_bus.messages import NS, DiagnosticStatus, KeyValue
from palpate_bus.monitor.health import RECENT_S, SeenViolation, topic_statuses
from palpate_bus.monitor.monitor import LiveMonitor
from palpate_bus.security.access import list_watched
from palpate_conductor.watchdog import RoleProgress


class ContractWatchTuning(NamedTuple):
    """When the contract's topics are received."""

    poll_s: float = 0.2
    fast_ms: float = 10
    """Topics of a shorter period are received in turn."""
    sample_s: float = 1.5
    """Time that a rate needs to be judged, and a subscription to begin."""
    round_s: float = 12.0


TUNING = ContractWatchTuning()


class ContractWatch:
    """Watches the bus of a run, whose wall-clock `rate` is None in lockstep. Call `poll` often."""

    def __init__(self, session: zenoh.Session, contract: Contract, domain: int, rate: float | None = None) -> None:
        topics = [contract.topics[name] for name in list_watched(contract)]
        received = [topic for topic in topics if topic.producer != CONDUCTOR or topic.open]  # without its own
        fast = [topic.name for topic in received if topic.periodic and topic.period_ms < TUNING.fast_ms]
        self._slow = [topic.name for topic in received if topic.name not in fast]
        self._turns = cycle(fast)
        self._live = LiveMonitor(session, contract, domain, self._slow, rate)
        self._polled = self._round = monotonic()
        self._sampling = False

    def poll(self, *, force: bool = False) -> None:
        """Process what was received, at most every `poll_s` unless forced, and switch to the next fast topic when it is due."""
        now = monotonic()
        if now - self._polled < TUNING.poll_s and not force:
            return
        self._polled = now
        self._live.poll()
        if not self._sampling and now - self._round >= TUNING.round_s - TUNING.sample_s:
            self._sampling, self._round = True, now
            self._live.listen([*self._slow, next(self._turns)])
        elif self._sampling and now - self._round >= TUNING.sample_s:
            self._sampling, self._round = False, now
            self._live.listen(self._slow)

    def statuses(self) -> list[Any]:
        """Return a `diagnostic_msgs/DiagnosticStatus` of every topic."""
        monitor = self._live.monitor
        return topic_statuses(monitor.health(), monitor.active.values(), monotonic())

    def violations(self, sender: str) -> list[SeenViolation]:
        """Return the violations of a sender, the latest last."""
        found = (seen for seen in self._live.monitor.active.values() if seen.violation.sender == sender)
        return sorted(found, key=lambda seen: seen.last)

    def close(self) -> None:
        """Close the subscriptions."""
        self._live.close()


def service_statuses(
    progress: Mapping[str, RoleProgress],
    lost: Container[str],
    silent_s: float,
    violations: Callable[[str], Sequence[SeenViolation]],
) -> list[Any]:
    """Return a status per service: ERROR if it is lost or violates the contract, WARN if it has not reported for `silent_s` [s].

    `violations` gives those of a service so far, the latest last.
    """
    now = monotonic()
    statuses = []
    for role, at in progress.items():
        found = violations(role)
        level, message = _judge(at, role in lost, now - at.reported, silent_s, found, now)
        values = [KeyValue("tick_s", f"{at.tick / NS:.3f}"), KeyValue("waiting_for", at.waiting_for)]
        values.append(KeyValue("report_age_s", f"{now - at.reported:.2f}"))
        values.append(KeyValue("violations", str(sum(seen.count for seen in found))))
        statuses.append(DiagnosticStatus(level, f"palpate/{role}", message, role, values))
    return statuses


def _judge(
    at: RoleProgress, lost: bool, silent: float, silent_s: float, found: Sequence[SeenViolation], now: float
) -> tuple[int, str]:
    if lost:
        return DiagnosticStatus.ERROR, "lost"
    if found and now - found[-1].last <= RECENT_S:
        return DiagnosticStatus.ERROR, str(found[-1].violation)
    if silent > silent_s:
        return DiagnosticStatus.WARN, f"silent for {silent:.0f} s"
    return DiagnosticStatus.OK, f"waits for {at.waiting_for}" if at.waiting_for else "runs"
