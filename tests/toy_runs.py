"""Runs of the toy services in real processes over zenoh, placed on processes in any way."""

import multiprocessing
import os
import runpy
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from multiprocessing.context import ForkServerProcess
from pathlib import Path

import zenoh

from palpate_bus.contract import contract
from palpate_bus.messages import NS
from palpate_bus.runtime.composed import Composed
from palpate_bus.runtime.failure import FailureCode
from palpate_bus.wire.zenoh_config import BusOptions, close_session, mesh, open_session
from palpate_conductor.collector import Collector
from palpate_conductor.conductor import Conductor
from palpate_conductor.outcome import Patience, RunResult, Timing

sys.path.insert(0, str(Path(__file__).parents[1] / "bus" / "tests"))
import toy_services

TOYS = toy_services.__name__
FORKS = multiprocessing.get_context("forkserver")
"""Processes of the toy services, which import their libraries once."""
FORKS.set_forkserver_preload(["palpate_bus.run"])
ROLES = tuple(toy_services.TOYS)
LOOP = ("robot", "tissue", "control")


def with_own_process(*groups: tuple[str, ...]) -> tuple[tuple[str, ...], ...]:
    """Return these groups of roles, and all other roles as one more."""
    return (*groups, tuple(role for role in ROLES if not any(role in group for group in groups)))


APART = tuple((role,) for role in ROLES)
LOOP_APART = with_own_process(("robot",), ("tissue",), ("control",))


def become_toys(words: Sequence[str], environment: Mapping[str, str]) -> None:
    """Be the process of the toy services with these arguments and this environment."""
    os.setpgid(0, 0)
    os.environ.clear()
    os.environ.update(environment)
    contract.cache_clear()  # the fork server may have read it for another run
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, sys.stdout.fileno())
    os.dup2(null, sys.stderr.fileno())
    sys.argv = [TOYS, *words]
    runpy.run_module(TOYS, run_name="__main__", alter_sys=True)


def started(words: Sequence[str], environment: Mapping[str, str]) -> ForkServerProcess:
    """Start a process of the toy services."""
    process = FORKS.Process(target=become_toys, args=(tuple(words), dict(environment)), daemon=True)
    process.start()
    return process


@dataclass
class Running:
    """A toy run in progress."""

    processes: dict[str, ForkServerProcess]
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
        processes: dict[str, ForkServerProcess] = {}
        for group in groups:
            words = (",".join(group), *(faults or {}).get(group[0], ()))
            processes |= dict.fromkeys(group, started(words, {**base, **bus[group[0]].to_env()}))
        conductor = Conductor(session, contract(), 0, ROLES, Collector(), patience, Timing(wallclock=wallclock))
        running = Running(processes, session, conductor)

        def exited() -> dict[str, str]:
            return {role: f"status {code}" for role, child in processes.items() if (code := child.exitcode) is not None}

        try:
            return conductor.run(exited, lambda _: meddle(running))
        finally:
            for child in processes.values():
                child.join(timeout=3)
                child.kill()
                child.join()
            close_session(session)


def assert_failed(outcome: RunResult, code: FailureCode, *roles: str) -> None:
    assert outcome.failure.code is code, outcome.failure
    assert set(outcome.failure.roles) == set(roles), outcome.failure


@cache
def composed_hash() -> str:
    """Return the run hash of the toy services in one process."""
    collector = Collector()
    run = Composed([*(toy() for toy in toy_services.TOYS.values()), collector])
    assert run.run(lambda: collector.collected.end_tick, 60 * NS) == toy_services.END
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
