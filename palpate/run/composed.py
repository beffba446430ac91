"""A run with all services in one child process: a service that exits, crashes or hangs does not take the command with it."""

from collections.abc import Mapping, MutableSequence
from dataclasses import replace
from enum import IntEnum
from pathlib import Path
from time import perf_counter
from typing import Any, Final, NamedTuple

from palpate.apart import ChildLost, Send, TimeLimit, run_apart, shared_numbers
from palpate.environment import set_environment
from palpate.run.interrupts import all_is_measured
from palpate.run.roles import OBSERVERS, choice, foreign_roles, read_record, workers, write_scenario_files
from palpate_bus.contract import contract
from palpate_bus.implementations import create
from palpate_bus.messages import NS
from palpate_bus.runtime.composed import NO_ROLE, Composed, ServiceFailed
from palpate_bus.runtime.failure import Failure, FailureCode
from palpate_bus.runtime.observer import RawRecorder
from palpate_bus.runtime.process import rare_collections
from palpate_bus.service import Service
from palpate_bus.settings import Settings, variable
from palpate_conductor.collector import SIM_LIMIT, Collected, CollectedNews, Collector, FrameTree, collect
from palpate_conductor.outcome import Patience, RunProgress, RunResult, Tell, failure_of, incomplete, unsampled
from palpate_errors import RunError, UserError
from palpate_models.scenario.load import exam_input, restrict_to_view, view_of
from palpate_models.scenario.schema import Scenario

REPORT_S: Final = 0.1
"""Time between two reports of the child."""


class ChildStage(IntEnum):
    """Activity of the child with a service."""

    LOAD = 0
    STEP = 1
    FINISH = 2


class ChildPlace:
    """Progress of the child, in memory that it shares with its parent, and how long it may stay at a place."""

    def __init__(self, foreign: frozenset[str] = frozenset()) -> None:
        """`foreign`: roles that are played by code of the user."""
        self.cells: MutableSequence[int] = shared_numbers()
        """Number of a role, simulated time [ns], stage."""
        self.cells[0] = NO_ROLE
        self._foreign, self._settings, self.patience = foreign, Settings.read(), Patience()

    def enter(self, stage: ChildStage, role: str | None = None) -> None:
        """Set stage and role."""
        self.cells[0] = NO_ROLE if role is None else tuple(contract().roles).index(role)
        self.cells[2] = stage

    def now(self) -> tuple[str | None, int, ChildStage]:
        """Return the role whose code runs, None between two steps; simulated time [ns]; present activity."""
        number, t, stage = self.cells[:3]
        return None if number == NO_ROLE else tuple(contract().roles)[number], t, ChildStage(stage)

    def limit_s(self) -> float:
        """Return the limit at the present place [s]."""
        role, _, stage = self.now()
        if role in self._foreign:
            return self._settings.start_limit_s if stage is ChildStage.LOAD else self._settings.step_limit_s
        return self.patience.start if stage is ChildStage.LOAD else self.patience.hard

    def wait_text(self) -> str:
        """Return a text for a child that stays at its present place."""
        role, t, stage = self.now()
        start = "start; a first run compiles, which takes a minute or more"
        doing = {ChildStage.LOAD: start, ChildStage.FINISH: "finish its files"}
        what = doing.get(stage, f"finish its step at {t / NS:.3f} s")
        return f"waiting for {role or 'the process of all services'} to {what} ({self.limit_s():g} s at most)"

    def failure(self, error: RunError) -> Failure:
        """Return the failure of a run whose child ended with `error`."""
        role, t, stage = self.now()
        hangs = isinstance(error, ChildLost) and error.late
        when = {ChildStage.LOAD: "at start", ChildStage.STEP: f"at {t / NS:.3f} s", ChildStage.FINISH: "at its end"}[stage]
        where = " in its step" if role and stage is ChildStage.STEP else ""
        text = f"{role or 'the process of all services'} lost {when}: {error}{where}"
        if hangs and role in self._foreign:
            text += f" ({variable('start_limit_s' if stage is ChildStage.LOAD else 'step_limit_s')})"
        codes = {ChildStage.LOAD: FailureCode.NO_ANSWER if hangs else FailureCode.START_FAILED}
        code = codes.get(stage, FailureCode.BLOCKED if hangs else FailureCode.ROLE_LOST)
        return Failure(code, text, () if role is None else (role,))


class News(NamedTuple):
    """A report of the child."""

    t: int
    start: float
    """When the first tick began, by `perf_counter` [s]."""
    collected: Mapping[str, Any]
    trouble: tuple[str, ...]
    """Messages for the user since the last report."""
    measured: bool


def load_services(scenario: Scenario, roles: tuple[str, ...], place: ChildPlace | None = None) -> list[Service]:
    """Return the services of `roles` as the scenario chooses them. Raises PluginError for a missing one or missing libraries.

    `place` is kept up to date.
    """
    services = []
    for role in roles:
        if place is not None:
            place.enter(ChildStage.LOAD, role)
        services.append(create(role, choice(scenario, role), restrict_to_view(scenario, view_of(role))))
    return services


def run_composed(scenario: Scenario, out: Path, tell: Tell, observers: tuple[str, ...] = OBSERVERS) -> RunResult:
    """Run all services in one child process. Raises PluginError for a service that cannot be made."""
    begin = perf_counter()
    write_scenario_files(scenario, out)
    place = ChildPlace(foreign_roles(scenario))
    collected = Collector().collected
    start = 0.0
    trouble: list[str] = []
    """Messages for the user, from the child and about what it waits for."""

    def show(t: int) -> None:
        tell(RunProgress(t, t / NS / max(perf_counter() - start, 1e-9), collected, tuple(trouble)))

    def receive(news: News) -> None:
        nonlocal start
        start = news.start
        collect(collected, news.collected)
        if news.measured:
            all_is_measured()
        trouble.extend(news.trouble)
        show(news.t)

    limit = TimeLimit(place.now, place.limit_s)

    def check() -> None:
        if limit.there_s > place.patience.quiet and (text := place.wait_text()) not in trouble:
            trouble.append(text)
            show(place.now()[1])
        limit.check()

    try:
        result = run_apart(lambda send: run_here(scenario, out, observers, place, send), receive, check)
    except UserError:
        raise
    except Exception as error:  # the report needs what was measured
        now, (role, t, _) = perf_counter(), place.now()
        failure = place.failure(error) if isinstance(error, RunError) else failure_of(error, t)
        result = RunResult(
            "composed",
            collected,
            sim_time_s=t / NS,
            wall_time_s=now - (start or now),
            failure=failure,
            lost={} if role is None else {role: t},
        )
    all_is_measured()
    return replace(result, collected=collected, start_time_s=(start or perf_counter()) - begin)


def run_here(scenario: Scenario, out: Path, observers: tuple[str, ...], place: ChildPlace, send: Send) -> RunResult:
    """Run all services in this process. What is collected and the start go to `send`, as `News`, and not into the result."""
    collector = Collector(tree=FrameTree(exam_input(scenario)))
    news = CollectedNews(collector.collected)
    # only observers: the name of the folder may reveal the patient
    with set_environment({"PALPATE_OUT": str(out), "PALPATE_RECORD": read_record(observers)}):
        observing = load_services(scenario, observers, place)
    recorders = [service for service in observing if isinstance(service, RawRecorder)]
    viewers = [service for service in observing if service not in recorders]
    services = [*load_services(scenario, workers(scenario), place), *viewers, collector]
    run = Composed(services, taps=[recorder.record for recorder in recorders], at=place.cells)
    start = perf_counter()
    failure: Failure | None = None
    last = 0
    shown = start
    messages = 0

    def report(measured: bool = False) -> None:
        nonlocal messages
        send(News(run.t, start, news.take(), tuple(run.trouble[messages:]), measured))
        messages = len(run.trouble)

    def end() -> int | None:
        nonlocal shown
        now = perf_counter()
        if now - shown > REPORT_S:
            shown = now
            report()
        return collector.collected.end_tick

    interrupted = False
    try:
        run.start()
        place.enter(ChildStage.STEP)
        with rare_collections():
            last = run.run(end, SIM_LIMIT)
    except ServiceFailed as error:
        last = error.t
    except (Exception, KeyboardInterrupt, SystemExit) as error:  # the report still needs what was measured
        interrupted = isinstance(error, KeyboardInterrupt)
        failure, last = failure_of(error, run.t), run.t
    wall = perf_counter() - start
    report(measured=True)
    place.enter(ChildStage.FINISH)
    facts = run.finish(*recorders)
    place.enter(ChildStage.FINISH)
    report(measured=True)
    failure = failure or run.failure
    return RunResult(
        runtime="composed",
        collected=Collected(),
        run_hash=None if failure else run.run_hash(),
        digests=run.digests(),
        sim_time_s=last / NS,
        wall_time_s=wall,
        blame={role: stepper.blame.per_step_us() for role, stepper in run.steppers.items()},
        counters={role: {"facts": fact} for role, fact in facts.items()},
        failure=failure or incomplete(collector.collected) or unsampled(collector.collected, scenario.exam),
        lost=run.lost,
        interrupted=interrupted,
    )
