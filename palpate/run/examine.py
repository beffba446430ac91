"""What `palpate run` does: an examination from its start to its results. `palpate.run.command` has the options."""

from __future__ import annotations

import signal
import sys
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import typer
from rich.console import Console
from rich.markup import escape

from palpate.console import EXIT_BAD_INPUT, EXIT_FAILED, SteadyConsole, fail, refuse, say
from palpate.environment import given
from palpate.report.archive import EvidenceError
from palpate.report.resumption import Resumption, going_on, resumption
from palpate.run.composed import run_composed
from palpate.run.conclusion import conclude
from palpate.run.conducting import NEEDS_WALLCLOCK
from palpate.run.distributed import run_distributed
from palpate.run.folder import FolderError, WatchedRoom, check_room, results_folder, unless_begun, usual_folder, what_it_takes
from palpate.run.interrupts import results_first
from palpate.run.options import Record
from palpate.run.placement import Groups, PlacementError, placement
from palpate.run.places import Absent, PlaceError
from palpate.run.processes import ProcessListError
from palpate.run.progress import RunDisplay
from palpate.run.repeat import repeat, run_to_its_end
from palpate.run.roles import NONE, OBSERVERS, choice, workers
from palpate.run.secure import SecureBus
from palpate.run.self_test import RATES, measure
from palpate_bus.implementations import check_libraries
from palpate_bus.security.keys import KeysError
from palpate_bus.settings import BusConfigError, Settings
from palpate_conductor.outcome import RunFailed, RunResult, Tell, Timing
from palpate_models.scenario.schema import Scenario
from palpate_plugins import PluginError


@dataclass(frozen=True)
class How:
    """How an examination is to be run: the options of `palpate run`."""

    out: Path | None
    overwrite: bool
    composed: bool
    group: tuple[str, ...]
    processes: int | None
    realtime: bool
    wallclock: bool
    handover_s: float
    without: tuple[str, ...]
    wait_s: float
    record: Record
    secure: bool
    keys: Path | None
    quiet: bool
    as_json: bool
    resume: Path | None


def _observers(scenario: Scenario, how: How) -> tuple[str, ...]:
    """Recorder and dashboard, unless nothing is recorded; the dashboard only where its libraries are."""
    if how.record == "none":
        return ()
    if _dashboard_lacks(scenario):
        return tuple(role for role in OBSERVERS if role != "dashboard")
    return OBSERVERS


def _dashboard_lacks(scenario: Scenario) -> str:
    """What keeps the dashboard from drawing, and what to install; empty where nothing does."""
    try:
        check_libraries("dashboard", choice(scenario, "dashboard"))
    except PluginError as error:
        return str(error).partition(": ")[2]
    return ""


def resume(how: How) -> None:
    """Goes on with an examination that broke off; ends the command when it cannot, or has failed."""
    assert how.resume is not None
    try:
        before = resumption(how.resume)
    except (EvidenceError, OSError) as error:
        refuse(f"--resume {error}")
    if not (how.quiet or how.as_json):
        say(before.words)
    examine(before.scenario, replace(how, out=before.folder, overwrite=before.folder.is_dir()), before)


def examine(scenario: Scenario, how: How, before: Resumption | None = None) -> None:
    """Runs the examination, or goes on with one, and writes its results; ends the command when it cannot start or has failed."""
    console = SteadyConsole(stderr=True)
    quiet = how.quiet or how.as_json
    _refuse_contradictions(scenario, how)
    try:
        absent = Absent(how.without, how.wait_s, partial(console.print, highlight=False, soft_wrap=True))
        observers = _observers(scenario, how)
        groups = placement((*workers(scenario), *observers), how.group, how.processes)
    except (PlaceError, PlacementError) as error:
        refuse(error)
    folder = how.out or usual_folder(scenario.name)
    try:
        with results_first(), results_folder(folder, overwrite=how.overwrite):
            if not quiet:
                _announce(console, scenario, how, folder)
            with RunDisplay(console, quiet, scenario.exam) as display, given({"PALPATE_RECORD": how.record}):
                tell = WatchedRoom(folder, display.tell, say).tell
                with (
                    unless_begun(folder, lambda: display.begun),
                    going_on(None if before is None else before.checkpoint),
                ):
                    check_room(folder, scenario.exam, how.record)
                    result = _run(scenario, folder.resolve(), tell, how, observers, absent, groups)
                    if result.unbegun:
                        raise KeyboardInterrupt
                if before is not None:
                    result = replace(result, run_hash=None, earlier=before.earlier)
            conclude(console, folder, scenario, result, quiet, how.as_json)
    except (ProcessListError, PluginError, PlaceError, PlacementError, BusConfigError, KeysError, FolderError, OSError) as error:
        refuse(error)
    except RunFailed as error:
        fail(error)


def _announce(console: Console, scenario: Scenario, how: How, folder: Path) -> None:
    console.print(f"[bold]{scenario.name}[/] seed {scenario.seed}, results in {folder}", highlight=False)
    hints = [what_it_takes(scenario.exam, how.record)]
    if not how.composed:
        hints.append("to look at it from another terminal: palpate doctor, palpate topic list")
    if how.record != "none" and (why := _dashboard_lacks(scenario)):
        hints.append(f"for palpate dashboard, now or of the finished run, {why}")
    for hint in hints:
        console.print(f"[dim]{escape(hint)}[/]", highlight=False, soft_wrap=True)


def examine_again(scenario: Scenario, out: Path | None, count: int) -> None:
    """Runs this command so many times, with seeds from the scenario's on; Ctrl-C in one examination is the end of all.

    Ends the command when one has failed.
    """
    failed = 0

    def once(number: int, own: Path) -> None:
        nonlocal failed
        words = (*sys.argv[1:], "--repeat", "1", "--seed", str(scenario.seed + number - 1), "--out", str(own))  # the last counts
        left = run_to_its_end((sys.executable, "-m", "palpate", *words))
        if left.status == EXIT_BAD_INPUT:  # what cannot start once cannot start again
            raise typer.Exit(EXIT_BAD_INPUT)
        if left.interrupted:
            say(f"broken off in examination {number} of {count}")
            raise typer.Exit(EXIT_FAILED if failed else left.status)
        if left.status < 0:
            say(f"{own}: the examination was ended by {signal.Signals(-left.status).name}")
        failed += left.status != 0

    repeat(count, out or usual_folder(scenario.name), once)
    if failed:
        fail(f"{failed} of {count} examinations did not come to a good end")


def _refuse_contradictions(scenario: Scenario, how: How) -> None:
    shared = bool(how.group) or how.processes is not None
    for contradiction, why in (
        (
            how.composed and (how.realtime or how.wallclock),
            "--composed runs as fast as it can: it takes neither --realtime nor --wallclock",
        ),
        (scenario.services.tissue == NONE and not how.wallclock, NEEDS_WALLCLOCK),
        (how.without and how.composed, "--without ROLE leaves out a process: it goes without --composed"),
        (shared and how.composed, "--composed is one process for all: it takes neither --group nor --processes"),
        (shared and how.wallclock, "--wallclock needs a process for each service: it takes neither --group nor --processes"),
        (
            how.handover_s and not how.wallclock,
            "--handover is for --wallclock: in lockstep every message is awaited",
        ),
        (how.composed and how.secure, "--secure is for processes, so it goes without --composed"),
        (how.keys and not how.secure, "--keys goes with --secure"),
    ):
        if contradiction:
            refuse(why)


def _run(
    scenario: Scenario,
    folder: Path,
    tell: Tell,
    how: How,
    observers: tuple[str, ...],
    absent: Absent,
    groups: Groups,
) -> RunResult:
    if how.composed:
        return run_composed(scenario, folder, tell, observers)
    rate = _rate(scenario) if how.wallclock else 1.0
    timing = Timing(how.wallclock, 1.0 if how.realtime else None, rate=rate, handover_s=how.handover_s)
    with SecureBus(how.keys) if how.secure else nullcontext() as bus:
        return run_distributed(scenario, folder, tell, observers, timing, bus, absent, groups)


def _rate(scenario: Scenario) -> float:
    """The rate of a run by the wall clock: PALPATE_RATE, or what a second's self-test says that this machine can keep.

    Refuses the run where that is too little.
    """
    rate = Settings.read().rate
    if rate is None:
        kept = measure()
        rate = kept.rate
        if rate is None:
            refuse(f"this machine cannot keep {RATES[-1]:g} of real time now: {kept.words}; run in lockstep")
        if rate < 1.0:
            say(f"this machine keeps {rate:g} of real time now: {kept.words}")
    if rate < 1.0 and scenario.services.tissue == NONE:
        refuse("services.tissue = 'none' is for hardware, which cannot be slowed down")
    return rate
