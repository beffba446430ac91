"""Topics and nodes of a live bus, from its liveliness tokens; `palpate node list`."""

from collections.abc import Iterable
from itertools import groupby
from operator import attrgetter
from time import monotonic
from typing import Any

import typer
from rich.text import Text

from palpate.console import print_json, table, wide_console
from palpate.live.bus import AsJson, ChosenRun, Connect, Domain, Joined, joined
from palpate_bus.contract import Contract, contract
from palpate_bus.runs.announcement import Run
from palpate_bus.wire.liveliness import Endpoint, Entity, EntityKind, GraphWatch

QUIET_S = 0.3
"""Tokens arrive in a burst; after this long without a new one the list is taken as complete."""


def present(bus: Joined) -> list[Entity]:
    """Return the entities on the bus, sorted by token. Waits for the run's roles and until no new token arrives."""
    expected = set(bus.target.run.endpoints) if bus.target.run is not None else set()
    watch = GraphWatch(bus.session, bus.domain)
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


def processes(found: Iterable[Entity]) -> list[tuple[str, ...]]:
    """Return the nodes of each process, sorted: those that share a session. On a secure bus each node has its own session."""
    by_session: dict[str, set[str]] = {}
    for entity in found:
        by_session.setdefault(entity.zid, set()).add(entity.node)
    return sorted(tuple(sorted(names)) for names in by_session.values())


def missing(rules: Contract, found: Iterable[Entity], run: Run | None) -> list[str]:
    """Return the roles that are not on the bus, critical ones first.

    Expected are all observers and the roles of `run`, or, if the run is unknown, the roles of every run.
    """
    there = {entity.node for entity in found}
    absent = [
        role
        for role in rules.roles.values()
        if role.name not in there and (role.observer or (role.name in run.endpoints if run is not None else not role.optional))
    ]
    return [role.name for role in sorted(absent, key=lambda role: (role.observer, not role.critical))]


app = typer.Typer(help="Nodes on a live bus.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """Nodes on a live bus."""


@app.command("list")
def list_nodes(connect: Connect = None, run: ChosenRun = None, domain: Domain = None, as_json: AsJson = False) -> None:
    """List the nodes on the bus, with what each publishes and subscribes to, and the roles that are missing."""
    with joined(connect, run, domain) as bus:
        found = present(bus)
        rules = contract()
        absent = missing(rules, found, bus.target.run)
    listed: list[dict[str, Any]] = []
    for name, own in groupby(sorted(found, key=attrgetter("node")), key=attrgetter("node")):
        mine = list(own)
        kinds = {"publishes": [EntityKind.PUBLISHER], "subscribes": [EntityKind.SUBSCRIPTION]}
        kinds["services"] = [kind for kind in EntityKind if [kind] not in kinds.values()]
        topics = {what: sorted(end.topic for _, end in ends(mine, *chosen)) for what, chosen in kinds.items()}
        listed.append({"node": name, "role": name in rules.roles, "sessions": sorted({one.zid for one in mine}), **topics})
    if as_json:
        print_json({"nodes": listed, "missing": absent})
        return
    out = table("node", "what", ">publishes", ">subscribes", "session")
    for node in listed:
        role = rules.roles.get(node["node"])
        what = role.doc if role is not None else Text("not a role of the contract", "dim")
        out.add_row(node["node"], what, *(str(len(node[key])) for key in ("publishes", "subscribes")), " ".join(node["sessions"]))
    wide_console().print(out)
    if absent:
        wide_console().print(f"not there: {', '.join(absent)}", style="dim")
