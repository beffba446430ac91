"""What `palpate doctor` looks at, as findings; `doctor_command` prints them."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from time import monotonic, sleep
from typing import Any

from palpate.live import graph
from palpate.live.connection import Joined
from palpate_bus.contract import Contract
from palpate_bus.monitor.health import TopicHealth, Violation
from palpate_bus.monitor.live import LiveMonitor
from palpate_bus.runs.announcement import versions
from palpate_bus.wire.liveliness import mismatches

POLL_S = 0.04
SHARED = Path("/dev/shm")
LITTLE_SHARED_MB = 64
"""Free shared memory below which large messages may fall back to the network."""
CLOCK_AHEAD_MS = -2.0
"""A message that is younger than this was stamped by a clock that is ahead of ours."""
SILENT_S = 5.0


class Severity(StrEnum):
    """How a finding is."""

    OK = "ok"
    WARN = "warning"
    BAD = "trouble"


@dataclass(frozen=True)
class Remark:
    """One thing that was looked at."""

    about: str
    level: Severity
    text: str


@dataclass
class Diagnosis:
    """All that was found."""

    findings: list[Remark] = field(default_factory=list)
    topics: list[TopicHealth] = field(default_factory=list)
    violations: list[tuple[Violation, int]] = field(default_factory=list)
    """Each with how often it was seen."""

    @property
    def healthy(self) -> bool:
        """Whether nothing is in trouble."""
        return not self.violations and all(finding.level is not Severity.BAD for finding in self.findings)

    def as_json(self) -> dict[str, Any]:
        """For `--json`."""
        topics = []
        for row in self.topics:
            facts = asdict(row)
            facts["topic"] = row.topic.name
            topics.append(facts)
        violations = [{**asdict(violation), "count": count} for violation, count in self.violations]
        findings = [asdict(finding) for finding in self.findings]
        return {"healthy": self.healthy, "findings": findings, "topics": topics, "violations": violations}


def examine(bus: Joined, rules: Contract, seconds: float, tell: Callable[[Violation], None] = lambda _: None) -> Diagnosis:
    """Looks at a bus for `seconds`; every violation is told as soon as it is seen."""
    live = LiveMonitor(bus.session, rules, bus.domain, bus.audible(rules), bus.target.rate)
    end = monotonic() + seconds
    try:
        while monotonic() < end:
            for violation in live.poll():
                tell(violation)
            sleep(POLL_S)
        for violation in live.poll():
            tell(violation)
        return diagnose(bus, rules, live)
    finally:
        live.close()


def diagnose(bus: Joined, rules: Contract, live: LiveMonitor) -> Diagnosis:
    """What is known by now."""
    found = list(live.graph.alive.values())
    findings = [
        *_versions(bus), *_endpoints(bus, live), *_shared_memory(bus), *_clock(live), *_who(bus, rules, live), *_processes(live),
        *_waiting(live),
    ]  # fmt: skip
    differing = mismatches(found)
    findings += [Remark("types", Severity.BAD, sentence) for sentence in differing]
    if not differing:
        findings.append(Remark("types", Severity.OK, "everyone has the same message definitions"))
    seen = [(s.violation, s.count) for s in live.monitor.active.values()]
    return Diagnosis(findings, live.monitor.health(), seen)


def _versions(bus: Joined) -> list[Remark]:
    ours = versions()
    text = f"python {platform.python_version()}, " + ", ".join(f"{name} {number}" for name, number in ours.items())
    run = bus.target.run
    if run is None:
        return [Remark("versions", Severity.OK, text)]
    other = [f"{name} {number} there, {ours.get(name)} here" for name, number in run.versions.items() if ours.get(name) != number]
    if other:
        return [Remark("versions", Severity.WARN, f"{text}; the run has {'; '.join(other)}")]
    return [Remark("versions", Severity.OK, f"{text}; the run has the same")]


def _endpoints(bus: Joined, live: LiveMonitor) -> list[Remark]:
    run, options = bus.target.run, bus.target.options
    links = {str(zid) for zid in (*bus.session.info.peers_zid(), *bus.session.info.routers_zid())}
    there = {entity.node: entity.zid for entity in live.graph.alive.values()}
    if run is None or options.mode == "client":
        where = ", ".join((*options.connect, *([options.router] if options.router else [])))
        return [Remark("endpoints", Severity.OK if links else Severity.BAD, f"{where}: {len(links)} links, domain {bus.domain}")]
    findings = []
    deaf = [role for role in run.endpoints if there.get(role) not in links]
    reached = len(run.endpoints) - len(deaf)
    text = (
        f"{run.name}, process {run.pid}, {run.runtime}, domain {bus.domain}: {reached} of {len(run.endpoints)} endpoints answer"
    )
    findings.append(Remark("endpoints", Severity.WARN if deaf else Severity.OK, text))
    findings += [Remark("endpoints", Severity.WARN, f"{role} does not answer at {run.endpoints[role]}") for role in deaf]
    return findings


def _shared_memory(bus: Joined) -> list[Remark]:
    if not bus.target.options.shared_memory:
        return [Remark("shared memory", Severity.OK, "off (PALPATE_SHARED_MEMORY=0): large messages go over the network")]
    if not SHARED.is_dir():
        return [Remark("shared memory", Severity.WARN, f"no {SHARED}: large messages go over the network")]
    state = os.statvfs(SHARED)
    free, size = state.f_bavail * state.f_frsize / 1e6, state.f_blocks * state.f_frsize / 1e6
    level = Severity.WARN if free < LITTLE_SHARED_MB else Severity.OK
    hint = "; too little for depth images and meshes: enlarge it (docker: shm_size)" if level is Severity.WARN else ""
    return [Remark("shared memory", level, f"{SHARED}: {free:.0f} MB of {size:.0f} MB free{hint}")]


def _clock(live: LiveMonitor) -> list[Remark]:
    findings = []
    time, progress = live.monitor.time.now, live.monitor.time.progress
    if time is not None:
        kind = "wall-clock" if live.monitor.rate == 1.0 else "simulated"
        moves = f"at {progress:.2f} x real time" if progress else "stands still (paused, or a service holds it up)"
        findings.append(Remark("clock", Severity.OK if progress else Severity.WARN, f"{kind} time {time / 1e9:.2f} s, {moves}"))
    else:
        findings.append(Remark("clock", Severity.WARN, "no time: no stamped message came"))
    for name, age in live.offsets.items():
        if age < CLOCK_AHEAD_MS:
            sender = live.monitor.rules.topics[name].producer
            text = f"the clock of {sender}'s host is at least {-age:.1f} ms ahead of ours ({name}); synchronise them (NTP, PTP)"
            findings.append(Remark("clock", Severity.WARN, text))
    return findings


def _who(bus: Joined, rules: Contract, live: LiveMonitor) -> list[Remark]:
    absent = graph.missing(rules, live.graph.alive.values(), bus.target.run)
    workers = [role for role in absent if not rules.roles[role].observer]
    others = [role for role in absent if rules.roles[role].observer]
    strangers = sorted(live.graph.roles() - rules.roles.keys())
    findings = [Remark("roles", Severity.BAD, f"{role} is missing: {rules.roles[role].doc}") for role in workers]
    if not workers:
        findings.append(Remark("roles", Severity.OK, "every role that works is there"))
    if others:
        findings.append(Remark("roles", Severity.OK, f"without {', '.join(others)} (observers)"))
    if strangers:
        findings.append(Remark("roles", Severity.OK, f"also there: {', '.join(strangers)}"))
    if live.graph.garbage:
        findings.append(Remark("roles", Severity.WARN, f"{live.graph.garbage} liveliness tokens are not rmw_zenoh's"))
    return findings


def _processes(live: LiveMonitor) -> list[Remark]:
    """Who shares a process with whom."""
    shared = [f"{', '.join(names)} share one" for names in graph.processes(live.graph.alive.values()) if len(names) > 1]
    return [Remark("processes", Severity.OK, "; ".join([*shared, "every other role has its own"]) if shared else "one a role")]


def _waiting(live: LiveMonitor) -> list[Remark]:
    """Who holds whom up, by what the services report of themselves."""
    findings = []
    now = monotonic()
    for role, report in sorted(live.reports.items()):
        if now - report.heard > SILENT_S:
            findings.append(Remark("progress", Severity.WARN, f"{role} has said nothing for {now - report.heard:.0f} s"))
    if live.reports and live.monitor.time.progress == 0:
        for role, report in sorted(live.reports.items()):
            wait = f"waits for {report.waiting_for}" if report.waiting_for else "waits for no service"
            findings.append(Remark("progress", Severity.WARN, f"{role} is at {report.tick / 1e9:.3f} s and {wait}"))
    elif live.reports:
        slowest = min(live.reports, key=lambda role: live.reports[role].tick)
        text = f"{len(live.reports)} services report; the last of them, {slowest}, is at {live.reports[slowest].tick / 1e9:.2f} s"
        findings.append(Remark("progress", Severity.OK, text))
    return findings
