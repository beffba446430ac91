"""A run with all services in this process."""

from __future__ import annotations

from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from time import perf_counter

from palpate.environment import given
from palpate.run.interrupts import all_is_measured
from palpate.run.roles import OBSERVERS, choice, kept, workers, write_scenario_files
from palpate_bus.implementations import create
from palpate_bus.messages.stamps import NS
from palpate_bus.runtime.composed import Composed, ServiceFailed
from palpate_bus.runtime.failure import Failure
from palpate_bus.runtime.process import rare_collections
from palpate_bus.runtime.recording import RawRecorder
from palpate_bus.service import Service
from palpate_conductor.collector import Collector, FrameTree
from palpate_conductor.outcome import SIM_LIMIT, RunProgress, RunResult, Tell, failure_of, gave_up
from palpate_models.scenario.load import exam_input, seen, view_of
from palpate_models.scenario.schema import Scenario


def load_services(scenario: Scenario, roles: tuple[str, ...]) -> list[Service]:
    """Return the services of `roles` as the scenario chooses them. Raises PluginError for a missing one or missing libraries."""
    return [create(role, choice(scenario, role), seen(scenario, view_of(role))) for role in roles]


def run_composed(scenario: Scenario, out: Path, tell: Tell, observers: tuple[str, ...] = OBSERVERS) -> RunResult:
    """Runs all services in this process. Raises PluginError for a service that cannot be made."""
    begin = perf_counter()
    write_scenario_files(scenario, out)
    collector = Collector(tree=FrameTree(exam_input(scenario)))
    observer_settings = {"PALPATE_OUT": str(out), "PALPATE_RECORD": kept(observers)}
    with given(observer_settings):  # only observers: the name of the results folder may reveal the patient
        observing = load_services(scenario, observers)
    recorders = [service for service in observing if isinstance(service, RawRecorder)]
    viewers = [service for service in observing if service not in recorders]
    run = Composed(
        [*load_services(scenario, workers(scenario)), *viewers, collector], taps=[recorder.record for recorder in recorders]
    )
    start = perf_counter()
    failure: Failure | None = None
    last = 0
    shown = start

    def end() -> int | None:
        nonlocal shown
        now = perf_counter()
        if now - shown > 0.1:
            shown = now
            tell(RunProgress(run.t, run.t / NS / (now - start), collector.collected, tuple(run.trouble)))
        return collector.collected.end_tick

    lost: dict[str, int] = {}
    interrupted = False
    try:
        with rare_collections():
            last = run.run(end, SIM_LIMIT)
    except ServiceFailed as error:
        failure = replace(error.failure, text=f"{error.role} lost at {error.t / NS:.3f} s: {error.failure}")
        lost = {error.role: error.t}
        last = error.t
    except (Exception, KeyboardInterrupt, SystemExit) as error:  # the report still needs what was measured
        interrupted = isinstance(error, KeyboardInterrupt)
        failure, last = failure_of(error, run.t), run.t
    all_is_measured()
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
        failure=failure or gave_up(collector.collected),
        lost={**run.lost, **lost},
        interrupted=interrupted,
    )
