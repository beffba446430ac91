"""`palpate check ROLE`: the conformance kit for an implementation of a role."""

from __future__ import annotations

import os
from typing import Annotated

import typer

from palpate.check.live_rig import LiveRig
from palpate.check.report import ConformanceReport, Verdict
from palpate.check.rig import RigSettings, ServiceRig
from palpate.check.starting import started
from palpate.check.suites import SUITES, check
from palpate.check.suites.tissue import STILL
from palpate.command_line import refuse
from palpate.live.connection import Connect
from palpate.live.console import EXIT_TROUBLE, command, console, print_json, table
from palpate_bus import implementations
from palpate_bus.implementations import ChoiceError
from palpate_bus.runs.joining import NoBus
from palpate_bus.wire.zenoh_config import BusOptions, session
from palpate_models.load import ScenarioError, load_scenario

LISTEN = "tcp/127.0.0.1:7447"
_COLOURS = {Verdict.PASSED: "green", Verdict.FAILED: "bold red", Verdict.SKIPPED: "dim"}


def check_command(  # noqa: PLR0913 - the options of a command
    role: Annotated[str, typer.Argument(help=f"One of {', '.join(SUITES)}.")],
    connect: Connect = None,
    listen: Annotated[str, typer.Option(help="Where the check waits for the implementation, as a router.")] = LISTEN,
    start: Annotated[str | None, typer.Option(metavar="COMMAND", help="Start the implementation with this command.")] = None,
    service: Annotated[
        str | None,
        typer.Option(metavar="NAME_OR_FILE", help="Check an installed one or a Python file in this process, in simulated time."),
    ] = None,
    scenario: Annotated[str, typer.Option(help="What it was configured with; its patient holds the breath.")] = "clean",
    motion: Annotated[bool, typer.Option("--motion", help="It may move: needed for most of the robot's checks.")] = False,
    domain: Annotated[int, typer.Option(envvar="ROS_DOMAIN_ID", help="ROS domain.")] = 0,
    slack: Annotated[float, typer.Option(min=0, help="Seconds that transport and scheduler may add to a reaction.")] = 0.15,
    wait: Annotated[float, typer.Option(help="Seconds to wait for it to join.")] = 60.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    failures: Annotated[bool, typer.Option("--failures", help="Print only what failed.")] = False,
) -> None:
    """Check an implementation of a role: rates, ranges, signs, frames, limits, expiry and safe hold, garbage and silence.

    The check plays the conductor and all other roles. Leaves with status 0 when everything passed, 1 when something failed, 2
    when nobody came. docs/conformance.md says what an implementation has to do.
    """
    with command():
        if role not in SUITES:
            raise NoBus(f"no suite for {role!r}; there is one for {', '.join(SUITES)}")
        try:
            settings = RigSettings(load_scenario(scenario, STILL), 1e3 * slack, motion or role != "robot" or service is not None)
            report = None if service is None else _check_here(role, service, settings)
        except (ScenarioError, ChoiceError) as error:
            refuse(error)
        if report is None:
            report = _check_live(role, settings, connect, listen, start, domain, wait)
    if as_json:
        print_json(report.as_json())
    else:
        _print(report, failures)
    if not report.passed:
        raise typer.Exit(EXIT_TROUBLE)


def _check_here(role: str, choice: str, settings: RigSettings) -> ConformanceReport:
    return check(ServiceRig(implementations.create(role, choice, settings.scenario), settings))


def _check_live(
    role: str, settings: RigSettings, connect: list[str] | None, listen: str, start: str | None, domain: int, wait: float
) -> ConformanceReport:
    options = BusOptions(connect=tuple(connect)) if connect else BusOptions(mode="router", listen=(listen,))
    report = ConformanceReport(role)
    with session(options) as bus:
        where = ", ".join(connect) if connect else listen
        typer.echo(f"waiting for {role} at {where}, domain {domain}", err=True)
        rig = LiveRig(bus, role, settings, domain)
        try:
            with started(start, role, settings, where, domain):
                rig.await_implementation(wait, report)
                check(rig, report)
                rig.finish(report)
        finally:
            rig.close()
    return report


def _print(report: ConformanceReport, failures: bool) -> None:
    out = console()
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
