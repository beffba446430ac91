"""An examination on this machine, from its start to its results."""

from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

from rich.console import Console
from rich.text import Text

from palpate.console import SteadyConsole, say
from palpate.environment import set_environment
from palpate.report.files import bring_back
from palpate.report.recovery import Resumption, checkpoint_given, resumption
from palpate.run.composed import run_composed
from palpate.run.conducting import IN_REAL_TIME, NEEDS_WALLCLOCK, conclude
from palpate.run.distributed import run_distributed
from palpate.run.folder import check_room, results_folder, usual_folder, watch_room, what_it_takes
from palpate.run.group import Groups, placement
from palpate.run.interrupts import results_first
from palpate.run.options import RunOptions
from palpate.run.places import Absent
from palpate.run.processes import secure_bus
from palpate.run.progress import RunDisplay
from palpate.run.roles import NONE, OBSERVERS, choice, workers
from palpate.run.self_test import RATES, TEST, measure
from palpate_bus.implementations import kind
from palpate_bus.settings import Settings
from palpate_conductor.outcome import RunResult, Tell, Timing
from palpate_errors import UserError
from palpate_models.scenario.schema import Scenario
from palpate_plugins import PluginError


def resume(options: RunOptions) -> None:
    """Continue the interrupted examination `options.resume`. Raises UserError if it cannot, typer.Exit if it failed."""
    assert options.resume is not None
    bring_back(options.resume)
    before = resumption(options.resume)
    if not options.silent:
        say(before.summary)
    examine(before.scenario, replace(options, out=before.folder, overwrite=before.folder.is_dir()), before)


def examine(scenario: Scenario, options: RunOptions, before: Resumption | None = None) -> None:
    """Run an examination, or continue the one `before`, and write its results.

    Raises UserError if it cannot start, typer.Exit if it failed.
    """
    _refuse_contradictions(scenario, options)
    console = SteadyConsole(stderr=True)
    absent = Absent(tuple(options.without or ()), options.wait, partial(console.print, soft_wrap=True))
    observers = _observers(scenario, options)
    roles = (*workers(scenario), *observers)
    absent.check(roles)
    groups = placement(roles, options.group or (), options.processes)
    folder = options.out or usual_folder(scenario.name)
    display = RunDisplay(console, options.silent, scenario.exam)
    with results_first(), results_folder(folder, overwrite=options.overwrite, begun=lambda: display.begun):
        if not options.silent:
            _announce(console, scenario, options, folder)
        record, checkpoint = {"PALPATE_RECORD": options.record}, None if before is None else before.checkpoint
        with display, set_environment(record), checkpoint_given(checkpoint):
            check_room(folder, scenario.exam, options.record)
            tell = watch_room(folder, display.show, say)
            result = _run(scenario, folder.resolve(), tell, options, observers, absent, groups)
            if result.unbegun:
                raise KeyboardInterrupt
        if before is not None:
            result = replace(result, run_hash=None, earlier=before.earlier)
        conclude(console, folder, scenario, result, options.silent, options.as_json)


def _observers(scenario: Scenario, options: RunOptions) -> tuple[str, ...]:
    """Return recorder and dashboard, unless nothing is recorded; the dashboard only if its libraries are installed."""
    if options.record == "none":
        return ()
    return tuple(role for role in OBSERVERS if role != "dashboard") if _missing_for_dashboard(scenario) else OBSERVERS


def _missing_for_dashboard(scenario: Scenario) -> str:
    """Return the module that the dashboard lacks and how to install it; empty if it lacks none."""
    try:
        kind("dashboard").check_libraries(choice(scenario, "dashboard"))
    except PluginError as error:
        return str(error).partition(": ")[2]
    return ""


def _announce(console: Console, scenario: Scenario, options: RunOptions, folder: Path) -> None:
    console.print(Text.assemble((scenario.name, "bold"), f" seed {scenario.seed}, results in {folder}"))
    hints = [what_it_takes(scenario.exam, options.record)]
    if not options.composed:
        hints.append("to look at it from another terminal: palpate doctor, palpate topic list")
    if options.record != "none" and (reason := _missing_for_dashboard(scenario)):
        hints.append(f"for palpate dashboard, now or of the finished run, {reason}")
    for hint in hints:
        console.print(hint, style="dim", soft_wrap=True)


def _refuse_contradictions(scenario: Scenario, options: RunOptions) -> None:
    """Raise UserError for options that exclude each other."""
    o, shared = options, bool(options.group) or options.processes is not None
    for contradiction, reason in (
        (o.composed and (o.realtime or o.wallclock), "--composed runs as fast as it can: without --realtime and --wallclock"),
        (scenario.services.tissue == NONE and not o.wallclock, NEEDS_WALLCLOCK),
        (o.without and o.composed, "--without ROLE leaves out a process: it goes without --composed"),
        (shared and o.composed, "--composed is one process for all: it takes neither --group nor --processes"),
        (shared and o.wallclock, "--wallclock needs a process for each service: it takes neither --group nor --processes"),
        (o.handover and not o.wallclock, "--handover is for --wallclock: in lockstep every message is awaited"),
        (o.composed and o.secure, "--secure is for processes, so it goes without --composed"),
        (o.keys and not o.secure, "--keys goes with --secure"),
    ):
        if contradiction:
            raise UserError(reason)


def _run(
    scenario: Scenario, folder: Path, tell: Tell, options: RunOptions, observers: tuple[str, ...], absent: Absent, groups: Groups
) -> RunResult:
    if options.composed:
        return run_composed(scenario, folder, tell, observers)
    rate = _rate(scenario) if options.wallclock else 1.0
    timing = Timing(options.wallclock, 1.0 if options.realtime else None, rate=rate, handover_s=options.handover)
    with secure_bus(options.keys) if options.secure else nullcontext() as bus:
        return run_distributed(scenario, folder, tell, observers, timing, bus, absent, groups)


def _rate(scenario: Scenario) -> float:
    """Return the rate of a wall-clock run: PALPATE_RATE, or the highest that the self-test allows on this machine.

    Raises UserError if there is none.
    """
    real, emulated = scenario.services.tissue == NONE, scenario.robot.driver.emulated
    given = rate = Settings.read().rate
    if rate is None:
        measured = measure(TEST.real_processes if real else TEST.simulated_processes)
        rate = measured.rate
        if rate is None:
            raise UserError(f"this machine cannot keep {RATES[-1]:g} of real time now: {measured.summary}; run in lockstep")
        if rate < 1.0 or real or emulated:
            say(f"this machine keeps {rate:g} of real time now: {measured.summary}")
    if rate < 1.0 and real:
        raise UserError(IN_REAL_TIME)
    if rate < 1.0 and emulated and given is None:
        raise UserError(f"the emulated arm is in real time: start it and the run with PALPATE_RATE={rate:g}")
    return rate
