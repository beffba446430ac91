"""How each service of a run is, as `diagnostic_msgs/DiagnosticStatus`: its progress, and what it violates of the contract."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping, Sequence
from time import monotonic
from typing import Any

from palpate_bus.messages import DiagnosticStatus, KeyValue
from palpate_bus.messages.stamps import NS
from palpate_bus.monitor.diagnostics import RECENT_S
from palpate_bus.monitor.health import SeenViolation
from palpate_conductor.watchdog import RoleProgress


def service_statuses(
    progress: Mapping[str, RoleProgress],
    lost: Container[str],
    silent_s: float,
    violations: Callable[[str], Sequence[SeenViolation]],
) -> list[Any]:
    """A status a service: ERROR when it is lost or violates the contract, WARN when it says nothing for `silent_s` [s].

    `violations` gives what a service violated so far, the latest last.
    """
    now = monotonic()
    statuses = []
    for role, at in progress.items():
        found = violations(role)
        level, message = _judged(at, role in lost, now - at.reported, silent_s, found, now)
        values = {
            "tick_s": f"{at.tick / NS:.3f}",
            "waiting_for": at.waiting_for,
            "report_age_s": f"{now - at.reported:.2f}",
            "violations": str(sum(seen.count for seen in found)),
        }
        pairs = [KeyValue(key, value) for key, value in values.items()]
        statuses.append(DiagnosticStatus(level, f"palpate/{role}", message, role, pairs))
    return statuses


def _judged(
    at: RoleProgress, lost: bool, silent: float, silent_s: float, found: Sequence[SeenViolation], now: float
) -> tuple[int, str]:
    if lost:
        return DiagnosticStatus.ERROR, "lost"
    if found and now - found[-1].last <= RECENT_S:
        return DiagnosticStatus.ERROR, str(found[-1].violation)
    if silent > silent_s:
        return DiagnosticStatus.WARN, f"silent for {silent:.0f} s"
    return DiagnosticStatus.OK, f"waits for {at.waiting_for}" if at.waiting_for else "runs"
