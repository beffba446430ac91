"""How a tool joins the bus of a run in another process, which `palpate_bus.runs.joining` finds."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from time import monotonic, sleep

import typer
import zenoh

from palpate.command_line import refuse
from palpate.live.options import ChosenBus
from palpate_bus.contract import Contract
from palpate_bus.runs.joining import BusTarget, NoBus, find
from palpate_bus.security.access import public
from palpate_bus.settings import BusConfigError
from palpate_bus.wire.zenoh_config import BusOptions, session

FIND_S = 1.0
"""How long a tool waits for its links before it goes on with those that it has."""


@contextmanager
def refusing() -> Iterator[None]:
    """Wraps a command: no bus and bad input end it with a sentence and status 2."""
    try:
        yield
    except (NoBus, BusConfigError) as error:
        refuse(error)


@contextmanager
def command() -> Iterator[None]:
    """As `refusing`, for a command that goes on until Ctrl-C, which ends it with status 0."""
    try:
        with refusing():
            yield
    except KeyboardInterrupt:
        sys.stdout.flush()
        raise typer.Exit(0) from None


@dataclass(frozen=True)
class Joined:
    """A bus that was joined."""

    session: zenoh.Session
    target: BusTarget

    @property
    def domain(self) -> int:
        """ROS domain."""
        return self.target.domain

    def audible(self, rules: Contract) -> list[str]:
        """The topics that may be heard: where the bus is secure, the public ones."""
        return list(rules.topics) if self.target.options.tls is None else public(rules)


@contextmanager
def joined(chosen: ChosenBus) -> Iterator[Joined]:
    """Joins the bus that the user means, for a `with` block. Raises NoBus."""
    target = find(*chosen)
    try:
        with session(target.options) as bus:
            settle(bus, target.options)
            yield Joined(bus, target)
    except BusConfigError as error:
        raise NoBus(str(error)) from error


def settle(bus: zenoh.Session, options: BusOptions) -> None:
    """Waits until every endpoint has answered, at most `FIND_S`. Raises NoBus when none has."""
    wanted = len(options.connect) + bool(options.router)
    end = monotonic() + FIND_S
    while (links := len(bus.info.peers_zid()) + len(bus.info.routers_zid())) < wanted and monotonic() < end:
        sleep(0.02)
    if wanted and not links:
        tried = ", ".join((*options.connect, *([options.router] if options.router else [])))
        raise NoBus(f"no answer at {tried}")
