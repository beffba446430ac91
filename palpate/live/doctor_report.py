"""What `palpate doctor` prints."""

from __future__ import annotations

from time import monotonic, sleep

import typer
from rich.console import Console
from rich.markup import escape

from palpate.live.connection import command, joined
from palpate.live.console import EXIT_TROUBLE, bandwidth, console, number, print_json, print_line, table
from palpate.live.doctor import POLL_S, Diagnosis, Severity, examine
from palpate.live.options import ChosenBus
from palpate_bus.contract import contract
from palpate_bus.monitor.health import TopicHealth, Violation
from palpate_bus.monitor.live import LiveMonitor
from palpate_bus.runs.announcement import live
from palpate_bus.runs.run_folder import remove_leftovers

_COLOURS = {Severity.OK: "green", Severity.WARN: "yellow", Severity.BAD: "bold red"}


def clear() -> None:
    """Removes the leftovers of killed runs on this machine, and prints them."""
    left = remove_leftovers()
    live()
    console().print("\n".join(f"removed {path}" for path in left) or "nothing left of killed runs", highlight=False)


def watch_violations(chosen: ChosenBus, as_json: bool) -> None:
    """Prints every violation of the contract when it occurs, until Ctrl-C."""
    with command(), joined(chosen) as bus:
        rules = contract()
        _watch(LiveMonitor(bus.session, rules, bus.domain, bus.audible(rules), bus.target.rate), as_json)


def report(chosen: ChosenBus, seconds: float, as_json: bool) -> None:
    """Listens for some seconds and prints the diagnosis. Raises typer.Exit with status 1 where something is wrong."""
    with command(), joined(chosen) as bus, Console(stderr=True).status(f"listening for {seconds:g} s"):
        diagnosis = examine(bus, contract(), seconds)
    if as_json:
        print_json(diagnosis.as_json())
    else:
        _print(diagnosis)
    if not diagnosis.healthy:
        raise typer.Exit(EXIT_TROUBLE)


def _watch(live: LiveMonitor, as_json: bool) -> None:
    began = monotonic()
    try:
        while True:
            for violation in live.poll():
                if as_json:
                    print_line({"after_s": round(monotonic() - began, 3), **_facts(violation)})
                else:
                    console().print(f"[dim]{monotonic() - began:8.2f} s[/]  [red]{escape(str(violation))}[/]", soft_wrap=True)
            sleep(POLL_S)
    finally:
        live.close()


def _facts(violation: Violation) -> dict[str, str]:
    return {
        "topic": violation.topic, "sender": violation.sender, "kind": str(violation.kind), "field": violation.field,
        "expected": violation.expected, "got": violation.got,
    }  # fmt: skip


def _print(diagnosis: Diagnosis) -> None:
    out = console()
    listed = table("", "", "")
    said = ""
    for finding in diagnosis.findings:
        about = "" if finding.about == said else finding.about
        said = finding.about
        listed.add_row(f"[bold]{about}[/]", f"[{_COLOURS[finding.level]}]{finding.level}[/]", escape(finding.text))
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
        out.print(f"[bold red]violation[/]  {escape(str(violation))}{times}", soft_wrap=True)
    if not diagnosis.violations:
        out.print("[green]no violation of the contract[/]")


def _row(health: TopicHealth) -> tuple[str, ...]:
    topic = health.topic
    state = {None: "[dim]rests[/]", True: "[green]alive[/]", False: "[red]silent[/]"}[health.alive]
    if health.violations:
        state = "[bold red]violates[/]"
    elif not health.senders:
        state = "[dim]no sender[/]"
    wanted = "latched" if topic.latched else "event" if topic.event else f"{1000 / topic.period_ms:g}"
    periodic = topic.periodic and health.messages
    return (
        topic.name, ", ".join(health.senders), state, number(health.rate_hz) if periodic else "",
        number(health.bus_rate_hz) if periodic and health.bus_rate_hz is not None else "", wanted,
        number(health.age_ms, "ms", 2) if periodic else "", bandwidth(health.bytes_per_s) if health.bytes_per_s else "",
        str(health.messages) if health.messages else "", str(health.missing) if health.missing else "",
    )  # fmt: skip
