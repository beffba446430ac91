"""What `palpate check` does: runs the suite of a role, here or on the bus, and prints the outcome."""

from __future__ import annotations

import os

import typer

from palpate.check.live_rig import LiveRig
from palpate.check.progress import CheckDisplay
from palpate.check.report import ConformanceReport, Verdict
from palpate.check.rig import RigSettings, ServiceRig
from palpate.check.starting import started
from palpate.check.suites import check
from palpate.console import table, wide_console
from palpate_bus import implementations
from palpate_bus.wire.zenoh_config import BusOptions, session

_COLOURS = {Verdict.PASSED: "green", Verdict.FAILED: "bold red", Verdict.SKIPPED: "dim"}


def check_here(role: str, choice: str, settings: RigSettings) -> ConformanceReport:
    """Checks an implementation in this process, in simulated time. Raises PluginError for one that there is not."""
    rig, report = ServiceRig(implementations.create(role, choice, settings.scenario), settings), ConformanceReport(role)
    with CheckDisplay(rig, report):
        return check(rig, report)


def check_live(
    role: str, settings: RigSettings, connect: list[str] | None, listen: str, start: str | None, domain: int, wait: float
) -> ConformanceReport:
    """Waits for an implementation on the bus, and checks it there. Raises NoBus where none comes."""
    options = BusOptions(connect=tuple(connect)) if connect else BusOptions(mode="router", listen=(listen,))
    report = ConformanceReport(role)
    with session(options) as bus:
        where = ", ".join(connect) if connect else listen
        typer.echo(f"waiting for {role} at {where}, domain {domain}", err=True)
        rig = LiveRig(bus, role, settings, domain)
        try:
            with started(start, role, settings, where, domain):
                rig.await_implementation(wait, report)
                with CheckDisplay(rig, report):
                    check(rig, report)
                    rig.finish(report)
        finally:
            rig.close()
    return report


def print_report(report: ConformanceReport, failures: bool) -> None:
    """Prints each check, or with `failures` what failed alone, and the verdict."""
    out = wide_console()
    rows = table("", "check", "expected", "got")
    group = ""
    for result in report.results:
        if failures and result.verdict is not Verdict.FAILED:
            continue
        if result.group != group:
            group = result.group
            rows.add_row("", f"[bold]{group}[/]", "", "")
        texts = (text.replace("[", r"\[") for text in (result.name, result.expected, result.got))
        rows.add_row(f"[{_COLOURS[result.verdict]}]{result.verdict}[/]", *texts)
    out.print(rows)
    counts = {kind: sum(result.verdict is kind for result in report.results) for kind in Verdict}
    summary = ", ".join(f"{count} {kind}" for kind, count in counts.items())
    verdict = "[green]conforms[/]" if report.passed else "[bold red]does not conform[/]"
    load = os.getloadavg()[0] / (os.cpu_count() or 1)
    if not report.passed and load > 1:
        out.print(f"\n[yellow]this machine is overloaded (load {load:.1f} a processor): rates and reactions say little[/]")
    out.print(f"\n{report.role}: {verdict}, {summary}")
