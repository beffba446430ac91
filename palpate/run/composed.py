"""One run with all its services in this process."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Mapping
from contextlib import nullcontext, suppress
from importlib.metadata import entry_points
from pathlib import Path
from time import perf_counter

from palpate.run.distributed import KNOWS_PHANTOM, OBSERVERS, SIM_LIMIT, WORKERS, write_scenario_files
from palpate.run.implementations import chosen_services
from palpate.run.own import load
from palpate.run.result import Progress, RunResult, Tell, given_up
from palpate_bus.messages.stamps import NS
from palpate_bus.runtime.composed import Composed, ServiceFailed
from palpate_bus.runtime.recording import RawRecorder
from palpate_bus.service import Service
from palpate_conductor.collector import Collector
from palpate_conductor.outcome import RunFailed
from palpate_conductor.tree import FrameTree
from palpate_models.load import exam_input, redacted
from palpate_models.scenario import Scenario


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
        failure=failure or given_up(collector.collected),
        lost={**run.lost, **lost},
        interrupted=interrupted,
    )
