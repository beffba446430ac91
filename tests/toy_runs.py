"""Runs of the toy services in real processes over zenoh, placed on processes in any way."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from unittest import mock

import zenoh

from palpate.run.forks import Forked, Forks
from palpate_bus.contract import contract
from palpate_bus.messages.stamps import NS
from palpate_bus.runtime.composed import Composed
from palpate_bus.runtime.failure import FailureCode
from palpate_bus.wire.zenoh_config import BusOptions, close_session, mesh, open_session
from palpate_conductor.collector import Collector
from palpate_conductor.conductor import Conductor
from palpate_conductor.outcome import Patience, RunResult, Timing

sys.path.insert(0, str(Path(__file__).parents[1] / "bus" / "tests"))
import toy_services

TOYS = toy_services.__name__
FORKS = Forks(["palpate_bus.run"])
"""Processes of the toy services, which import their libraries once."""
ROLES = tuple(toy_services.TOYS)
LOOP = ("robot", "tissue", "control")


def with_own_process(*groups: tuple[str, ...]) -> tuple[tuple[str, ...], ...]:
    """Return these groups of roles, and all other roles as one more."""
    return (*groups, tuple(role for role in ROLES if not any(role in group for group in groups)))


APART = tuple((role,) for role in ROLES)
LOOP_APART = with_own_process(("robot",), ("tissue",), ("control",))


@dataclass
class Running:
    """A toy run in progress."""

    processes: dict[str, Forked]
    session: zenoh.Session
    conductor: Conductor


def run_toys(
    meddle: Callable[[Running], None] = lambda _: None,
    environment: Mapping[str, str] | None = None,
    patience: Patience | None = None,
    wallclock: bool = False,
    faults: Mapping[str, tuple[str, ...]] | None = None,
    groups: Sequence[tuple[str, ...]] = (),
    router: str = "",
) -> RunResult:
    """Run the toy services.

    Args:
        meddle: called in every turn of the conductor's loop
        environment: added to that of the services
        patience: time limits of the conductor
        wallclock: run in wall-clock mode instead of lockstep
        faults: by role, a fault of its transport (topic, kind, simulated second)
        groups: roles of each process; by default the 1 kHz loop apart and the rest together, in wall-clock mode each apart
        router: if given, all processes are clients of it
    """
    groups = groups or (APART if wallclock else LOOP_APART)
    with tempfile.TemporaryDirectory(prefix="toy-") as folder:
        loop = tuple(group[0] for group in groups if set(group) <= set(LOOP))
        bus = mesh(("conductor", *(group[0] for group in groups)), Path(folder), lowlatency=loop)
        if router:
            bus = dict.fromkeys(bus, BusOptions(mode="client", router=router))
        session = open_session(bus["conductor"])
        base = {
            **os.environ,
            **(environment or {}),
            "PALPATE_SCENARIO": "none",
            "PALPATE_ABSENT": ",".join(name for name in contract().roles if contract().roles[name].optional),
            "PALPATE_RUNTIME": "wallclock" if wallclock else "lockstep",
        }
        started = {
            group: FORKS.start(
                (sys.executable, "-m", TOYS, ",".join(group), *(faults or {}).get(group[0], ())),
                {**base, **bus[group[0]].to_env()},
                Path(os.devnull),
            )
            for group in groups
        }
        processes = {role: child for group, child in started.items() for role in group}
        conductor = Conductor(session, contract(), 0, ROLES, Collector(), patience, Timing(wallclock=wallclock))
        running = Running(processes, session, conductor)

        def exited() -> dict[str, str]:
            return {role: f"status {code}" for role, child in processes.items() if (code := child.poll()) is not None}

        try:
            return conductor.run(exited, lambda _: meddle(running))
        finally:
            for child in processes.values():
                try:
                    child.wait(timeout=3)
                except subprocess.TimeoutExpired:
                    child.kill()
                    child.wait()
            close_session(session)


def assert_failed(outcome: RunResult, code: FailureCode, *roles: str) -> None:
    assert outcome.failure.code is code, outcome.failure
    assert set(outcome.failure.roles) == set(roles), outcome.failure


@cache
def composed_hash(end: int = toy_services.END) -> str:
    """Return the run hash of the toy services in one process, up to `end` [ns]."""
    collector = Collector()
    run = Composed([*(toy() for toy in toy_services.TOYS.values()), collector])
    with mock.patch.object(toy_services, "END", end):
        assert run.run(lambda: collector.collected.end_tick, 60 * NS) == end
    return run.run_hash()


def at(running: Running, seconds: float, done: list[bool]) -> bool:
    """Return True once, when the simulated time is reached."""
    reached = running.conductor.watchdog.progress["robot"].tick > seconds * NS
    if reached and not done:
        done.append(True)
        return True
    return False


def once(seconds: float, act: Callable[[Running], None]) -> Callable[[Running], None]:
    """Return a `meddle` that calls `act` once, when the simulated time is reached."""
    done: list[bool] = []
    return lambda running: act(running) if at(running, seconds, done) else None
