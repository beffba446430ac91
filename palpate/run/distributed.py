"""A run with a process for each service or group of services."""

from dataclasses import replace
from pathlib import Path
from time import perf_counter

from palpate.run.group import Groups, one_per_process
from palpate.run.interrupts import all_is_measured
from palpate.run.places import Absent, ServicePlace, write_places
from palpate.run.processes import LocalProcesses, SecureBus, ServiceProcess, compose_file, read_processes
from palpate.run.roles import OBSERVERS, choice, foreign_roles, read_record, workers, write_scenario_files
from palpate_bus import implementations
from palpate_bus.contract import CONDUCTOR
from palpate_bus.settings import Settings
from palpate_bus.wire.zenoh_config import WALL_CLOCK_DROP_WAIT_US, close_session, open_session
from palpate_conductor.conductor import conduct
from palpate_conductor.handover import REPLACEABLE
from palpate_conductor.outcome import Patience, RunResult, Tell, Timing
from palpate_errors import UserError
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.schema import Scenario
from palpate_plugins import is_file


def run_distributed(
    scenario: Scenario,
    out: Path,
    tell: Tell,
    observers: tuple[str, ...] = OBSERVERS,
    timing: Timing | None = None,
    secure: SecureBus | None = None,
    absent: Absent | None = None,
    groups: Groups | None = None,
) -> RunResult:
    """Start the local processes of the compose file and conduct them to the end; with `secure` over its router.

    The user starts the roles of `absent`. `groups`: roles of each process, by default one each.

    Raises UserError if compose file, services, groups or certificates cannot be used; later failures are in the result.
    """
    begin = perf_counter()
    timing = timing or Timing()
    absent = absent or Absent((), 0.0, lambda _: None)
    roles = (*workers(scenario), *observers)
    processes = read_processes(compose_file(), roles)
    started = [process for role, process in processes.items() if role not in absent.roles]
    groups = groups or one_per_process(roles)
    for process in started:
        _check(process, scenario)
    for role in (role for group in groups if len(group) > 1 for role in group):
        _check_shares(processes[role], absent)
    files = write_scenario_files(scenario, out)
    local = LocalProcesses(groups, out, files, timing, read_record(observers), secure)
    at_once = True

    def ended() -> dict[str, str]:
        """Return how processes ended, with the user's file."""
        files = {role: file for role in roles if is_file(file := choice(scenario, role))}
        return {role: f"{how} ({files[role]})" if role in files else how for role, how in local.ended().items()}

    try:
        options = local.bus[CONDUCTOR]
        session = open_session(replace(options, drop_wait_us=WALL_CLOCK_DROP_WAIT_US) if timing.wallclock else options)
        for group in groups:
            if mine := [processes[role] for role in group if role not in absent.roles]:
                local.start(*mine)
        kept = REPLACEABLE if timing.handover_s else frozenset()
        places = {
            role: ServicePlace(one.command, local.environment(one), role in absent.roles, role in kept)
            for role, one in processes.items()
            if role in absent.roles or role in kept
        }
        if places:
            write_places(out, places)
        start_s, step_s = Settings.read().start_limit_s, Settings.read().step_limit_s
        patience = Patience(foreign=foreign_roles(scenario), foreign_start=start_s, foreign_step=step_s)
        if absent.roles:
            patience = patience._replace(absent=absent.roles, join=absent.wait_s)
            absent.call(out, places)
        try:
            with local.as_conductor():
                result = conduct(session, roles, tell, ended, timing, patience, begin, exam_input(scenario))
                all_is_measured()
            at_once = not result.wall_time_s  # it has not begun
            if result.failure is not None:
                result.failure = absent.explain(result.failure)
            return result
        finally:
            close_session(session)
    finally:
        local.stop(at_once=at_once)


def _check(process: ServiceProcess, scenario: Scenario) -> None:
    """Raise PluginError if the implementation of a role cannot be started here. Other programs are not checked."""
    if process.words is not None:
        name = process.words[0] if process.words else choice(scenario, process.role)
        implementations.kind(process.role).check(name)
        implementations.kind(process.role).check_libraries(name)


def _check_shares(process: ServiceProcess, absent: Absent) -> None:
    """Raise UserError for a service that cannot share a process."""
    if process.role in absent.roles:
        raise UserError(f"--without {process.role}: you start it in its own process; leave it out of --group and --processes")
    process.shared_words()
