"""Runs the conformance suite of a role, in this process or on a bus, with a progress bar, and prints the result."""

import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import typer
from rich.text import Text

from palpate.apart import guarded, shared_numbers
from palpate.check.live_rig import LiveRig
from palpate.check.rig import ConformanceReport, Rig, RigSettings, ServiceRig, Verdict
from palpate.check.suites import SUITES, check
from palpate.console import TimeLeft, table, wide_console
from palpate_bus import implementations
from palpate_bus.messages.stamps import NS
from palpate_bus.runs.announcement import NoBus
from palpate_bus.settings import Settings
from palpate_bus.wire.zenoh_config import BusOptions, session
from palpate_models.scenario.load import dump_scenario, view_of


@contextmanager
def started(command: str | None, role: str, settings: RigSettings, endpoint: str, domain: int) -> Iterator[None]:
    """Start the implementation for the duration of the check, if a command was given."""
    if command is None:
        yield
        return
    with tempfile.TemporaryDirectory(prefix="palpate-check-") as folder:
        view = view_of(role)
        file = Path(folder) / f"{view}.yaml"
        file.write_text(dump_scenario(settings.scenario, view), encoding="utf-8")
        environment = {
            **os.environ, "PALPATE_ROUTER": endpoint, "PALPATE_RUNTIME": "wallclock", "PALPATE_SCENARIO": str(file),
            "PALPATE_OUT": folder, "PALPATE_RECORD": "none", "ROS_DOMAIN_ID": str(domain),
        }  # fmt: skip
        split = shlex.split(command)
        try:
            child = subprocess.Popen([sys.executable if split[0] == "python" else split[0], *split[1:]], env=environment)
        except OSError as error:
            raise NoBus(f"--start {command}: {error}") from error
        try:
            yield
            child.wait(timeout=5)
        except subprocess.TimeoutExpired:
            pass
        finally:
            for end in (child.terminate, child.kill):
                if child.poll() is None:
                    end()
                    with suppress(subprocess.TimeoutExpired):
                        child.wait(timeout=5)


def _shown(rig: Rig) -> TimeLeft:
    """Return a bar that follows the clock of a rig."""
    role, report = rig.role.name, rig.report
    return TimeLeft(lambda: f"{role}: {report.group}, {len(report.results)} checks", lambda: rig.t / NS, 0.0, SUITES[role])


_COLOURS = {Verdict.PASSED: "green", Verdict.FAILED: "bold red", Verdict.SKIPPED: "dim"}


def check_here(role: str, choice: str, settings: RigSettings) -> ConformanceReport:
    """Check an implementation in a child process, in simulated time. Raises PluginError for one that there is not, RunError for
    one that exits, crashes or hangs.
    """
    steps = shared_numbers()

    def perform() -> ConformanceReport:
        rig = ServiceRig(implementations.create(role, choice, settings.scenario), settings, steps)
        with _shown(rig):
            return check(rig)

    limits = Settings.read()
    return guarded(f"services.{role} = {choice!r}", perform, limits.start_limit_s, place=lambda: (steps[0],))


def check_live(
    role: str, settings: RigSettings, connect: list[str] | None, listen: str, start: str | None, domain: int, wait: float
) -> ConformanceReport:
    """Wait for an implementation on the bus and check it there. Raises NoBus if none joins."""
    options = BusOptions(connect=tuple(connect)) if connect else BusOptions(mode="router", listen=(listen,))
    with session(options) as bus:
        where = ", ".join(connect) if connect else listen
        typer.echo(f"waiting for {role} at {where}, domain {domain}", err=True)
        rig = LiveRig(bus, role, settings, domain)
        try:
            with started(start, role, settings, where, domain):
                rig.await_implementation(wait)
                with _shown(rig):
                    check(rig)
                    rig.finish()
        finally:
            rig.close()
    return rig.report


def print_report(report: ConformanceReport, failures: bool) -> None:
    """Print each check, or with `failures` only failed ones, and the verdict."""
    out = wide_console()
    rows = table("", "check", "expected", "got")
    group = ""
    for result in report.results:
        if failures and result.verdict is not Verdict.FAILED:
            continue
        if result.group != group:
            group = result.group
            rows.add_row("", Text(group, "bold"), "", "")
        rows.add_row(Text(result.verdict, _COLOURS[result.verdict]), result.name, result.expected, result.got)
    out.print(rows)
    counts = {kind: sum(result.verdict is kind for result in report.results) for kind in Verdict}
    summary = ", ".join(f"{count} {kind}" for kind, count in counts.items())
    verdict = ("conforms", "green") if report.passed else ("does not conform", "bold red")
    load = os.getloadavg()[0] / (os.cpu_count() or 1)
    if not report.passed and load > 1:
        out.print(
            f"\nthis machine is overloaded (load {load:.1f} per processor): rates and reaction times are unreliable",
            style="yellow",
        )
    out.print(Text.assemble(f"\n{report.role}: ", verdict, f", {summary}"))
