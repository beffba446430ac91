"""One run from scenario to results folder, distributed or composed."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Mapping
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from importlib.metadata import entry_points
from pathlib import Path
from time import perf_counter
from typing import Any

import zenoh
from palpate_bus.composed import Composed, ServiceFailed
from palpate_bus.contract import contract
from palpate_bus.messages import ExamState
from palpate_bus.recording import RawRecorder
from palpate_bus.service import Service
from palpate_bus.stamps import NS
from palpate_bus.zenoh_config import WALL_CLOCK_DROP_WAIT_US, close_session, domain_from_env, open_session
from palpate_models.load import dump_scenario, exam_input, redacted
from palpate_models.scenario import Scenario

from palpate_conductor.collector import Collected, Collector
from palpate_conductor.conductor import Conductor
from palpate_conductor.implementations import NONE, chosen_environment, chosen_processes, chosen_services
from palpate_conductor.join import Absent
from palpate_conductor.outcome import Patience, RunFailed
from palpate_conductor.own import in_place, load
from palpate_conductor.processes import LocalProcesses, compose_file, override_files, read_processes
from palpate_conductor.secure import SecureBus
from palpate_conductor.takeover import keep_places
from palpate_conductor.tree import FrameTree

WORKERS = ("robot", "tissue", "control", "planning", "supervisor", "assessment", "camera", "perception")
OBSERVERS = ("dashboard", "recorder")
KNOWS_PHANTOM = frozenset({"tissue"})
SIM_LIMIT = 3600 * NS
"""A run that nobody has ended by then [ns] is ended."""


@dataclass
class RunResult:
    """What a run left, in memory."""

    runtime: str
    collected: Collected
    run_hash: str | None
    digests: dict[str, str]
    """SHA-256 over the messages of each hashed topic: where two runs differ, this says in which topic."""
    sim_time_s: float
    wall_time_s: float
    start_time_s: float
    """From the command to the first tick."""
    blame: dict[str, Any]
    counters: dict[str, Any]
    failure: str | None
    """Service and cause, or why planning gave the examination up; None when it completed."""
    lost: dict[str, int]
    interrupted: bool = False
    """Whether it was ended by Ctrl-C or SIGTERM; what it had measured until then is here all the same."""


@dataclass(frozen=True)
class Progress:
    """What a user wants to see while a run is on."""

    t: int
    """Simulated time [ns]."""
    real_time_factor: float
    collected: Collected
    trouble: tuple[str, ...] = ()
    """What went wrong so far: who was lost, when and how."""
    request: Callable[[int, str], None] | None = None
    """Passes on an operator's request, with its reason; None where there is nobody to pass it to."""


Tell = Callable[[Progress], None]


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
        **chosen_environment(scenario),
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
    domain = domain_from_env()
    rules = contract()
    conductor = Conductor(session, rules, domain, roles, collector, patience, realtime, SIM_LIMIT, wallclock, handover_s)

    def report(c: Conductor) -> None:
        wall = max(c.elapsed_s, 1e-9)
        t = max(collector.collected.exam_time, 0)
        tell(Progress(t, t / NS / wall, collector.collected, tuple(c.outcome.trouble), c.request))

    try:
        outcome = conductor.run(died, report)
        failure = outcome.failure or _given_up(collector.collected)
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


def _given_up(collected: Collected) -> str | None:
    """Why planning ended the examination early; None when it did not."""
    exam = collected.exam
    return str(exam.message) if exam is not None and exam.phase == ExamState.PHASE_ABORTED else None


def load_services(scenario: Scenario, roles: tuple[str, ...], own: Mapping[str, Path] | None = None) -> list[Service]:
    """The services of `roles` in this process, from the files of `own` and the entry points `palpate.services`.

    Raises OwnServiceError for a file without a service, RunFailed naming a role that no installed package provides.
    """
    found = {point.name: point for point in entry_points(group="palpate.services")}
    found.update(chosen_services(scenario))
    exam = redacted(scenario)
    services = []
    for role in roles:
        path = (own or {}).get(role)
        if path is None and role not in found:
            raise RunFailed(f"no installed package provides the service {role!r} (entry point palpate.services)")
        create: Callable[[Scenario], Service] = found[role].load() if path is None else load(role, path)
        services.append(create(scenario if role in KNOWS_PHANTOM else exam))
    return services


def run_composed(
    scenario: Scenario,
    out: Path,
    tell: Tell,
    observers: tuple[str, ...] = OBSERVERS,
    own: Mapping[str, Path] | None = None,
) -> RunResult:
    """Runs all services in this process; `own` gives the file that plays a role in place of an installed service."""
    begin = perf_counter()
    write_scenario_files(scenario, out)
    os.environ["PALPATE_OUT"] = str(out)
    os.environ.update(chosen_environment(scenario))
    collector = Collector(tree=FrameTree(exam_input(scenario)))
    observing = load_services(scenario, observers, own)
    recorders = [service for service in observing if isinstance(service, RawRecorder)]
    viewers = [service for service in observing if service not in recorders]
    run = Composed(
        [*load_services(scenario, WORKERS, own), *viewers, collector], taps=[recorder.record for recorder in recorders]
    )
    start = perf_counter()
    failure = None
    last = 0
    told = start

    def end() -> int | None:
        nonlocal told
        now = perf_counter()
        if now - told > 0.1:
            told = now
            tell(Progress(run.t, run.t / NS / (now - start), collector.collected, tuple(run.trouble)))
        return collector.collected.end_tick

    lost: dict[str, int] = {}
    interrupted = False
    gc.freeze()  # full collections in mid-run need not go through all that was loaded
    try:
        last = run.run(end, SIM_LIMIT)
    except KeyboardInterrupt:
        interrupted = True
        failure, last = f"interrupted at tick {run.t / NS:.3f} s", run.t
    except ServiceFailed as error:
        failure = f"{error.role} lost at tick {error.t / NS:.3f} s: {error.why}"
        lost = {error.role: error.t}
        last = error.t
    finally:
        gc.unfreeze()
    wall = perf_counter() - start
    facts = run.finish()
    for recorder in recorders:
        if isinstance(recorder, Service):
            with suppress(Exception) if recorder.role in run.lost else nullcontext():
                facts[recorder.role] = recorder.finish()
    return RunResult(
        runtime="composed",
        collected=collector.collected,
        run_hash=None if failure else run.run_hash(),
        digests=run.digests(),
        sim_time_s=last / NS,
        wall_time_s=wall,
        start_time_s=start - begin,
        blame={role: stepper.blame.per_step_us() for role, stepper in run.steppers.items()},
        counters={role: {"facts": dict(fact)} for role, fact in facts.items()},
        failure=failure or _given_up(collector.collected),
        lost={**run.lost, **lost},
        interrupted=interrupted,
    )
