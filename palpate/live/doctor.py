"""`palpate doctor`: checks a live bus and names the cause of what is wrong."""

import os
import platform
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from time import monotonic, sleep
from typing import Annotated, Any, Final, NamedTuple, NoReturn

import typer
from rich.filesize import decimal
from rich.text import Text

from palpate.console import SteadyConsole, number, print_json, print_line, table, wide_console
from palpate.live.bus import AsJson, ChosenRun, Connect, Domain, Joined, join_bus, missing
from palpate_bus.contract import contract
from palpate_bus.monitor.health import TopicHealth, Violation
from palpate_bus.monitor.monitor import LiveMonitor
from palpate_bus.runs.announcement import versions
from palpate_bus.security.access import public
from palpate_bus.wire.liveliness import mismatches
from palpate_errors import ExitStatus


class DoctorLimits(NamedTuple):
    """Limits beyond which the doctor reports a fault."""

    poll_s: float = 0.04
    min_shared_memory_mb: int = 64
    """Minimum free shared memory: with less, large messages may fall back to the network."""
    min_message_age_ms: float = -2.0
    """A message with a smaller age was stamped by a clock that is ahead of the local one."""
    silent_s: float = 5.0


LIMITS: Final = DoctorLimits()
SHARED_MEMORY = Path("/dev/shm")


class Severity(StrEnum):
    """Severity of a remark."""

    OK = "ok"
    WARN = "warning"
    BAD = "trouble"


class Remark(NamedTuple):
    """The result of one check."""

    about: str
    level: Severity
    text: str


@dataclass
class Diagnosis:
    """All remarks, the health of each topic and the violations of the contract, each with its count."""

    findings: list[Remark]
    topics: list[TopicHealth]
    violations: list[tuple[Violation, int]]

    @property
    def healthy(self) -> bool:
        """True if no check failed."""
        return not self.violations and all(finding.level is not Severity.BAD for finding in self.findings)

    def as_json(self) -> dict[str, Any]:
        """Return the output of `--json`."""
        topics = [{**row._asdict(), "topic": row.topic.name} for row in self.topics]
        violations = [{**violation._asdict(), "count": count} for violation, count in self.violations]
        findings = [finding._asdict() for finding in self.findings]
        return {"healthy": self.healthy, "findings": findings, "topics": topics, "violations": violations}


def examine(bus: Joined, seconds: float) -> Diagnosis:
    """Monitor a bus for `seconds` and return the diagnosis."""
    live = _monitor(bus)
    end = monotonic() + seconds
    try:
        while monotonic() < end:
            live.poll()
            sleep(LIMITS.poll_s)
        live.poll()
        of_bus = _versions(bus), _endpoints(bus, live), _shared_memory(bus)
        parts = *of_bus, _clock(live), _who(bus, live), _progress(live), _types(live)
        seen = [(s.violation, s.count) for s in live.monitor.active.values()]
        return Diagnosis([remark for part in parts for remark in part], live.monitor.health(), seen)
    finally:
        live.close()


def _types(live: LiveMonitor) -> Iterator[Remark]:
    bad = [Remark("types", Severity.BAD, sentence) for sentence in mismatches(live.graph.alive.values())]
    yield from bad or [Remark("types", Severity.OK, "all nodes have the same message definitions")]


def _versions(bus: Joined) -> Iterator[Remark]:
    ours, run = versions(), bus.target.run
    text = f"python {platform.python_version()}, " + ", ".join(f"{name} {number}" for name, number in ours.items())
    theirs = {} if run is None else run.versions
    other = [f"{name} {number} there, {ours.get(name)} here" for name, number in theirs.items() if ours.get(name) != number]
    if run is not None:
        text += f"; the run has {'; '.join(other) or 'the same'}"
    yield Remark("versions", Severity.WARN if other else Severity.OK, text)


def _endpoints(bus: Joined, live: LiveMonitor) -> Iterator[Remark]:
    run, options = bus.target.run, bus.target.options
    links = {str(zid) for zid in (*bus.session.info.peers_zid(), *bus.session.info.routers_zid())}
    there = {entity.node: entity.zid for entity in live.graph.alive.values()}
    if run is None or options.mode == "client":
        text = f"{', '.join(options.asked)}: {len(links)} links, domain {bus.target.domain}"
        yield Remark("endpoints", Severity.OK if links else Severity.BAD, text)
        return
    silent = [role for role in run.endpoints if there.get(role) not in links]
    count, reached = len(run.endpoints), len(run.endpoints) - len(silent)
    text = f"{run.name}, process {run.pid}, {run.runtime}, domain {bus.target.domain}: {reached} of {count} endpoints answer"
    yield Remark("endpoints", Severity.WARN if silent else Severity.OK, text)
    yield from (Remark("endpoints", Severity.WARN, f"{role} does not answer at {run.endpoints[role]}") for role in silent)


def _shared_memory(bus: Joined) -> Iterator[Remark]:
    if not bus.target.options.shared_memory:
        yield Remark("shared memory", Severity.OK, "off (PALPATE_SHARED_MEMORY=0): large messages go over the network")
    elif not SHARED_MEMORY.is_dir():
        yield Remark("shared memory", Severity.WARN, f"no {SHARED_MEMORY}: large messages go over the network")
    else:
        state = os.statvfs(SHARED_MEMORY)
        free, size = state.f_bavail * state.f_frsize / 1e6, state.f_blocks * state.f_frsize / 1e6
        few = free < LIMITS.min_shared_memory_mb
        hint = "; too little for depth images and meshes: enlarge it (docker: shm_size)" if few else ""
        text = f"{SHARED_MEMORY}: {free:.0f} MB of {size:.0f} MB free{hint}"
        yield Remark("shared memory", Severity.WARN if few else Severity.OK, text)


def _clock(live: LiveMonitor) -> Iterator[Remark]:
    time, progress = live.monitor.time.now, live.monitor.time.progress
    text = "no time: no stamped message received"
    if time is not None:
        kind = "wall-clock" if live.monitor.rate == 1.0 else "simulated"
        moves = f"at {progress:.2f} x real time" if progress else "stands still (paused, or a service holds it up)"
        text = f"{kind} time {time / 1e9:.2f} s, {moves}"
    yield Remark("clock", Severity.OK if time is not None and progress else Severity.WARN, text)
    for name, age in live.offsets.items():
        if age < LIMITS.min_message_age_ms:
            sender = live.monitor.contract.topics[name].producer
            text = f"the clock of {sender}'s host is at least {-age:.1f} ms ahead of ours ({name}); synchronise them (NTP, PTP)"
            yield Remark("clock", Severity.WARN, text)


def _who(bus: Joined, live: LiveMonitor) -> Iterator[Remark]:
    """Report missing and unknown roles, and which share a process."""
    roles, alive = contract().roles, live.graph.alive.values()
    absent = missing(contract(), alive, bus.target.run)
    workers = [role for role in absent if not roles[role].observer]
    yield from (Remark("roles", Severity.BAD, f"{role} is missing: {roles[role].doc}") for role in workers)
    if not workers:
        yield Remark("roles", Severity.OK, "all required roles are there")
    if others := [role for role in absent if role not in workers]:
        yield Remark("roles", Severity.OK, f"without {', '.join(others)} (observers)")
    if strangers := sorted(live.graph.roles() - roles.keys()):
        yield Remark("roles", Severity.OK, f"also there: {', '.join(strangers)}")
    if live.graph.garbage:
        yield Remark("roles", Severity.WARN, f"{live.graph.garbage} liveliness tokens are not rmw_zenoh's")


def _progress(live: LiveMonitor) -> Iterator[Remark]:
    """Report which service waits for which, from the services' own reports."""
    now = monotonic()
    for role, (_, received) in sorted(live.reports.items()):
        if now - received > LIMITS.silent_s:
            yield Remark("progress", Severity.WARN, f"{role} has not reported for {now - received:.0f} s")
    if live.reports and live.monitor.time.progress == 0:
        for role, (report, _) in sorted(live.reports.items()):
            wait = f"waits for {report.waiting_for}" if report.waiting_for else "waits for no service"
            yield Remark("progress", Severity.WARN, f"{role} is at {report.tick / 1e9:.3f} s and {wait}")
    elif live.reports:
        slowest = min((report for report, _ in live.reports.values()), key=lambda report: report.tick)
        text = f"{len(live.reports)} services report; the last of them, {slowest.role}, is at {slowest.tick / 1e9:.2f} s"
        yield Remark("progress", Severity.OK, text)


_COLOURS = {Severity.OK: "green", Severity.WARN: "yellow", Severity.BAD: "bold red"}


def doctor(
    connect: Connect = None,
    run: ChosenRun = None,
    domain: Domain = None,
    as_json: AsJson = False,
    seconds: Annotated[float, typer.Option(min=1, help="Duration of the check, in seconds.")] = 3.0,
    watch: Annotated[bool, typer.Option("--watch", help="Print every violation when it occurs, until Ctrl-C.")] = False,
) -> None:
    """Check a live bus: versions, endpoints, shared memory, clocks, missing roles, and every topic against the contract.

    The exit status is 0 when all is well, 1 when something is wrong, 2 without a bus.
    """
    with join_bus(connect, run, domain) as bus:
        if watch:
            _watch(_monitor(bus), as_json)
        with SteadyConsole(stderr=True).status(f"listening for {seconds:g} s"):
            diagnosis = examine(bus, seconds)
    if as_json:
        print_json(diagnosis.as_json())
    else:
        _print(diagnosis)
    if not diagnosis.healthy:
        raise typer.Exit(ExitStatus.TROUBLE)


def _monitor(bus: Joined) -> LiveMonitor:
    readable = None if bus.target.options.tls is None else public(contract())
    return LiveMonitor(bus.session, contract(), bus.target.domain, readable, bus.target.rate)


def _watch(live: LiveMonitor, as_json: bool) -> NoReturn:
    """Print every violation of the contract when it occurs, until Ctrl-C."""
    began = monotonic()
    try:
        while True:
            for violation in live.poll():
                after_s = monotonic() - began
                if as_json:
                    print_line({"after_s": round(after_s, 3), **violation._asdict()})
                else:
                    line = Text.assemble((f"{after_s:8.2f} s", "dim"), "  ", (str(violation), "red"))
                    wide_console().print(line, soft_wrap=True)
            sleep(LIMITS.poll_s)
    finally:
        live.close()


def _print(diagnosis: Diagnosis) -> None:
    out = wide_console()
    listed = table("", "", "")
    for finding in diagnosis.findings:
        listed.add_row(Text(finding.about, "bold"), Text(finding.level, _COLOURS[finding.level]), finding.text)
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
        number(health.age_ms, "ms", 2) if periodic else "",
        f"{decimal(round(health.bytes_per_s))}/s" if health.bytes_per_s else "",
        str(health.messages) if health.messages else "", str(health.missing) if health.missing else "",
    )  # fmt: skip
