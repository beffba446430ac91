"""Topics and nodes of a live bus, from its liveliness tokens; `palpate node list`."""

from collections.abc import Iterable
from itertools import groupby
from operator import attrgetter
from time import monotonic
from typing import Any

import typer
from rich.text import Text

from palpate.console import print_json, table, wide_console
from palpate.live.bus import AsJson, ChosenRun, Connect, Domain, Joined, join_bus
from palpate_bus.contract import Contract, contract
from palpate_bus.runs.announcement import Run
from palpate_bus.wire.liveliness import Endpoint, Entity, EntityKind, GraphWatch

QUIET_S = 0.3
"""Tokens arrive in a burst; after this long without a new one the list is taken as complete."""


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
