"""`palpate stop`, `release`, `pause`, `resume`, `step`: an operator's hand on a run in another terminal."""

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

Named = Annotated[str | None, typer.Option("--run", metavar="NAME", help="Which run: its process id, or part of its name.")]


def stop(
    reason: Annotated[str, typer.Argument(help="Why, for the record.")] = "palpate stop",
    soft: Annotated[
        bool, typer.Option("--soft", help="Retreat along the normal and wait, instead of holding where it is.")
    ] = False,
    run: Named = None,
) -> None:
    """Stop a run at once: the arm is held safely until `palpate release`. Without --run: every run of this machine."""
    _say("soft-stop" if soft else "stop", reason, run, everyone=True)


def release(
    end: Annotated[bool, typer.Option("--end", help="Do not go on: go home and end the examination.")] = False,
    reason: Annotated[str, typer.Option(help="Why, for the record.")] = "palpate release",
    run: Named = None,
) -> None:
    """Lift a stop: the examination goes on where it was, or goes home and ends."""
    _say("end" if end else "release", reason, run)


def pause(run: Named = None) -> None:
    """Let simulated time stand, within half a simulated second. Not with --wallclock, and no stop: nothing retreats."""
    _say("pause", "palpate pause", run)


def resume(run: Named = None) -> None:
    """Let the time of a paused run go on."""
    _say("resume", "palpate resume", run)


def step(
    ms: Annotated[int, typer.Argument(min=1, max=500, help="Simulated milliseconds.")] = 1,
    run: Named = None,
) -> None:
    """Let a paused run go on for a moment."""
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
