"""Options that select a live bus, and the connection to it."""

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from time import monotonic, sleep
from typing import Annotated, NamedTuple

import typer
import zenoh

from palpate_bus.runs.announcement import BusTarget, NoBusError, find
from palpate_bus.wire.zenoh_config import BusOptions, session

_ENDPOINT = "Endpoint to join, e.g. tcp/10.0.0.5:7447; may be repeated."
Connect = Annotated[list[str] | None, typer.Option("--connect", "-c", metavar="ENDPOINT", help=_ENDPOINT)]
ChosenRun = Annotated[str | None, typer.Option("--run", metavar="NAME", help="The run: its process id, or part of its name.")]
Domain = Annotated[int | None, typer.Option(help="ROS domain; by default the run's, else ROS_DOMAIN_ID.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]

LINK_TIMEOUT_S = 1.0


class Joined(NamedTuple):
    """A zenoh session on the bus of a run."""

    session: zenoh.Session
    target: BusTarget


@contextmanager
def join_bus(connect: Sequence[str] | None, run: str | None, domain: int | None) -> Iterator[Joined]:
    """Join a bus for a `with` block: by endpoints, or of a run, by default the only one on this machine.

    Ctrl-C ends the command with status 0. Raises UserError if there is no such bus.
    """
    target = find(connect, run, domain)
    try:
        with session(target.options) as bus:
            _wait_for_links(bus, target.options)
            yield Joined(bus, target)
    except KeyboardInterrupt:
        sys.stdout.flush()
        raise typer.Exit(0) from None


def _wait_for_links(bus: zenoh.Session, options: BusOptions) -> None:
    """Wait until every endpoint has answered, at most `LINK_TIMEOUT_S`. Raises NoBusError if none has."""
    end = monotonic() + LINK_TIMEOUT_S
    while (links := len(bus.info.peers_zid()) + len(bus.info.routers_zid())) < len(options.asked) and monotonic() < end:
        sleep(0.02)
    if options.asked and not links:
        raise NoBusError(f"no answer at {', '.join(options.asked)}")
