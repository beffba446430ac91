"""`palpate stop` and `palpate release`: an operator's hand on a run in another terminal."""

from __future__ import annotations

import os
from time import monotonic, sleep
from typing import Annotated

import typer
from palpate_bus import runs
from palpate_bus.desk import NotAnswered, ask
from palpate_bus.zenoh_config import BusOptions, close_session, open_session
from rich.console import Console
from rich.markup import escape

EXIT_BAD_INPUT = 2
EXIT_FAILED = 3
MEET_S = 1.0
"""How long a run may take to be met on the bus."""

Named = Annotated[str | None, typer.Option("--run", help="Which run, by its results folder's name; by default the newest.")]


def stop(
    reason: Annotated[str, typer.Argument(help="Why, for the record.")] = "palpate stop",
    soft: Annotated[
        bool, typer.Option("--soft", help="Retreat along the normal and wait, instead of holding where it is.")
    ] = False,
    run: Named = None,
) -> None:
    """Stop a run at once: the arm is held safely until `palpate release`."""
    _say("soft-stop" if soft else "stop", reason, run)


def release(
    end: Annotated[bool, typer.Option("--end", help="Do not go on: go home and end the examination.")] = False,
    reason: Annotated[str, typer.Option(help="Why, for the record.")] = "palpate release",
    run: Named = None,
) -> None:
    """Lift a stop: the examination goes on where it was, or goes home and ends."""
    _say("end" if end else "release", reason, run)


def _say(word: str, reason: str, name: str | None) -> None:
    console = Console(stderr=True)
    options, domain, title = _bus(console, name)
    session = open_session(options)
    try:
        answer, after_ms = _met(session, domain, word, reason)
    except NotAnswered as error:
        console.print(f"[bold red]palpate:[/] {title}: {escape(str(error))}", highlight=False, soft_wrap=True)
        raise typer.Exit(EXIT_FAILED) from None
    finally:
        close_session(session)
    console.print(f"{title}: {answer} (confirmed after {after_ms:.0f} ms)", highlight=False, soft_wrap=True)


def _met(session: object, domain: int, word: str, reason: str) -> tuple[str, float]:
    """Asks until the run has been met: links to its peers come up one by one."""
    begin = monotonic()
    while True:
        try:
            return ask(session, domain, word, reason)  # type: ignore[arg-type]
        except NotAnswered as error:
            if "does not answer" not in str(error) or monotonic() - begin > MEET_S:
                raise
            sleep(0.05)


def _bus(console: Console, name: str | None) -> tuple[BusOptions, int, str]:
    """How to join the run, its ROS domain and its name."""
    if os.environ.get("PALPATE_ROUTER"):
        return BusOptions.from_env(), int(os.environ.get("ROS_DOMAIN_ID", "0")), os.environ["PALPATE_ROUTER"]
    live = [run for run in runs.live() if name is None or run.name == name]
    if not live:
        known = ", ".join(run.name for run in runs.live()) or "there is none"
        wanted = "no run is on" if name is None else f"no run {name!r}"
        console.print(f"[bold red]palpate:[/] {wanted}; on this machine: {known}. In containers set PALPATE_ROUTER")
        raise typer.Exit(EXIT_BAD_INPUT)
    return live[-1].options(), live[-1].domain, live[-1].name
