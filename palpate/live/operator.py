"""What an operator asks of a run from another terminal."""

from __future__ import annotations

from time import monotonic, sleep

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


def request(word: str, reason: str, name: str | None, *, everyone: bool = False, ms: int = 0) -> None:
    """Sends a request to the run that is meant, or to every one, and prints the answers.

    Raises typer.Exit where there is no such run, or one does not answer.
    """
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
