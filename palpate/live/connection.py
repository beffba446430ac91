"""How a tool joins the bus of a run in another process, which `palpate_bus.runs.joining` finds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from time import monotonic, sleep
from typing import Annotated

import typer
import zenoh

from palpate_bus.contract import Contract
from palpate_bus.runs.joining import BusTarget, NoBus, find
from palpate_bus.security.access import public
from palpate_bus.settings import BusConfigError
from palpate_bus.wire.zenoh_config import BusOptions, session

FIND_S = 1.0
"""How long a tool waits for its links before it goes on with those that it has."""

Connect = Annotated[
    list[str] | None,
    typer.Option("--connect", "-c", metavar="ENDPOINT", help="Endpoint to join, e.g. tcp/10.0.0.5:7447; may be repeated."),
]
ChosenRun = Annotated[str | None, typer.Option("--run", metavar="NAME", help="The run: its process id, or part of its name.")]
Domain = Annotated[int | None, typer.Option(help="ROS domain; by default the run's, else ROS_DOMAIN_ID.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]


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
def joined(connect: Sequence[str] | None, chosen: str | None, domain: int | None) -> Iterator[Joined]:
    """Joins the bus that the user means, for a `with` block. Raises NoBus."""
    target = find(connect, chosen, domain)
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
