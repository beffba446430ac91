"""Runs of the toy services in real processes over zenoh, placed on processes in any way."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import zenoh

from palpate_bus.contract import contract
from palpate_bus.messages.stamps import NS
from palpate_bus.runtime.composed import Composed
from palpate_bus.runtime.failure import FailureCode
from palpate_bus.wire.zenoh_config import BusOptions, close_session, mesh, open_session
from palpate_conductor.collector import Collector
from palpate_conductor.conductor import Conductor
from palpate_conductor.outcome import Patience, RunResult, Timing

TOYS = Path(__file__).parents[1] / "bus" / "tests" / "toy_services.py"
sys.path.insert(0, str(TOYS.parent))
import toy_services  # noqa: E402

ROLES = tuple(toy_services.TOYS)
APART = tuple((role,) for role in ROLES)


@dataclass
class Running:
    """A toy run in progress."""

    processes: dict[str, subprocess.Popen[bytes]]
    session: zenoh.Session
    conductor: Conductor


def run_toys(
    meddle: Callable[[Running], None] = lambda _: None,
    environment: Mapping[str, str] | None = None,
    patience: Patience | None = None,
    wallclock: bool = False,
    faults: Mapping[str, tuple[str, ...]] | None = None,
    groups: Sequence[tuple[str, ...]] = APART,
    router: str = "",
) -> RunResult:
    """Run the toy services.

    Args:
        meddle: called in every turn of the conductor's loop
        environment: added to that of the services
        patience: time limits of the conductor
        wallclock: run in wall-clock mode instead of lockstep
        faults: by role, a fault of its transport (topic, kind, simulated second)
        groups: roles of each process
        router: if given, all processes are clients of it
    """
    with tempfile.TemporaryDirectory(prefix="toy-") as folder:
        loop = tuple(group[0] for group in groups if {"robot", "control", "tissue"}.issuperset(group))
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
            group: subprocess.Popen(
                [sys.executable, str(TOYS), ",".join(group), *(faults or {}).get(group[0], ())],
                env={**base, **bus[group[0]].to_env()},
                stderr=subprocess.DEVNULL,
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


def composed_hash() -> str:
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
