"""`palpate stop`, `release`, `pause`, `resume`, `step`: an operator controls a run from another terminal."""

from __future__ import annotations

from time import monotonic, sleep
from typing import Annotated

import typer
import zenoh
from rich.console import Console
from rich.markup import escape

from palpate.command_line import EXIT_FAILED, refuse, say
from palpate_bus.runs.joining import NoBus, find, find_all
from palpate_bus.runs.operator_requests import NotAnswered, ask
from palpate_bus.settings import BusConfigError
from palpate_bus.wire.zenoh_config import session

MEET_S = 1.0
"""How long a run may take to be met on the bus."""

Named = Annotated[str | None, typer.Option("--run", metavar="NAME", help="The run: its process id, or part of its name.")]


def stop(
    reason: Annotated[str, typer.Argument(help="Why, for the record.")] = "palpate stop",
    soft: Annotated[
        bool, typer.Option("--soft", help="Retreat along the normal and wait, instead of holding where it is.")
    ] = False,
    run: Named = None,
) -> None:
    """Stop a run at once: the arm holds safely until `palpate release`. Without --run, every run on this machine stops."""
    _say("soft-stop" if soft else "stop", reason, run, everyone=True)


def release(
    end: Annotated[bool, typer.Option("--end", help="End the examination: the arm goes home.")] = False,
    reason: Annotated[str, typer.Option(help="Why, for the record.")] = "palpate release",
    run: Named = None,
) -> None:
    """Release a stop: the examination continues where it was, or with --end the arm goes home and the run ends."""
    _say("end" if end else "release", reason, run)


def pause(run: Named = None) -> None:
    """Pause simulated time, within half a simulated second. No safety stop: the arm does not retreat. Not with --wallclock."""
    _say("pause", "palpate pause", run)


def resume(run: Named = None) -> None:
    """Resume a paused run."""
    _say("resume", "palpate resume", run)


def step(
    ms: Annotated[int, typer.Argument(min=1, max=500, help="Simulated milliseconds.")] = 1,
    run: Named = None,
) -> None:
    """Advance a paused run by some milliseconds."""
    _say("step", "palpate step", run, ms=ms)


def _say(word: str, reason: str, name: str | None, *, everyone: bool = False, ms: int = 0) -> None:
    console = Console(stderr=True)
    try:
        buses = find_all(chosen=name) if everyone else [find(chosen=name)]
    except (NoBus, BusConfigError, OSError) as error:
        refuse(error)
    failed = False
    for bus in buses:
        try:
            with session(bus.operator()) as joined:
                answer, after_ms = _met(joined, bus.domain, word, reason, ms)
        except (NotAnswered, BusConfigError) as error:
            failed = True
            say(f"{bus.title}: {error}")
        else:
            words = f"{bus.title}: {answer} (confirmed after {after_ms:.0f} ms)"
            console.print(escape(words), highlight=False, soft_wrap=True)
    if failed:
        raise typer.Exit(EXIT_FAILED)


def _met(joined: zenoh.Session, domain: int, word: str, reason: str, ms: int) -> tuple[str, float]:
    """Asks until the run has been met: links to its peers come up one by one."""
    begin = monotonic()
    while True:
        try:
            return ask(joined, domain, word, reason, ms)
        except NotAnswered as error:
            if "does not answer" not in str(error) or monotonic() - begin > MEET_S:
                raise
            sleep(0.05)
