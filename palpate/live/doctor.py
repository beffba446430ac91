"""`palpate doctor`: checks a live bus and names the cause of what is wrong."""

import os
import platform
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from time import monotonic, sleep
from typing import Annotated, Any, NoReturn

import typer
from rich.text import Text

from palpate.console import EXIT_TROUBLE, SteadyConsole, bandwidth, number, print_json, print_line, table, wide_console
from palpate.live import graph
from palpate.live.bus import AsJson, ChosenRun, Connect, Domain, Joined, joined
from palpate_bus.contract import contract
from palpate_bus.monitor.health import TopicHealth, Violation
from palpate_bus.monitor.monitor import LiveMonitor
from palpate_bus.runs.announcement import live as live_runs
from palpate_bus.runs.announcement import versions
from palpate_bus.runs.run_folder import remove_leftovers
from palpate_bus.wire.liveliness import mismatches

POLL_S = 0.04
SHARED_MEMORY = Path("/dev/shm")
MIN_SHARED_MEMORY_MB = 64
"""With less free shared memory, large messages may fall back to the network."""
MIN_MESSAGE_AGE_MS = -2.0
"""A message with a smaller age was stamped by a clock that is ahead of the local one."""
SILENT_S = 5.0


class Severity(StrEnum):
    """Severity of a remark."""

    OK = "ok"
    WARN = "warning"
    BAD = "trouble"


@dataclass(frozen=True)
class Remark:
    """The result of one check."""

    about: str
    level: Severity
    text: str


@dataclass
class Diagnosis:
    """All remarks, the health of each topic and the violations of the contract."""

    findings: list[Remark] = field(default_factory=list)
    topics: list[TopicHealth] = field(default_factory=list)
    violations: list[tuple[Violation, int]] = field(default_factory=list)
    """Each with its count."""

    @property
    def healthy(self) -> bool:
        """True if no check failed."""
        return not self.violations and all(finding.level is not Severity.BAD for finding in self.findings)

    def as_json(self) -> dict[str, Any]:
        """Return the output of `--json`."""
        topics = [{**asdict(row), "topic": row.topic.name} for row in self.topics]
        violations = [{**asdict(violation), "count": count} for violation, count in self.violations]
        findings = [asdict(finding) for finding in self.findings]
        return {"healthy": self.healthy, "findings": findings, "topics": topics, "violations": violations}


def examine(bus: Joined, seconds: float) -> Diagnosis:
    """Monitor a bus for `seconds` and returns the diagnosis."""
    live = _monitor(bus)
    end = monotonic() + seconds
    try:
        while monotonic() < end:
            live.poll()
            sleep(POLL_S)
        live.poll()
        return diagnose(bus, live)
    finally:
        live.close()


def diagnose(bus: Joined, live: LiveMonitor) -> Diagnosis:
    """Return the diagnosis from what the monitor has received so far."""
    findings = [
        *_versions(bus), *_endpoints(bus, live), *_shared_memory(bus), *_clock(live), *_who(bus, live), *_processes(live),
        *_waiting(live),
    ]  # fmt: skip
    differing = mismatches(live.graph.alive.values())
    findings += [Remark("types", Severity.BAD, sentence) for sentence in differing]
    if not differing:
        findings.append(Remark("types", Severity.OK, "all nodes have the same message definitions"))
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
    silent = [role for role in run.endpoints if there.get(role) not in links]
    reached = len(run.endpoints) - len(silent)
    text = (
        f"{run.name}, process {run.pid}, {run.runtime}, domain {bus.domain}: {reached} of {len(run.endpoints)} endpoints answer"
    )
    findings.append(Remark("endpoints", Severity.WARN if silent else Severity.OK, text))
    findings += [Remark("endpoints", Severity.WARN, f"{role} does not answer at {run.endpoints[role]}") for role in silent]
    return findings


def _shared_memory(bus: Joined) -> list[Remark]:
    if not bus.target.options.shared_memory:
        return [Remark("shared memory", Severity.OK, "off (PALPATE_SHARED_MEMORY=0): large messages go over the network")]
    if not SHARED_MEMORY.is_dir():
        return [Remark("shared memory", Severity.WARN, f"no {SHARED_MEMORY}: large messages go over the network")]
    state = os.statvfs(SHARED_MEMORY)
    free, size = state.f_bavail * state.f_frsize / 1e6, state.f_blocks * state.f_frsize / 1e6
    level = Severity.WARN if free < MIN_SHARED_MEMORY_MB else Severity.OK
    hint = "; too little for depth images and meshes: enlarge it (docker: shm_size)" if level is Severity.WARN else ""
    return [Remark("shared memory", level, f"{SHARED_MEMORY}: {free:.0f} MB of {size:.0f} MB free{hint}")]


def _clock(live: LiveMonitor) -> list[Remark]:
    findings = []
    time, progress = live.monitor.time.now, live.monitor.time.progress
    if time is not None:
        kind = "wall-clock" if live.monitor.rate == 1.0 else "simulated"
        moves = f"at {progress:.2f} x real time" if progress else "stands still (paused, or a service holds it up)"
        findings.append(Remark("clock", Severity.OK if progress else Severity.WARN, f"{kind} time {time / 1e9:.2f} s, {moves}"))
    else:
        findings.append(Remark("clock", Severity.WARN, "no time: no stamped message received"))
    for name, age in live.offsets.items():
        if age < MIN_MESSAGE_AGE_MS:
            sender = live.monitor.rules.topics[name].producer
            text = f"the clock of {sender}'s host is at least {-age:.1f} ms ahead of ours ({name}); synchronise them (NTP, PTP)"
            findings.append(Remark("clock", Severity.WARN, text))
    return findings


def _who(bus: Joined, live: LiveMonitor) -> list[Remark]:
    rules = contract()
    absent = graph.missing(rules, live.graph.alive.values(), bus.target.run)
    workers = [role for role in absent if not rules.roles[role].observer]
    others = [role for role in absent if rules.roles[role].observer]
    strangers = sorted(live.graph.roles() - rules.roles.keys())
    findings = [Remark("roles", Severity.BAD, f"{role} is missing: {rules.roles[role].doc}") for role in workers]
    if not workers:
        findings.append(Remark("roles", Severity.OK, "all required roles are there"))
    if others:
        findings.append(Remark("roles", Severity.OK, f"without {', '.join(others)} (observers)"))
    if strangers:
        findings.append(Remark("roles", Severity.OK, f"also there: {', '.join(strangers)}"))
    if live.graph.garbage:
        findings.append(Remark("roles", Severity.WARN, f"{live.graph.garbage} liveliness tokens are not rmw_zenoh's"))
    return findings


def _processes(live: LiveMonitor) -> list[Remark]:
    """Report which roles share a process."""
    shared = [f"{', '.join(names)} share one" for names in graph.processes(live.graph.alive.values()) if len(names) > 1]
    return [Remark("processes", Severity.OK, "; ".join([*shared, "every other role has its own"]) if shared else "one per role")]


def _waiting(live: LiveMonitor) -> list[Remark]:
    """Report which service waits for which, from the services' own reports."""
    findings = []
    now = monotonic()
    for role, (_, received) in sorted(live.reports.items()):
        if now - received > SILENT_S:
            findings.append(Remark("progress", Severity.WARN, f"{role} has not reported for {now - received:.0f} s"))
    if live.reports and live.monitor.time.progress == 0:
        for role, (report, _) in sorted(live.reports.items()):
            wait = f"waits for {report.waiting_for}" if report.waiting_for else "waits for no service"
            findings.append(Remark("progress", Severity.WARN, f"{role} is at {report.tick / 1e9:.3f} s and {wait}"))
    elif live.reports:
        slowest = min((report for report, _ in live.reports.values()), key=lambda report: report.tick)
        text = f"{len(live.reports)} services report; the last of them, {slowest.role}, is at {slowest.tick / 1e9:.2f} s"
        findings.append(Remark("progress", Severity.OK, text))
    return findings


_COLOURS = {Severity.OK: "green", Severity.WARN: "yellow", Severity.BAD: "bold red"}


def doctor(
    connect: Connect = None,
    run: ChosenRun = None,
    domain: Domain = None,
    as_json: AsJson = False,
    seconds: Annotated[float, typer.Option(min=1, help="Duration of the check, in seconds.")] = 3.0,
    watch: Annotated[bool, typer.Option("--watch", help="Print every violation when it occurs, until Ctrl-C.")] = False,
    clean: Annotated[bool, typer.Option("--clean", help="Only remove leftovers of killed runs on this machine.")] = False,
) -> None:
    """Check a live bus: versions, endpoints, shared memory, clocks, missing roles, and every topic against the contract.

    The exit status is 0 when all is well, 1 when something is wrong, 2 when there is no bus.
    """
    if clean:
        left = remove_leftovers()
        live_runs()
        wide_console().print("\n".join(f"removed {path}" for path in left) or "nothing left of killed runs", highlight=False)
        return
    with joined(connect, run, domain) as bus:
        if watch:
            _watch(_monitor(bus), as_json)
        with SteadyConsole(stderr=True).status(f"listening for {seconds:g} s"):
            diagnosis = examine(bus, seconds)
    if as_json:
        print_json(diagnosis.as_json())
    else:
        _print(diagnosis)
    if not diagnosis.healthy:
        raise typer.Exit(EXIT_TROUBLE)


def _monitor(bus: Joined) -> LiveMonitor:
    return LiveMonitor(bus.session, contract(), bus.domain, bus.readable_topics(contract()), bus.target.rate)


def _watch(live: LiveMonitor, as_json: bool) -> NoReturn:
    """Print every violation of the contract when it occurs, until Ctrl-C."""
    began = monotonic()
    try:
        while True:
            for violation in live.poll():
                after_s = monotonic() - began
                if as_json:
                    print_line({"after_s": round(after_s, 3), **asdict(violation)})
                else:
                    line = Text.assemble((f"{after_s:8.2f} s", "dim"), "  ", (str(violation), "red"))
                    wide_console().print(line, soft_wrap=True)
            sleep(POLL_S)
    finally:
        live.close()


def _print(diagnosis: Diagnosis) -> None:
    out = wide_console()
    listed = table("", "", "")
    said = ""
    for finding in diagnosis.findings:
        about = "" if finding.about == said else finding.about
        said = finding.about
        listed.add_row(Text(about, "bold"), Text(finding.level, _COLOURS[finding.level]), finding.text)
    listed.show_header = False
    out.print(listed)
    out.print()
    rows = table("topic", "from", "state", ">Hz", ">by the bus's time", ">contract", ">age", ">load", ">messages", ">missing")
    for health in diagnosis.topics:
        rows.add_row(*_row(health))
    out.print(rows)
    out.print()
    for violation, count in diagnosis.violations:
        times = f" ({count} times)" if count > 1 else ""
        out.print(Text.assemble(("violation", "bold red"), f"  {violation}{times}"), soft_wrap=True)
    if not diagnosis.violations:
        out.print("no violation of the contract", style="green")


def _row(health: TopicHealth) -> tuple[str | Text, ...]:
    topic = health.topic
    state = {None: Text("rests", "dim"), True: Text("alive", "green"), False: Text("silent", "red")}[health.alive]
    if health.violations:
        state = Text("violates", "bold red")
    elif not health.senders:
        state = Text("no sender", "dim")
    wanted = "latched" if topic.latched else "event" if topic.event else f"{1000 / topic.period_ms:g}"
    periodic = topic.periodic and health.messages
    return (
        topic.name, ", ".join(health.senders), state, number(health.rate_hz) if periodic else "",
        number(health.bus_rate_hz) if periodic and health.bus_rate_hz is not None else "", wanted,
        number(health.age_ms, "ms", 2) if periodic else "", bandwidth(health.bytes_per_s) if health.bytes_per_s else "",
        str(health.messages) if health.messages else "", str(health.missing) if health.missing else "",
    )  # fmt: skip
