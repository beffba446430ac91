"""One run of processes on the bus: its scenario files, its start, its end."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import zenoh

from palpate.run.implementations import NONE, chosen_processes
from palpate.run.join import Absent
from palpate.run.own import in_place
from palpate.run.processes import LocalProcesses, compose_file, override_files, read_processes
from palpate.run.result import Progress, RunResult, Tell, given_up
from palpate.run.secure import SecureBus
from palpate.run.takeover import keep_places
from palpate_bus.contract import contract
from palpate_bus.messages.stamps import NS
from palpate_bus.settings import Settings
from palpate_bus.wire.zenoh_config import WALL_CLOCK_DROP_WAIT_US, close_session, open_session
from palpate_conductor.collector import Collector
from palpate_conductor.conductor import Conductor
from palpate_conductor.outcome import Patience, RunFailed
from palpate_conductor.tree import FrameTree
from palpate_models.load import dump_scenario, exam_input, redacted
from palpate_models.scenario import Scenario

WORKERS = ("robot", "tissue", "control", "planning", "supervisor", "assessment", "camera", "perception")
OBSERVERS = ("dashboard", "recorder")
KNOWS_PHANTOM = frozenset({"tissue"})
SIM_LIMIT = 3600 * NS
"""A run that nobody has ended by then [ns] is ended."""


def workers(scenario: Scenario) -> tuple[str, ...]:
    """The roles without which a run of this scenario is none: all, but for the tissue where what is examined is real."""
    return tuple(role for role in WORKERS if role != "tissue" or scenario.tissue.implementation != NONE)


RESULTS = ("report.json", "report.html", "map.png", "samples.csv", "evidence.npz", "bus.json", "recording.rrd")
"""What the end of a run leaves in its folder, and the viewer's drawing; the recorder sees to its own."""


def write_scenario_files(scenario: Scenario, out: Path) -> dict[str, Path]:
    """Makes the results folder and the scenario files; returns the file that each role may see."""
    (out / "logs").mkdir(parents=True, exist_ok=True)
    for name in RESULTS:  # of an earlier run in the same folder: nobody is to take them for this one's
        (out / name).unlink(missing_ok=True)
    full, exam = out / "scenario.yaml", out / "exam.yaml"
    full.write_text(dump_scenario(scenario), encoding="utf-8")
    exam.write_text(dump_scenario(redacted(scenario)), encoding="utf-8")
    return {role: full if role in KNOWS_PHANTOM else exam for role in (*WORKERS, *OBSERVERS)}


def run_distributed(
    scenario: Scenario,
    out: Path,
    tell: Tell,
    observers: tuple[str, ...] = OBSERVERS,
    realtime: float | None = None,
    wallclock: bool = False,
    patience: Patience | None = None,
    secure: SecureBus | None = None,
    own: Mapping[str, Path] | None = None,
    handover_s: float = 0.0,
    absent: Absent | None = None,
) -> RunResult:
    """Starts the local processes of the compose file and conducts them to the end; with `secure` over its router.

    Those of `absent` are left to somebody else to start.

    `own` gives the file that plays a role in place of the compose file's command. In a wall-clock run the place of a service that
    goes is kept for `handover_s`.

    Raises ProcessListError when the compose file cannot be used, BusConfigError when the certificates cannot; later failures are
    in the result.
    """
    begin = perf_counter()
    roles = (*workers(scenario), *observers)
    if absent is not None:
        absent.check(roles)
    files = write_scenario_files(scenario, out)
    listed = read_processes(compose_file(), roles, override_files())
    processes = in_place(chosen_processes(scenario, listed), own or {})
    extra = {
        "PALPATE_RUNTIME": "wallclock" if wallclock else "lockstep",
        "PALPATE_RECORD": str(int("recorder" in observers)),
    }
    if handover_s:
        keep_places(out, processes)
    local = LocalProcesses(roles, out, files, extra, secure)
    try:
        options = local.bus["conductor"]
        session = open_session(replace(options, drop_wait_us=WALL_CLOCK_DROP_WAIT_US) if wallclock else options)
        for role in roles:
            if absent is None or role not in absent.roles:
                local.start(processes[role])
        if absent is not None and absent.roles:
            patience = replace(patience or Patience(), absent=absent.roles, join=absent.wait_s)
            absent.call(out, {role: (processes[role].command, local.environment(processes[role])) for role in absent.roles})

        try:
            tree = FrameTree(exam_input(scenario))
            result = conduct(session, roles, tell, local.ended, realtime, wallclock, patience, begin, tree, handover_s)
            if absent is not None and result.failure is not None:
                result.failure = absent.explain(result.failure)
            return result
        finally:
            close_session(session)
    finally:
        local.stop()


def conduct(
    session: zenoh.Session,
    roles: tuple[str, ...],
    tell: Tell,
    died: Callable[[], Mapping[str, str]] = dict,
    realtime: float | None = None,
    wallclock: bool = False,
    patience: Patience | None = None,
    begin: float | None = None,
    tree: FrameTree | None = None,
    handover_s: float = 0.0,
) -> RunResult:
    """Conducts services that somebody else has started on the bus of `session`, to the end.

    `died` gives the roles whose process is known to be gone, with how; `begin` [s] is when the command came, by `perf_counter`;
    `tree` makes `tf`.
    """
    begin = perf_counter() if begin is None else begin
    collector = Collector(tree=tree)
    domain = Settings.read().domain
    rules = contract()
    conductor = Conductor(session, rules, domain, roles, collector, patience, realtime, SIM_LIMIT, wallclock, handover_s)

    def report(c: Conductor) -> None:
        wall = max(c.elapsed_s, 1e-9)
        t = max(collector.collected.exam_time, 0)
        tell(Progress(t, t / NS / wall, collector.collected, tuple(c.outcome.trouble), c.request))

    try:
        outcome = conductor.run(died, report)
        failure = outcome.failure or given_up(collector.collected)
    except RunFailed as error:
        outcome = conductor.outcome
        failure = str(error)
    return RunResult(
        runtime="wallclock" if wallclock else "distributed",
        collected=collector.collected,
        run_hash=None if wallclock else outcome.run_hash,
        digests=outcome.digests,
        sim_time_s=max(outcome.last_tick, 0) / NS,
        wall_time_s=outcome.wall_time_s,
        start_time_s=(conductor.started_at_perf or perf_counter()) - begin,
        blame={role: detail.get("blame") for role, detail in outcome.reports.items()},
        counters={
            role: {key: value for key, value in detail.items() if key not in ("blame", "digests")}
            for role, detail in outcome.reports.items()
        },
        failure=failure,
        lost=outcome.lost,
        interrupted=outcome.interrupted,
    )
