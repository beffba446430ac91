"""One run of processes on the bus: its start and its end."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from time import perf_counter

from palpate.run.places import Absent, ServicePlace, write_places
from palpate.run.processes import LocalProcesses, ServiceProcess, compose_file, override_files, read_processes
from palpate.run.roles import OBSERVERS, choice, workers, write_scenario_files
from palpate.run.secure import SecureBus
from palpate_bus import implementations
from palpate_bus.wire.zenoh_config import WALL_CLOCK_DROP_WAIT_US, close_session, open_session
from palpate_conductor.conduct import conduct
from palpate_conductor.handover import ROLES
from palpate_conductor.outcome import Patience
from palpate_conductor.result import RunResult, Tell
from palpate_conductor.timing import Timing
from palpate_conductor.tree import FrameTree
from palpate_models.load import exam_input
from palpate_models.scenario import Scenario


def run_distributed(
    scenario: Scenario,
    out: Path,
    tell: Tell,
    observers: tuple[str, ...] = OBSERVERS,
    timing: Timing | None = None,
    patience: Patience | None = None,
    secure: SecureBus | None = None,
    absent: Absent | None = None,
) -> RunResult:
    """Starts the local processes of the compose file and conducts them to the end; with `secure` over its router.

    The roles of `absent` are left to somebody else to start.

    Raises ProcessListError when the compose file cannot be used, ChoiceError when a service cannot, BusConfigError when the
    certificates cannot; later failures are in the result.
    """
    begin = perf_counter()
    timing = timing or Timing()
    absent = absent or Absent((), 0.0, lambda _: None)
    roles = (*workers(scenario), *observers)
    absent.check(roles)
    processes = read_processes(compose_file(), roles, override_files())
    started = [process for role, process in processes.items() if role not in absent.roles]
    for process in started:
        _check(process, scenario)
    files = write_scenario_files(scenario, out)
    local = LocalProcesses(roles, out, files, timing, "recorder" in observers, secure)
    try:
        options = local.bus["conductor"]
        session = open_session(replace(options, drop_wait_us=WALL_CLOCK_DROP_WAIT_US) if timing.wallclock else options)
        for process in started:
            local.start(process)
        others = (*absent.roles, *(ROLES if timing.handover_s else ()))
        places = {
            role: ServicePlace(process.command, local.environment(process), role in absent.roles)
            for role, process in processes.items()
            if role in others
        }
        if places:
            write_places(out, places)
        if absent.roles:
            patience = replace(patience or Patience(), absent=absent.roles, join=absent.wait_s)
            absent.call(out, places)
        try:
            tree = FrameTree(exam_input(scenario))
            result = conduct(session, roles, tell, local.ended, timing, patience, begin, tree)
            if result.failure is not None:
                result.failure = absent.explain(result.failure)
            return result
        finally:
            close_session(session)
    finally:
        local.stop()


def _check(process: ServiceProcess, scenario: Scenario) -> None:
    """Raises ChoiceError when what plays a role cannot be started here. A program that is none of ours is not looked at."""
    python, *words = process.command
    if python == "python" and words[:2] == ["-m", f"palpate_{process.role}"]:
        name = words[2] if len(words) > 2 else choice(scenario, process.role)
        implementations.check(process.role, name)
        implementations.check_libraries(process.role, name)
