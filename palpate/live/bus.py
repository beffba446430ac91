"""Options that select a live bus, the connection to it, and what is there, from its liveliness tokens; `palpate node list`."""

import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import groupby
from operator import attrgetter
from time import monotonic, sleep
from typing import Annotated, Any, NamedTuple

import typer
import zenoh
from rich.text import Text

from palpate.console import print_json, table, wide_console
from palpate_bus.contract import Contract, contract
from palpate_bus.runs.announcement import BusTarget, NoBusError, Run, find
from palpate_bus.wire.liveliness import Endpoint, Entity, EntityKind, GraphWatch
from palpate_bus.wire.zenoh_config import BusOptions, session

_ENDPOINT = "Endpoint to join, e.g. tcp/10.0.0.5:7447; may be repeated."
Connect = Annotated[list[str] | None, typer.Option("--connect", "-c", metavar="ENDPOINT", help=_ENDPOINT)]
ChosenRun = Annotated[str | None, typer.Option("--run", metavar="NAME", help="The run: its process id, or part of its name.")]
Domain = Annotated[int | None, typer.Option(help="ROS domain; by default the run's, else ROS_DOMAIN_ID.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]

LINK_TIMEOUT_S = 1.0
QUIET_S = 0.3
"""Tokens arrive in a burst; after this long without a new one the list is taken as complete."""


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


def present(bus: Joined) -> list[Entity]:
    """Return the entities on the bus, sorted by token. Waits for the run's roles and until no new token arrives."""
    expected = set(bus.target.run.endpoints) if bus.target.run is not None else set()
    watch = GraphWatch(bus.session, bus.target.domain)
    try:
        end = monotonic() + 3.0
        quiet = monotonic()
        while monotonic() < end:
            if watch.changes(timeout=0.05):
                quiet = monotonic()
            if monotonic() - quiet > QUIET_S and watch.alive and expected <= watch.roles():
                break
        return [watch.alive[token] for token in sorted(watch.alive)]
    finally:
        watch.close()


def ends(found: Iterable[Entity], *kinds: EntityKind) -> list[tuple[str, Endpoint]]:
    """Return node and endpoint of the entities of some kinds."""
    return [(entity.node, entity.endpoint) for entity in found if entity.kind in kinds and entity.endpoint is not None]


def missing(contract: Contract, found: Iterable[Entity], run: Run | None) -> list[str]:
    """Return the roles that are not on the bus, critical ones first.

    Expected are all observers and the roles of `run`, or, if the run is unknown, the roles of every run.
    """
    there, roles = {entity.node for entity in found}, contract.roles.values()
    expected = [role for role in roles if role.observer or (role.name in run.endpoints if run else not role.optional)]
    expected.sort(key=lambda role: (role.observer, not role.critical))
    return [role.name for role in expected if role.name not in there]


app = typer.Typer(help="Nodes on a live bus.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """Nodes on a live bus."""


@app.command("list")
def list_nodes(connect: Connect = None, run: ChosenRun = None, domain: Domain = None, as_json: AsJson = False) -> None:
    """List the nodes on the bus, with what each publishes and subscribes to, and the roles that are missing."""
    with join_bus(connect, run, domain) as bus:
        found = present(bus)
        absent = missing(contract(), found, bus.target.run)
    listed: list[dict[str, Any]] = []
    for name, own in groupby(sorted(found, key=attrgetter("node")), key=attrgetter("node")):
        mine = list(own)
        kinds = {"publishes": EntityKind.PUBLISHER, "subscribes": EntityKind.SUBSCRIPTION}
        topics = {what: sorted(end.topic for _, end in ends(mine, kind)) for what, kind in kinds.items()}
        listed.append({"node": name, "role": name in contract().roles, "sessions": sorted({one.zid for one in mine}), **topics})
    if as_json:
        print_json({"nodes": listed, "missing": absent})
        return
    out = table("node", "what", ">publishes", ">subscribes", "session")
    for node in listed:
        role = contract().roles.get(node["node"])
        what = role.doc if role is not None else Text("not a role of the contract", "dim")
        out.add_row(node["node"], what, *(str(len(node[key])) for key in ("publishes", "subscribes")), " ".join(node["sessions"]))
    wide_console().print(out)
    if absent:
        wide_console().print(f"not there: {', '.join(absent)}", style="dim")
