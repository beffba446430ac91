"""Conducts services that somebody else has started, and says what came of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from time import perf_counter

import zenoh

from palpate_bus.contract import contract
from palpate_bus.messages.stamps import NS
from palpate_bus.runtime.collection import rare_collections
from palpate_bus.settings import Settings
from palpate_conductor.collector import Collector
from palpate_conductor.conductor import Conductor
from palpate_conductor.outcome import Patience, RunFailed
from palpate_conductor.result import RunProgress, RunResult, Tell, given_up
from palpate_conductor.timing import Timing
from palpate_conductor.tree import FrameTree


def conduct(
    session: zenoh.Session,
    roles: tuple[str, ...],
    tell: Tell,
    died: Callable[[], Mapping[str, str]] = dict,
    timing: Timing | None = None,
    patience: Patience | None = None,
    begin: float | None = None,
    tree: FrameTree | None = None,
) -> RunResult:
    """Conducts services that somebody else has started on the bus of `session`, to the end.

    `died` gives the roles whose process is known to be gone, with how; `begin` [s] is when the command came, by `perf_counter`;
    `tree` makes `tf`.
    """
    begin = perf_counter() if begin is None else begin
    timing = timing or Timing()
    collector = Collector(tree=tree)
    conductor = Conductor(session, contract(), Settings.read().domain, roles, collector, patience, timing)

    def report(c: Conductor) -> None:
        wall = max(c.elapsed_s, 1e-9)
        t = max(collector.collected.exam_time, 0)
        tell(RunProgress(t, t / NS / wall, collector.collected, tuple(c.outcome.trouble), c.request))

    try:
        with rare_collections():
            outcome = conductor.run(died, report)
        failure = outcome.failure or given_up(collector.collected)
        if failure and (interruption := conductor.watchdog.interruption):
            failure = f"{failure}; {interruption}"
    except RunFailed as error:
        outcome = conductor.outcome
        failure = str(error)
    return RunResult(
        runtime="wallclock" if timing.wallclock else "distributed",
        collected=collector.collected,
        run_hash=None if timing.wallclock else outcome.run_hash,
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
