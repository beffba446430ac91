"""Conducts services that are started by others, such as containers (`palpate conduct`), and concludes an examination.

The end of every examination: writes the results, prints the findings, sets the exit status. The conductor's image imports only
this: no role, no resuming.
"""

import logging
import tempfile
from contextlib import nullcontext
from pathlib import Path

import typer
from rich.console import Console

from palpate.console import SteadyConsole, print_line, say
from palpate.report.page import write_page
from palpate.report.results import assemble, print_findings, truth_of_run, write_results
from palpate.report.rows import Report
from palpate.run.folder import another_folder, lock_output, megabytes_of
from palpate.run.interrupts import all_is_measured, results_first
from palpate.run.progress import RunDisplay
from palpate.run.roles import NONE, OBSERVERS, workers, write_scenario_files
from palpate_bus.contract import contract
from palpate_bus.contract.port_check import violations
from palpate_bus.messages import NS, ExamState, RobotStatus, nanoseconds
from palpate_bus.runs.run_folder import LOCK, in_use
from palpate_bus.runtime.failure import FailureCode
from palpate_bus.settings import RECORDING, Settings
from palpate_bus.wire.zenoh_config import close_session, open_session
from palpate_conductor.conductor import conduct
from palpate_conductor.outcome import RunResult, Timing
from palpate_errors import ExitStatus, UserError
from palpate_models.scenario.load import exam_input, load_scenario
from palpate_models.scenario.schema import Scenario

NEEDS_WALLCLOCK = "services.tissue = 'none' is for hardware, which does not wait: run with --wallclock"
IN_REAL_TIME = "services.tissue = 'none' is in real time: hardware cannot be slowed down"


def conduct_others(out: Path, observers: tuple[str, ...], realtime: bool, wallclock: bool, quiet: bool) -> None:
    """Conduct services that others start and write the results into `out`, which has scenario.yaml."""
    console = SteadyConsole(stderr=True)
    for name in observers:
        if name not in OBSERVERS:
            raise UserError(f"--observers {name}: allowed are {', '.join(OBSERVERS)}")
    chosen = load_scenario(str(out / "scenario.yaml"))
    if chosen.services.tissue == NONE and not wallclock:
        raise UserError(NEEDS_WALLCLOCK)
    rate = Settings.read().rate or 1.0
    if chosen.services.tissue == NONE and rate < 1.0:
        raise UserError(IN_REAL_TIME)
    if (out / "report.json").is_file() or ((out / LOCK).is_file() and not in_use(out)):
        raise UserError(f"--out {out}: it holds the results of a run; `palpate prepare --out {out}` moves them away")
    session = open_session()
    roles = (*workers(chosen), *observers)
    with results_first(), lock_output(out):
        with RunDisplay(console, quiet, chosen.exam) as display:
            timing = Timing(wallclock, 1.0 if realtime else None, rate)
            result = conduct(session, roles, display.show, timing=timing, exam=exam_input(chosen))
        all_is_measured()
        close_session(session)
        conclude(console, out, chosen, result, quiet)


log = logging.getLogger(__name__)
_NAMES = ("OPERATOR_STOP", "ROBOT_HOLD", "EMERGENCY_STOP", "NOT_RELEASED")
HOLD_REASONS = frozenset(getattr(ExamState, f"REASON_{name}") for name in _NAMES)
"""Reasons for which planning gives up with a text that has the cause of the hold."""


def conclude(
    console: Console, folder: Path, scenario: Scenario, result: RunResult, quiet: bool = False, as_json: bool = False
) -> None:
    """Write the results and print the findings. Raises typer.Exit(3) if the run failed or its folder is not writable."""
    with nullcontext() if quiet else console.status("writing report and maps: about ten seconds"):
        report, page, trouble = _write(folder, scenario, result)
    if as_json:
        print_line({"folder": str(folder), **report.model_dump(mode="json")})
    else:
        print_findings(SteadyConsole(), report)
    last = {"assessment/map": result.collected.stiffness_map, "assessment/findings": result.collected.findings}
    for name, message in last.items():  # such as a confidence of 80
        for sentence in [] if message is None else violations(contract().topics[name], message):
            say(f"{sentence}; see docs/topics.md, and palpate check assessment")
    if page is not None and (trouble or not quiet):
        megabytes = megabytes_of(page.parent)
        size = f"{megabytes:.0f} MB" if megabytes >= 1 else "under 1 MB"
        console.print(f"to read: {page} ({size} in {page.parent})", soft_wrap=True)
    if trouble:
        say(trouble)
    if result.failure:
        say(f"the run failed: {result.failure} (logs in {folder / 'logs'}){_hold_text(result)}")
        if (folder / RECORDING).is_dir() and not quiet:
            console.print(f"to examine the remaining targets: palpate run --resume {folder}", soft_wrap=True)
    if result.failure or trouble:
        raise typer.Exit(ExitStatus.FAILED)


def _hold_text(result: RunResult) -> str:
    """Return since when and why the arm is held, if the failure does not say it."""
    changes = result.collected.status_changes
    if not changes or changes[-1].mode != RobotStatus.MODE_SAFE_HOLD:
        return ""
    exam, failure = result.collected.exam, result.failure
    if failure is not None and failure.code is FailureCode.GAVE_UP and exam is not None and exam.reason in HOLD_REASONS:
        return ""
    return f"; the arm has been held since {nanoseconds(changes[-1].header.stamp) / NS:.3f} s: {changes[-1].reason}"


def _write(folder: Path, scenario: Scenario, result: RunResult) -> tuple[Report, Path | None, str]:
    """Write the results into a folder, or into another if that fails; return the report, its page, and what went wrong.

    If no folder is writable, there is no page.
    """
    try:
        return _write_into(folder, scenario, result)
    except OSError as error:
        trouble = f"{folder}: the results cannot be written there ({error.strerror})"
    try:
        other = another_folder()
        write_scenario_files(scenario, other)
        report, page, reason = _write_into(other, scenario, result)
        return report, page, f"{trouble}; they are in {other}" + (f"; {reason}" if reason else "")
    except OSError as error:
        trouble += f", nor in {tempfile.gettempdir()} ({error.strerror}): nothing is kept but what is printed here"
        return assemble(scenario, result, truth_of_run(scenario, result.collected, result.earlier)), None, trouble


def _write_into(folder: Path, scenario: Scenario, result: RunResult) -> tuple[Report, Path, str]:
    """Write the results into a folder, without a map that cannot be drawn; return report, page and why. Raises OSError."""
    try:
        return write_results(folder, scenario, result), write_page(folder), ""
    except OSError:
        raise
    except Exception as error:  # a user-defined assessment may send a map with invalid triangles
        log.exception("the map cannot be used")
        result.collected.stiffness_map = None
        reason = f"assessment/map cannot be used ({type(error).__name__}: {error}); everything else is kept"
        return write_results(folder, scenario, result), write_page(folder), reason
